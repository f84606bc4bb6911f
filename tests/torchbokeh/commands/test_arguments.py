"""The parsers of flags: what they make of a text, and what they say of one that is wrong."""

from argparse import ArgumentTypeError

import pytest

from torchbokeh.commands.arguments import (
    finite,
    interval,
    length,
    names,
    number,
    pixel,
    positive,
    shard,
    share,
    size,
    stops,
    whole,
)


@pytest.mark.parametrize(
    ("text", "metres"), [("50mm", 0.05), ("3.6cm", 0.036), ("2m", 2), ("2", 2), (" 2.5 m ", 2.5), ("1e3mm", 1)]
)
def test_lengths_have_units(text, metres):
    assert length(text) == pytest.approx(metres)


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (whole(0), "007", 7),
        (number, "-inf", float("-inf")),
        (finite, "-1e3", -1000.0),
        (positive, "1_0", 10.0),
        (share, "0.5", 0.5),
        (stops, "-30", -30.0),
        (interval, "2, 20.5", (2.0, 20.5)),
        (pixel, "320,240", (320, 240)),
        (size, "320x240", (240, 320)),
        (shard, "2/4", (2, 4)),
        (names, "b, a,b", ("b", "a", "b")),
    ],
)
def test_values(parse, text, value):
    assert parse(text) == value


@pytest.mark.parametrize(
    ("parse", "text", "message"),
    [
        (whole(1, 9), "10", "expected a whole number from 1 to 9, got '10'"),
        (whole(1, 9), "²", "expected a whole number from 1 to 9, got '²'"),
        (number, "nan", "expected a number, got 'nan'"),
        (finite, "x", "expected a number, got 'x'"),
        (finite, "inf", "expected a finite number, got 'inf'"),
        (positive, "0", "expected a number above 0, got '0'"),
        (share, "1", "expected a number between 0 and 1, got '1'"),
        (stops, "31", "expected between -30 and 30 stops, got '31'"),
        (length, "0mm", "expected a length above 0, such as 50mm or 2.5, got '0mm'"),
        (interval, "1,2,3", "expected two numbers LO,HI such as 2,20, got '1,2,3'"),
        (pixel, "1", "expected a pixel X,Y such as 320,240, got '1'"),
        (size, "0x5", "expected a size WxH such as 320x240, got '0x5'"),
        (shard, "3/2", "expected K/M with K from 1 to M, such as 2/4, got '3/2'"),
        (names, "a,,b", "expected names with commas between them, got 'a,,b'"),
    ],
)
def test_errors(parse, text, message):
    with pytest.raises(ArgumentTypeError) as caught:
        parse(text)
    assert str(caught.value) == message
