from torchbokeh.report.experiment import Experiment, draw_figures, find_rows, sections

TABLE = [
    Experiment("first", lambda settings, say: [{"n": settings}], lambda rows, settings, plots: f"## {rows[0]['n']}"),
    Experiment("none", lambda settings, say: [], lambda rows, settings, plots: "never"),
    Experiment(
        "last",
        lambda settings, say: iter([{"n": 2 * settings}]),
        lambda rows, settings, plots: f"## {plots}",
        lambda rows: {"last.png": rows[0]["n"]},
    ),
]


def test_tables_are_run_in_order_and_whole():
    assert find_rows(TABLE, 4, print) == {"first": [{"n": 4}], "none": [], "last": [{"n": 8}]}
    assert find_rows(TABLE, 4, print, ["last"]) == {"first": [], "none": [], "last": [{"n": 8}]}


def test_only_what_has_rows_is_told_and_drawn():
    rows = find_rows(TABLE, 4, print)
    assert sections(TABLE, rows, {}, ["last.png"]) == ["## 4", "## ['last.png']"]
    assert draw_figures(TABLE, rows) == {"last.png": 8}
