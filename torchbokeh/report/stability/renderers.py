"""The renderers that stiff cases are run through: a new one is a line in `renderers`."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

import torchbokeh
from torchbokeh import AccumulationBuffer, ChromaticAccumulation, KernelSplatting, LensBlur, PsfBank
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.psfs.model import Labels
from torchbokeh.report.internals import QUALITY_NAMES, pixel_positions
from torchbokeh.report.stability.cases import Case, reach_of

Call = Callable[..., Tensor]

Inputs = Callable[[Tensor, Tensor, Any], tuple[Any, dict[str, Any]]]
"""What a renderer is given for ``(image, coc, motion)``: what comes first, and all else by name."""

WAY = (5.0, -3.0)
"""Motion in px where a renderer needs one and a case has none."""

VIEWS = 16
"""Of the accumulation buffer."""

WIDEST = 100.0
"""Radius in px up to which banks other than that of motion are asked: what they scale their PSFs to needs a buffer as
large, and that of 1e4 px is refused."""

CUT_TO, MARGIN = 6.0, 3
"""``max_coc`` and ``margin`` of the renderer that has both, in px."""

TEXELS = 1.5 * math.sqrt(2) * 2 * math.sqrt(math.pi)
"""How far a level of detail of 1 spreads light, as a share of the radius: a texel covers up to the area of the blur, or
four times that of the level above, and is shared with its neighbours each way."""

SPREAD = 3.0
"""How far in px `dispersing` moves light, in radius and in place, at most."""


@dataclass(frozen=True)
class Renderer:
    """One way to render a case.

    Attributes:
        name: for tables.
        kind: which bound holds for it, see `torchbokeh.report.stability.bounds`.
        make: of a quality and the width of the picture in px, what renders it.
        inputs: what that is given.
        quality: name of the operating point; ``"exact"`` where there is no choice.
        bank: of the PSFs, where they are not flat discs.
        moves: whether it looks at motion.
        ahead: how far it goes along a motion, as a share of the length of that: half of it about the middle.
        texels: how much farther than its radius a PSF reaches by coarse texels, as a share of it.
        widths: least and largest radius, signed, of what has a CoC.
    """

    name: str
    kind: str
    make: Callable[[str, int], Call]
    inputs: Inputs
    quality: str = "exact"
    bank: str | None = None
    moves: bool = False
    ahead: float = 0.5
    texels: float = 0.0
    widths: Callable[[Tensor], tuple[Tensor, ...]] = lambda coc: (coc,)

    @property
    def layered(self) -> bool:
        """Whether it takes the two layers of `layers_of`."""
        return self.kind in ("layers", "views", "rays")

    @property
    def merges(self) -> bool:
        """Whether it approximates what its exact quality does."""
        return self.quality != "exact"

    def run(self, image: Tensor, coc: Tensor, motion: Tensor | None, quality: str | None = None) -> Tensor:
        """Render ``(image, coc, motion)`` in their dtype, at its own quality or at another one."""
        first, others = self.inputs(image, coc, motion)
        return self.make(quality or self.quality, image.shape[3])(first, **others)

    def takes(self, case: Case) -> bool:
        """Whether a case says anything about this renderer, and is among what it is for."""
        empty, channels = case.image.numel() == 0, case.image.shape[1]
        if (case.group == "motion" and not self.moves) or (empty and self.kind in ("samples", "views", "rays")):
            return False
        coloured = self.layered or self.kind in ("samples", "colours") or self.bank not in (None, "combined")
        if channels != 3 and coloured:
            return False
        return empty or self.bank in (None, "combined") or float(case.coc.abs().max()) <= WIDEST

    def gain(self) -> float:
        """The largest factor of the values: 1 of a mean, more where PSFs are tinted."""
        return 1.0 if self.bank is None else max(1.0, float(bank_of(self.bank).gains().max()) - 0.01)

    def reach(self, case: Case) -> float:
        """How far in px the PSFs of a case reach."""
        if self.bank in (None, "combined"):
            return reach_of((1 + self.texels) * self.widths(case.coc)[-1], self.motion(case), self.ahead)
        bank = bank_of(self.bank)
        place = bank.model.place(Labels(case.coc))
        scale = 1.0 if place.scale is None else float(place.scale.max())
        number = bank.model.grid.index(place.coordinates.movedim(1, -1))
        return math.sqrt(2) * scale * float(bank.reach()[number].max()) + 3

    def motion(self, case: Case) -> Tensor | None:
        """The motion of a case, or one in its place, where the renderer needs one."""
        if not self.moves or case.motion is not None:
            return case.motion if self.moves else None
        way = torch.tensor(WAY, dtype=torch.float64).view(1, 2, 1, 1)
        return way.expand(len(case.image), 2, *case.image.shape[2:]).contiguous()


def renderers() -> Iterator[Renderer]:
    """All of them, and those with the options that a user may set, one of each."""
    moving: dict[str, Any] = {"moves": True, "bank": "combined"}
    for q in QUALITY_NAMES:
        kind = "splat" if q == "exact" else "merged"
        yield Renderer(f"KernelSplatting, {q}", kind, _of(KernelSplatting), _picture, q)
        yield Renderer(f"LensBlur image, {q}", "composed", _of(LensBlur), _picture, q)
        yield Renderer(f"LensBlur layers, {q}", "layers", _of(LensBlur), _layers, q)
        yield Renderer(f"LensBlur motion, {q}", "bank", _of(LensBlur), _moving, q, **moving)
    for q in ("exact", "balanced"):
        for spectrum in ("rgb", "continuous"):
            name = f"LensBlur dispersion {spectrum}, {q}"
            yield Renderer(name, "colours", _of(LensBlur, spectrum), _picture, q, widths=_dispersed)
        yield Renderer(f"LensBlur approaching, {q}", "bank", _of(LensBlur), _near, q, widths=_doubled, **moving)
        curved = _of(LensBlur, shutter="start")
        yield Renderer(f"LensBlur curved motion, {q}", "bank", curved, _curved, q, ahead=1.25, **moving)
    for bank in ("stylized", "physical-lens"):
        splatting = _of(KernelSplatting, bank=bank_of(bank))
        yield Renderer(f"KernelSplatting, bank {bank}", "bank", splatting, _picture, bank=bank)
    yield Renderer("LensBlur 6-gon, exact", "composed", _of(LensBlur, aperture="6-gon"), _picture)
    yield Renderer("LensBlur background, exact", "composed", _of(LensBlur), _background)
    cut = _of(LensBlur, margin=MARGIN, max_coc=CUT_TO)
    yield Renderer("LensBlur margin and max_coc, balanced", "composed", cut, _margin, "balanced", widths=_cut)
    views, coarser = _of(AccumulationBuffer), _of(AccumulationBuffer, level_of_detail=1.0, reuse=1)
    yield Renderer("AccumulationBuffer layers", "views", views, _layers)
    yield Renderer("AccumulationBuffer layers, coarser and shared", "views", coarser, _layers, texels=TEXELS)
    yield Renderer("AccumulationBuffer layers, sub-samples", "rays", _of(AccumulationBuffer, subsamples=4), _layers)
    yield Renderer("AccumulationBuffer layers, in motion", "views", views, _moving_layers, moves=True)
    for spectrum in ("rgb", "continuous"):
        views = _of(ChromaticAccumulation, spectrum)
        yield Renderer(f"ChromaticAccumulation layers, {spectrum}", "views", views, _layers, widths=_dispersed)
    yield Renderer("reconstruct", "samples", lambda quality, width: torchbokeh.reconstruct, _samples, **moving)


def _of(kind: type[Any], spectrum: str | None = None, **options: Any) -> Callable[[str, int], Call]:
    """What makes a renderer of a quality, and with dispersion a lens for the width of the picture."""

    def made(quality: str, width: int) -> Call:
        lens = {} if spectrum is None else {"lens": dispersing(width, spectrum)}
        views = kind in (AccumulationBuffer, ChromaticAccumulation)
        made: Call = kind(**lens, **options, **({"views": VIEWS} if views else {"quality": quality}))
        return made

    return made


@lru_cache
def bank_of(name: str) -> PsfBank:
    """A bank that comes with the package."""
    return PsfBank.load(name)


@lru_cache
def dispersing(width: int, spectrum: str) -> torchbokeh.ThinLens:
    """A lens that moves light by a px or two, whatever the width of the picture."""
    dispersion = torchbokeh.Dispersion("BK7", axial=8.0, lateral=0.02, spectrum=spectrum)  # type: ignore[arg-type]
    return torchbokeh.ThinLens(0.05, 1.0, 2.0, sensor_width=0.003 * width, dispersion=dispersion)


def layers_of(image: Tensor, coc: Tensor) -> tuple[Tensor, Tensor]:
    """Two layers: a soft spot of the picture in front of the focus, and the picture mirrored behind it."""
    height, width = image.shape[2:]
    y, x = (torch.linspace(-1, 1, n, dtype=torch.float64, device=image.device) for n in (height, width))
    alpha = (4 - 8 * torch.hypot(y[:, None], x).sub(0.3).clamp_min(0)).clamp(0, 1).to(image.dtype)
    alpha = alpha.expand(len(image), 1, height, width)
    front, back = torch.cat([image * alpha, alpha], 1), torch.cat([image.flip(-1), torch.ones_like(alpha)], 1)
    return torch.stack([front, back], 1), torch.stack([-coc.abs(), coc.abs()], 1)


def _picture(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    return image, {"coc": coc}


def _moving(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    return image, {"coc": coc, "motion": motion}


def _layers(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    rgba, radius = layers_of(image, coc)
    return rgba, {"coc": radius}


def _moving_layers(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    """Layers that move in opposite ways."""
    rgba, radius = layers_of(image, coc)
    return rgba, {"coc": radius, "motion": torch.stack([motion, -motion], 1)}


def _near(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    """The CoC is multiplied by four while the shutter is open."""
    return image, {"coc": coc, "motion": motion, "shutter_depth": torch.cat([coc / 2, 2 * coc], 1)}


def _curved(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    """Half of the motion, as much to its right, and a quarter of it back."""
    right = torch.stack([-motion[:, 1], motion[:, 0]], 1)
    return image, {"coc": coc, "motion": (motion / 2, right / 2, -motion / 4)}


def _background(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    return image, {"coc": coc, "background": (image.flip(-1), coc.abs())}


def _margin(image: Tensor, coc: Tensor, motion: Any) -> tuple[Tensor, dict[str, Any]]:
    """The picture goes on beyond the sensor, with its last pixels."""
    if image.numel():
        image, coc = (F.pad(t, (MARGIN,) * 4, mode="replicate") for t in (image, coc))
    return image, {"coc": coc}


def _samples(image: Tensor, coc: Tensor, motion: Any) -> tuple[torchbokeh.Samples, dict[str, Any]]:
    """Samples in the middle of their pixels, of the lens and of the exposure: a plain picture."""
    # Half precision cannot tell the columns of a wide picture apart.
    position = pixel_positions(image.to(compute_dtype(image))).expand(len(image), 2, *image.shape[2:])
    zero, present = torch.zeros_like(position), torch.ones_like(coc, dtype=torch.bool)
    maps = image, position, zero, zero[:, :1], coc, motion, present
    return torchbokeh.Samples(*(t[:, None] for t in maps)), {}


def _dispersed(coc: Tensor) -> tuple[Tensor, ...]:
    """Radii that differ from those of a CoC by `SPREAD`."""
    sign = torch.where(coc < 0, -1.0, 1.0).to(coc.dtype)
    return sign * (coc.abs() - SPREAD).clamp_min(0), sign * (coc.abs() + SPREAD)


def _doubled(coc: Tensor) -> tuple[Tensor, ...]:
    return coc / 2, 2 * coc


def _cut(coc: Tensor) -> tuple[Tensor, ...]:
    return (coc.clamp(-CUT_TO, CUT_TO),)
