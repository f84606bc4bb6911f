"""How large a report is: sizes, radii and repetitions of its experiments."""

from dataclasses import asdict, dataclass
from typing import Any

from torchbokeh.report.scenes import NAMES


@dataclass(frozen=True)
class Settings:
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
        importance_seeds: of the variance with importance sampling of a spectrum.
    """

    scenes: tuple[str, ...] = NAMES
    repeat: int = 5
    budget: float = 2.0
    cap: float = 20.0
    photo_size: int = 1024
    photo_radii: tuple[float, ...] = (25.0, 100.0)
    recipe_size: int = 512
    recipe_radius: float = 25.0
    recipe_budget: float = 1.0
    recipe_cap: float = 0.6
    truth_size: int = 256
    truth_radius: float = 13.0
    truth_views: int = 512
    sweep_budget: float = 1.5
    sweep_cap: float = 12.0
    sweep_radii: tuple[float, ...] = (2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0)
    sweep_sizes: tuple[int, ...] = (512, 1024, 2048, 4096)
    memory_sizes: tuple[int, ...] = (1024, 4096)
    sweep_radius: float = 25.0
    layer_counts: tuple[int, ...] = (1, 2, 4, 8, 16)
    motion_size: int = 1024
    motions: tuple[tuple[float, float], ...] = ((25.0, 40.0), (60.0, 120.0))
    gradient_sizes: tuple[int, ...] = (256, 512)
    gradient_radii: tuple[float, ...] = (12.0, 50.0)
    gradient_memory: float = 6e9
    export_qualities: tuple[str, ...] = ("balanced", "fast")
    export_sizes: tuple[int, ...] = (256, 512)
    chromatic_scenes: tuple[str, ...] = ("coins", "ramp")
    chromatic_strengths: tuple[tuple[float, float], ...] = ((0.5, 0.0), (0.0, 0.03), (0.5, 0.03))
    chromatic_size: int = 256
    chromatic_radius: float = 13.0
    chromatic_truth: int = 4096
    chromatic_views: tuple[int, ...] = (64, 256, 1024)
    chromatic_repeat: int = 2
    sample_views: tuple[int, ...] = (16, 64, 256, 1024)
    band_views: int = 510
    importance_seeds: int = 16

    def row(self) -> dict[str, Any]:
        """Everything, for the record."""
        return asdict(self)


def quick(scenes: tuple[str, ...] = NAMES) -> Settings:
    """Small enough for a test: it shows that everything runs, its numbers mean little."""
    return Settings(
        scenes=scenes,
        repeat=2,
        budget=0.3,
        cap=0.15,
        photo_size=160,
        photo_radii=(8.0, 20.0),
        recipe_size=96,
        recipe_radius=8.0,
        recipe_budget=0.3,
        recipe_cap=0.05,
        truth_size=64,
        truth_radius=5.0,
        truth_views=16,
        sweep_budget=0.3,
        sweep_cap=0.15,
        sweep_radii=(2.0, 8.0, 20.0),
        sweep_sizes=(64, 128),
        memory_sizes=(128,),
        sweep_radius=8.0,
        layer_counts=(1, 4),
        motion_size=64,
        motions=((6.0, 12.0),),
        gradient_sizes=(48,),
        gradient_radii=(4.0,),
        export_qualities=(),
        export_sizes=(48,),
        chromatic_scenes=("coins",),
        chromatic_strengths=((0.5, 0.03),),
        chromatic_size=48,
        chromatic_radius=5.0,
        chromatic_truth=32,
        chromatic_views=(6, 16),
        chromatic_repeat=1,
        sample_views=(6, 12, 24),
        band_views=96,
    )
