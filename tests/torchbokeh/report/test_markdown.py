import pytest

from torchbokeh.report.markdown import cell, cross_table, row_table, seconds, skipped, table

ROWS = [
    {"method": "a", "size": 1, "seconds": 0.5, "l1": None},
    {"method": "b", "size": 1, "skipped": "too slow"},
    {"method": "b", "size": 2, "seconds": 12.0, "l1": 0.25},
]


def test_a_table_is_markdown():
    assert table(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |"


@pytest.mark.parametrize(
    ("value", "text"), [(123.4, "123.4"), (9.876, "9.88"), (0.5, "0.500"), (0.001234, "0.00123"), (1e-5, "1.00e-05")]
)
def test_seconds_have_three_digits(value, text):
    assert seconds(value) == text


def test_cells_show_a_row_and_a_dash_for_what_is_missing():
    assert cell({"bytes": 2.4e6, "seconds": 0.5, "none": None}, "{bytes:M} MB, {seconds:t}, {none:.1f}, {no:g}") == (
        "2 MB, 0.500, -, -"
    )


def test_a_row_is_a_line():
    assert row_table(ROWS[:1], "method | s | ", "{method} | {seconds:t} | {l1:.2f}") == (
        "| method | s |  |\n| --- | --- | --- |\n| a | 0.500 | - |"
    )


def test_lines_and_columns_are_values_of_two_keys():
    assert cross_table(ROWS, "method", "size", "{seconds:t}") == (
        "| method | 1 | 2 |\n| --- | --- | --- |\n| a | 0.500 | - |\n| b | - | 12.0 |"
    )


def test_what_was_skipped_is_said_with_its_reason_and_place():
    assert skipped(ROWS) == "Left out: b: too slow."
    assert skipped(ROWS, " at {size} px") == "Left out: b at 1 px: too slow."
    assert skipped(ROWS[:1]) == ""
