from torchbokeh.report.rows import distinct, mean, not_skipped, of

ROWS = [
    {"method": "a", "size": 2, "l1": 1.0},
    {"method": "b", "size": 2, "skipped": "too slow"},
    {"method": "a", "size": 1, "l1": 2.0},
]


def test_rows_are_chosen_by_their_values():
    assert of(ROWS, method="a", size=1) == [ROWS[2]]
    assert of(ROWS, l1=1.0) == [ROWS[0]]
    assert of(ROWS) == ROWS
    assert not_skipped(ROWS) == [ROWS[0], ROWS[2]]


def test_columns_are_read_in_order():
    assert distinct(ROWS, "method") == ["a", "b"]
    assert distinct(ROWS, "size") == [2, 1]
    assert mean(not_skipped(ROWS), "l1") == 1.5
