"""How large a report is: sizes, radii and repetitions of its experiments."""

from dataclasses import asdict, dataclass, field, fields
from typing import Any, Self

from torchbokeh.report.rows import Row
from torchbokeh.report.scenes import NAMES


def sized(full: Any, quick: Any) -> Any:
    """A setting: what it is, and what it is where a report only shows that everything runs."""
    return field(default=full, metadata={"quick": quick})


@dataclass(frozen=True)
class Sizes:
    """What all settings have in common."""

    @classmethod
    def quick(cls, **others: Any) -> Self:
        """Small enough for a test: it shows that everything runs, its numbers mean little."""
        small = {f.name: f.metadata["quick"] for f in fields(cls) if "quick" in f.metadata}
        return cls(**(small | others))

    def row(self) -> Row:
        """Everything, for the record."""
        return asdict(self)


@dataclass(frozen=True)
class Settings(Sizes):
    """Sizes are sides of square pictures in px, radii are of the largest blur in px.

    Attributes:
        scenes: those of the first two experiments.
        repeat: timed runs of each method.
        budget: seconds for the timed runs of one method; fewer runs are made where they take longer.
        cap: seconds that one run may take; a method that would take more is left out.
        photo_size: of the scene ``photo``, and of the experiments that vary one thing.
        photo_radii: of the scene ``photo``, one table each.
        recipe_size: of the recipes, as one layer.
        recipe_radius: of the recipes.
        recipe_budget: as ``budget``, for the recipes.
        recipe_cap: as ``cap``, for the recipes.
        truth_size: of the recipes, against the truth.
        truth_radius: likewise.
        truth_views: points of the lens of each half of the truth.
        sweep_budget: as ``budget``, where one thing is varied.
        sweep_cap: as ``cap``, where one thing is varied.
        sweep_radii: of run time against radius.
        sweep_sizes: of run time against pixels.
        memory_sizes: those of ``sweep_sizes`` at which peak memory is measured.
        sweep_radius: blur where something else varies.
        layer_counts: of run time against layers.
        motion_size: of defocus with motion.
        motions: of that, pairs of largest radius and longest motion in px.
        gradient_sizes: of forward and backward passes.
        gradient_radii: likewise.
        gradient_memory: bytes that one may take; what would take more is left out.
        export_qualities: of the files that are exported.
        export_sizes: at which they are run.
        chromatic_scenes: recipes of the experiments on dispersion.
        chromatic_strengths: of these, pairs of axial and lateral.
        chromatic_size: likewise.
        chromatic_radius: likewise.
        chromatic_truth: views of their truth.
        chromatic_views: of the accumulation that is compared with it.
        chromatic_repeat: timed runs of each method.
        sample_views: of run time against views with dispersion.
        band_views: of the dot whose bands of colour are measured.
    """

    scenes: tuple[str, ...] = NAMES
    repeat: int = sized(5, 2)
    budget: float = sized(2.0, 0.3)
    cap: float = sized(20.0, 0.15)
    photo_size: int = sized(1024, 160)
    photo_radii: tuple[float, ...] = sized((25.0, 100.0), (8.0, 20.0))
    recipe_size: int = sized(512, 96)
    recipe_radius: float = sized(25.0, 8.0)
    recipe_budget: float = sized(1.0, 0.3)
    recipe_cap: float = sized(0.6, 0.05)
    truth_size: int = sized(256, 64)
    truth_radius: float = sized(13.0, 5.0)
    truth_views: int = sized(512, 16)
    sweep_budget: float = sized(1.5, 0.3)
    sweep_cap: float = sized(12.0, 0.15)
    sweep_radii: tuple[float, ...] = sized((2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0), (2.0, 8.0, 20.0))
    sweep_sizes: tuple[int, ...] = sized((512, 1024, 2048, 4096), (64, 128))
    memory_sizes: tuple[int, ...] = sized((1024, 4096), (128,))
    sweep_radius: float = sized(25.0, 8.0)
    layer_counts: tuple[int, ...] = sized((1, 2, 4, 8, 16), (1, 4))
    motion_size: int = sized(1024, 64)
    motions: tuple[tuple[float, float], ...] = sized(((25.0, 40.0), (60.0, 120.0)), ((6.0, 12.0),))
    gradient_sizes: tuple[int, ...] = sized((256, 512), (48,))
    gradient_radii: tuple[float, ...] = sized((12.0, 50.0), (4.0,))
    gradient_memory: float = 6e9
    export_qualities: tuple[str, ...] = sized(("balanced", "fast"), ())
    export_sizes: tuple[int, ...] = sized((256, 512), (48,))
    chromatic_scenes: tuple[str, ...] = sized(("coins", "ramp"), ("coins",))
    chromatic_strengths: tuple[tuple[float, float], ...] = sized(((0.5, 0.0), (0.0, 0.03), (0.5, 0.03)), ((0.5, 0.03),))
    chromatic_size: int = sized(256, 48)
    chromatic_radius: float = sized(13.0, 5.0)
    chromatic_truth: int = sized(4096, 32)
    chromatic_views: tuple[int, ...] = sized((64, 256, 1024), (6, 16))
    chromatic_repeat: int = sized(2, 1)
    sample_views: tuple[int, ...] = sized((16, 64, 256, 1024), (6, 12, 24))
    band_views: int = sized(510, 96)
