"""What a scene needs, decided once: `LensBlur.plan` makes a `Plan`, and a forward pass carries it out."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

from torch import Tensor

from torchbokeh.lens.dispersion import Light
from torchbokeh.ops.convolve import CONVOLVE_FROM
from torchbokeh.ops.spans import Profile
from torchbokeh.picture.request import Request
from torchbokeh.plan.look import Look
from torchbokeh.plan.quality import Detail, Quality
from torchbokeh.psfs.combined import STILL

Hidden = Literal["nothing", "filled", "given", "layers"]

Route = Literal["sharp", "uniform", "layers", "foreground", "surface"]

_HIDDEN = {
    "filled": "what it hides is filled from its surroundings (pass background= if you know it)",
    "given": "what it hides comes from background=",
}


@dataclass(frozen=True, kw_only=True)
class Plan(Look):
    """What a scene needs, and by that what is left out.

    Attributes, beside those of the `Look` that it was decided by:
        sharp: every radius is below half a pixel and nothing moves: the image passes through.
        hidden: how what the foreground hides is known.
        bins: for every surface, front to back, the centres of its soft bins in px of CoC.
        subapertures: the lens is cut into the square of this many pieces.
        parts: the exposure is cut into this many parts of constant radius.
        surrounded: the picture is surrounded with its ground, this many px on each side, for the lights at its border.
        aperture: the shape of the aperture, for the reader.
        quality: the operating point.
        highest: the coarsest level that pixels are merged on; 0 if none are.
        predicted_error: largest relative L1 error of the splats against exact ones: of any picture, see `Quality`,
            or of this one where there is a tolerance, see `torchbokeh.plan.quality.predict_errors`.
        colours: the lights that a lens with dispersion takes a picture in, one by one; none where that is not seen.
        spread: how far it spreads them in px, in radius and place.
        fading: plans with a part less, and how much their pictures count for in a mean with that of this plan: where a
            part begins to be needed, it does so gradually.
    """

    sharp: bool
    hidden: Hidden
    bins: tuple[tuple[float, ...], ...]
    subapertures: int
    parts: int
    surrounded: int
    aperture: str
    quality: Quality
    highest: int
    predicted_error: float
    colours: tuple["Colour", ...] = ()
    spread: float = 0.0
    fading: tuple[tuple["Plan", float], ...] = ()

    @property
    def uniform(self) -> float | None:
        """The signed radius in px that all pixels share, where one convolution does it; else None."""
        low, high = self.coc_range
        if low != high or self.hidden != "nothing":
            return None
        if self.moves:
            return low if self.pan is not None and not self.approaches else None
        return low if self.highest == 0 and abs(low) >= CONVOLVE_FROM else None

    @property
    def detail(self) -> Detail:
        """How finely it is carried out."""
        return Detail(self.quality.merging, self.highest, self.quality.coarse)

    @property
    def route(self) -> Route:
        """How the picture is made, but for dispersion and what fades."""
        if self.sharp:
            return "sharp"
        if self.layer_count:
            return "layers"
        if self.uniform is not None:
            return "uniform"
        return "foreground" if len(self.bins) == 2 else "surface"

    def pictures(self, share: float = 1.0) -> Iterator["Picture"]:
        """The pictures that make up this one, by one route each: through every light, and of every plan that fades."""
        own = share * (1.0 - sum(part for _, part in self.fading)) if self.fading else share
        if self.colours:
            for colour in self.colours:
                yield from (picture._replace(colour=colour) for picture in colour.plan.pictures(own))
        else:
            yield Picture(None, self, own)
        for other, part in self.fading:
            yield from other.pictures(share * part)

    def unused(self, request: Request, profile: Profile) -> list[Tensor | None]:
        """What the picture of a request does not depend on: of its maps, and of the shape of the aperture."""
        motion, behind = request.motion, request.background
        found: list[Tensor | None] = [] if self.moves else [*motion.displacements]
        if motion.shutter_coc is not None:
            found.append(request.coc if self.approaches else motion.shutter_coc)
        if self.hidden != "given":
            found += behind or ()
        if self.sharp:
            found += [request.coc, *profile]
        if self.layer_count and not self.layers:
            found += [request.image, request.coc]
        return found

    @property
    def cuts(self) -> list[int]:
        """All numbers of sub-apertures each way that occur in it and in its parts."""
        return sorted({picture.plan.subapertures for picture in self.pictures()})

    def check(self, request: Request) -> None:
        """Raise a ValueError unless the plan was made for requests like this one."""
        image = request.image
        known = all(isinstance(n, int) for n in image.shape)  # an export may leave the size open
        if known and self.size != tuple(image.shape[-2:]):
            raise ValueError(f"plan: expected one for size {tuple(image.shape[-2:])}, got one for {self.size}")
        if self.motion > STILL[0] and not request.motion.displacements:
            raise ValueError("plan: expected the motion it was made with, got none")
        if self.approaches and request.motion.shutter_coc is None:
            raise ValueError("plan: expected the shutter_depth it was made with, got none")
        count = image.shape[1] if request.layered else 0
        if self.layer_count != count:
            raise ValueError(f"plan: expected one for {count} layers, got one for {self.layer_count}")
        if self.hidden in ("filled", "given") and (self.hidden == "given") != (request.background is not None):
            raise ValueError(f"plan: expected the background it was made with ({self.hidden}), got another")

    def __str__(self) -> str:
        height, width = self.size
        low, high = self.coc_range
        head = f"{width} x {height} image, CoC {low:+.1f} to {high:+.1f} px (negative: in front of the focus plane)."
        if self.colours:
            single = all(max(c.light.rgb) == 1 for c in self.colours)
            how = "red, green and blue" if single else f"{len(self.colours)} bands of the spectrum"
            head += f"\nDispersion spreads colours by up to {self.spread:.1f} px: {how} are blurred one by one."
        if self.sharp and not self.colours:
            return f"{head}\nEverything is within half a pixel of sharp: the image passes through unchanged."
        if self.surrounded:
            head += f"\n{lights_text(self.surrounded)}"
        if self.uniform is not None:
            moved = f", moved by ({self.pan[0]:.1f}, {self.pan[1]:.1f}) px" if self.moves and self.pan else ""
            return f"{head}\nEvery pixel has the same PSF ({self.aperture}{moved}): a single convolution."
        lines = [head]
        counts = " and ".join(str(len(b)) for b in self.bins)
        if self.hidden == "layers":
            lines.append(
                f"{len(self.bins)} layers of the input are blurred ({counts} bins) and composed front to back."
            )
        elif len(self.bins) == 2:
            lines.append(f"The foreground is blurred over the rest ({counts} bins); {_HIDDEN[self.hidden]}.")
        else:
            lines.append(f"One surface in {counts} bin{'s' if len(self.bins[0]) > 1 else ''}: no foreground is needed.")
        if self.moves:
            lines.append(f"Motion up to {self.motion:.1f} px, in one splat with the defocus, through the whole lens.")
            if self.approaches:
                lines.append(f"Motion in depth changes radii by up to {self.approach:.1f} px, in {self.parts} steps.")
        elif self.subapertures > 1:
            lines.append(f"{self.aperture}, cut into {self.subapertures} x {self.subapertures} sub-apertures.")
        else:
            small = "the blur is too small for sub-apertures to show, or the quality has none"
            lines.append(f"{self.aperture}, whole: {'nothing hides anything' if self.hidden == 'nothing' else small}.")
        if self.highest:
            lines.append(
                f"Quality {self.quality.name!r}: blocks of up to {2**self.highest} x {2**self.highest} pixels are "
                f"merged by radius; relative error of the splats at most {self.predicted_error:.2g}."
            )
        elif self.quality.merging is not None:
            lines.append(f"Quality {self.quality.name!r}: the blur is too small for pixels to be merged.")
        if self.fading:
            share = sum(share for _, share in self.fading)
            lines.append(f"Part of this is hardly needed yet: {100 * share:.2g} % of the picture do without.")
        if self.clamped:
            lines.append(f"max_coc cuts the blur of {100 * self.clamped:.2g} % of the pixels.")
        return "\n".join(lines)


def lights_text(surrounded: int) -> str:
    """What is assumed of the surroundings, for the reader of a plan."""
    return f"Lights near the border: {surrounded} px around the picture go on as its ground does, without lights."


class Colour(NamedTuple):
    """One light of a picture.

    Attributes:
        light: its wavelength, and what it adds to each channel.
        enlarged: whether its picture may have another size.
        plan: what it needs.
    """

    light: Light
    enlarged: bool
    plan: Plan


class Picture(NamedTuple):
    """One of the pictures that a plan is made up of.

    Attributes:
        colour: the light that it is of; None for all of it.
        plan: its plan, of which only the route by itself counts.
        share: how much it counts for.
    """

    colour: Colour | None
    plan: Plan
    share: float


@dataclass(frozen=True)
class SplattingPlan:
    """What one layer needs.

    Attributes:
        size: ``(H, W)`` of the image.
        largest: the largest radius in px.
        quality: the operating point.
        highest: the coarsest level that pixels are merged on; 0 if none are.
        predicted_error: largest relative L1 error against the exact splat, as in `Plan`.
        sharp: every radius is below half a pixel: the image passes through.
        uniform: the signed radius in px that all pixels share, where one convolution does it; else None.
        surrounded: as in `Plan`; and ``lit``, how much the picture with surroundings counts for.
    """

    size: tuple[int, int]
    largest: float
    quality: Quality
    highest: int
    predicted_error: float
    sharp: bool
    uniform: float | None = None
    surrounded: int = 0
    lit: float = 0.0

    @property
    def detail(self) -> Detail:
        """How finely it is carried out."""
        return Detail(self.quality.merging, self.highest)

    def unused(self, request: Request, profile: Profile) -> list[Tensor | None]:
        """What the picture of a request does not depend on."""
        return [request.coc, *profile] if self.sharp else []

    def check(self, request: Request) -> None:
        """Raise a ValueError unless the plan was made for requests like this one."""
        size = tuple(request.image.shape[-2:])
        if all(isinstance(n, int) for n in size) and self.size != size:  # an export may leave the size open
            raise ValueError(f"plan: expected one for size {size}, got one for {self.size}")

    def __str__(self) -> str:
        height, width = self.size
        head = f"{width} x {height} image, radius up to {self.largest:.1f} px."
        if self.sharp:
            return f"{head}\nEverything is within half a pixel of sharp: the image passes through unchanged."
        if self.lit:
            head += f"\n{lights_text(self.surrounded)}"
        if self.uniform is not None:
            return f"{head}\nEvery pixel has the same PSF: a single convolution."
        if self.highest == 0:
            return f"{head}\nQuality {self.quality.name!r}: every pixel is splatted by itself."
        return (
            f"{head}\nQuality {self.quality.name!r}: blocks of up to {2**self.highest} x {2**self.highest} pixels are "
            f"merged; relative error at most {self.predicted_error:.2g}."
        )
