from dataclasses import dataclass

from torchbokeh.report.settings import Settings, Sizes, sized


@dataclass(frozen=True)
class Some(Sizes):
    large: int = sized(100, 3)
    same: float = 2.5


def test_a_quick_run_is_small_where_that_is_said():
    assert Some() == Some(large=100, same=2.5)
    assert Some.quick() == Some(large=3, same=2.5)
    assert Some.quick(same=1.0) == Some(large=3, same=1.0)
    assert Some.quick().row() == {"large": 3, "same": 2.5}


def test_a_quick_report_keeps_its_scenes():
    assert Settings.quick(scenes=("rain",)).scenes == ("rain",)
    assert Settings.quick().photo_size < Settings().photo_size
