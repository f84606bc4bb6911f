"""One layer: every pixel spreads its point-spread function, and the sum is divided by the coverage."""

import math

import torch
from torch import Tensor, nn

from torchbokeh.banks.splat import bank_labels, blur_with_bank
from torchbokeh.compose.composition import blur_one_layer
from torchbokeh.compose.routes import Pieces
from torchbokeh.compose.surroundings import Surrounding
from torchbokeh.ops.checks import check_flag
from torchbokeh.ops.convolve import CONVOLVE_FROM, blur_uniform
from torchbokeh.ops.merge import highest_level
from torchbokeh.ops.spans import MIN_RADIUS, Profile
from torchbokeh.picture.motion import Motion
from torchbokeh.picture.request import Optics, Request
from torchbokeh.picture.sensor import Sensor
from torchbokeh.plan.decide import passed
from torchbokeh.plan.lights import BRIGHTER, lights_at_border
from torchbokeh.plan.plan import SplattingPlan
from torchbokeh.plan.quality import QUALITIES, check_quality, choose, predict_errors
from torchbokeh.psfs.aperture import Aperture, parse_aperture
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.renderers.planned import Planned, fitting


class KernelSplatting(nn.Module):
    """Splatting of point-spread functions for one layer, without occlusion (LKS section 6).

    Every pixel spreads over its circle of confusion; the sum is divided by what was spread to each pixel, so that a
    constant image stays constant. What lies in front of what does not count: for that see `LensBlur`. Wide PSFs are
    merged by radius (`torchbokeh.ops.merge`), so that a wider blur costs less.

    A pixel that is NaN or infinite spoils its own channel of its own picture alone: the rows of its PSF, from there to
    the right border; with a bank, or where one convolution does it, all of it.

    Half precision is computed in float32, and the result rounded. What it cannot hold becomes infinite there, as with
    all of torch: above 65504 in float16. Only a bank whose PSFs are coloured can make a picture brighter than it was.

    Memory on the CPU in float32 for three channels, result included and inputs not: at most 45 MB per megapixel forward
    and 125 MB backward where pixels are merged, 70 and 180 MB for exact quality, whatever the radius.

    Args:
        aperture: ``"disc"``, ``"N-gon"`` such as ``"6-gon"``, or a `torchbokeh.psfs.Aperture`.
        quality: ``"exact"``, ``"high"``, ``"balanced"`` or ``"fast"``; see `torchbokeh.plan.quality.QUALITIES`.
        tolerance: relative L1 error to keep to, as far as it can be predicted; picks the quality instead.
        bank: sparse PSFs of any model in the place of the aperture, see `torchbokeh.psfs.PsfBank`: every pixel takes
            the sample that is nearest to its CoC, depth or motion. What is larger than all samples is scaled from the
            largest; a picture is refused where that takes more than 134 megapixels with what its PSFs reach.
        interpolate: of a bank, take the neighbouring samples by their shares instead of the nearest one: nearer to the
            model, and differentiable in all of its coordinates, for two (or four) times the time.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a value out of its range.

    Example:
        >>> import torch
        >>> splatting = KernelSplatting(quality="balanced")
        >>> image, coc = torch.rand(1, 3, 64, 64), torch.full((1, 1, 64, 64), 20.0)
        >>> splatting(image, coc).shape
        torch.Size([1, 3, 64, 64])
        >>> print(splatting.plan(image, coc))
        64 x 64 image, radius up to 20.0 px.
        Quality 'balanced': blocks of up to 4 x 4 pixels are merged; relative error at most 0.042.

        Defocus with motion:

        >>> from torchbokeh.psfs import PsfBank
        >>> splatting = KernelSplatting(bank=PsfBank.load("combined"))
        >>> splatting(image, coc, motion=torch.full((1, 2, 64, 64), 12.0)).shape
        torch.Size([1, 3, 64, 64])
    """

    def __init__(
        self,
        aperture: str | Aperture = "disc",
        quality: str = "balanced",
        *,
        tolerance: float | None = None,
        bank: PsfBank | None = None,
        interpolate: bool = False,
    ) -> None:
        super().__init__()
        check_quality(quality, tolerance)
        if bank is not None and not isinstance(bank, PsfBank):
            raise TypeError(f"bank: expected a PsfBank or None, got {type(bank).__name__}")
        if bank is not None and aperture != "disc":
            raise ValueError(f"aperture: expected none beside a bank, whose PSFs have their own shape, got {aperture}")
        self.aperture = parse_aperture(aperture)
        self.quality = quality
        self.tolerance = tolerance
        self.bank = bank
        self.interpolate = check_flag("interpolate", interpolate)

    def extra_repr(self) -> str:
        """The settings, for ``print``."""
        return f"quality={self.quality!r}" if self.tolerance is None else f"tolerance={self.tolerance}"

    def plan(
        self,
        image: Tensor,
        coc: Tensor | None = None,
        *,
        depth: Tensor | None = None,
        motion: Tensor | None = None,
    ) -> SplattingPlan:
        """Look at the radii once, in one small copy from the device. Arguments are those of `forward`."""
        return self.decide(self.request(image, coc, depth=depth, motion=motion))

    def forward(
        self,
        image: Tensor,
        coc: Tensor | None = None,
        *,
        depth: Tensor | None = None,
        motion: Tensor | None = None,
        plan: SplattingPlan | None = None,
    ) -> Tensor:
        """Blur a picture.

        Args:
            image: ``(B, C, H, W)`` linear radiance, any number of channels.
            coc: ``(B, 1, H, W)`` signed radius in px; only a bank whose model needs none may go without.
            depth: ``(B, 1, H, W)`` metres, for a bank whose model asks for it.
            motion: ``(B, 2, H, W)`` displacement (dx, dy) in px over the open shutter, likewise.
            plan: a plan made earlier with `plan`, for all pictures of the batch; their radii are then not looked at
                again. Without one, each picture has its own, and is what it would be alone.

        Returns:
            ``(B, C, H, W)`` in the dtype of ``image``, differentiable to ``image``, ``coc`` and the aperture; with a
            bank as `torchbokeh.banks.splat.splat_bank` says: without ``interpolate``, maps that only choose a sample
            get no gradient.

        Raises:
            TypeError: an argument is not a floating-point tensor, or not a `SplattingPlan`.
            ValueError: shapes, devices or values do not fit: see the message.
        """
        request = self.request(image, coc, depth=depth, motion=motion)
        requests = request.items() if plan is None else [request]
        plans = [self.decide(one) if plan is None else fitting(plan, SplattingPlan, one) for one in requests]
        shapes = [self.pieces(own) for own in plans]
        pictures = [
            one.answered(self.paint(one, own, pieces), own.unused(one, pieces[1][0]))
            for one, own, pieces in zip(requests, plans, shapes, strict=True)
        ]
        return torch.cat(pictures) if len(pictures) > 1 else pictures[0]

    def request(
        self,
        image: Tensor,
        coc: Tensor | None = None,
        *,
        depth: Tensor | None = None,
        motion: Tensor | None = None,
    ) -> Request:
        """Check what `forward` is called with."""
        if self.bank is not None:
            labels = bank_labels(self.bank, image, coc, depth, motion)
            found = Motion() if motion is None else Motion((motion,))
            sensor = Sensor((image.shape[2], image.shape[3]))
            return Request(
                image, torch.zeros_like(image[:, :1]) if coc is None else coc, found, None, sensor, labels=labels
            )
        for name, value in (("depth", depth), ("motion", motion)):
            if value is not None:
                raise ValueError(f"{name}: expected None without a bank, got a tensor")
        return Request.of(Optics(), image, coc=coc)

    @torch.no_grad()
    def decide(self, request: Request) -> SplattingPlan:
        """What a request needs."""
        size, coc = request.sensor.size, request.coc
        if request.image.numel() == 0:
            return SplattingPlan(size, 0.0, QUALITIES[0], 0, 0.0, True)
        expected = [] if self.tolerance is None else predict_errors(request.image, coc)
        low, high, *errors = torch.stack([t.to(coc.dtype) for t in (*coc.aminmax(), *expected)]).tolist()
        largest = max(-low, high)
        quality, error = choose(self.quality, self.tolerance, errors, largest)
        highest = 0 if quality.merging is None else highest_level(largest, size, quality.merging)
        if self.bank is not None:
            highest = highest if self.bank.model.merges else 0
            lights = self._lights(request, largest)
            return SplattingPlan(size, largest, quality, highest, error, False, None, *lights)
        one = low if low == high and highest == 0 and largest >= CONVOLVE_FROM else None
        sharp = largest <= MIN_RADIUS
        return SplattingPlan(size, largest, quality, highest, error, sharp, one, *self._lights(request, largest))

    def _lights(self, request: Request, largest: float) -> tuple[int, float]:
        """By how many px a picture is surrounded for the lights near its border, and how much that counts for."""
        moved, labels = 0.0, request.labels
        if self.bank is not None and labels is not None:
            if labels.motion is not None:
                moved = float(labels.motion.norm(dim=1).max())
            if labels.coc is None:
                moved += float(self.bank.reach().max())
        lit = passed(lights_at_border(request.image, request.coc, largest, moved), BRIGHTER)
        return (min(math.ceil(largest + moved), min(request.sensor.size) // 2), lit) if lit else (0, 0.0)

    def pieces(self, plan: SplattingPlan) -> Pieces:
        """The whole aperture."""
        return {1: [self.aperture.profile()]}

    def paint(self, request: Request, plan: SplattingPlan, pieces: Pieces) -> Tensor:
        """The picture ``(B, C, H, W)`` of a request, in at least float32.

        Args:
            request: as `request` found it good.
            plan: what to do.
            pieces: those of `pieces`.
        """
        ((profile,),) = pieces.values()
        if plan.sharp:
            return request.image.clone()
        with torch.autocast(request.image.device.type, enabled=False):
            request, around = request.working(), Surrounding(plan.surrounded)
            if not plan.lit:
                return self._splatted(request, plan, profile)
            whole = around.cut(self._splatted(around.of(request), plan, profile))
            # Not lerp, which rounds by where threads divide the work.
            if plan.lit == 1:
                return whole
            return plan.lit * whole + (1 - plan.lit) * self._splatted(request, plan, profile)

    def _splatted(self, request: Request, plan: SplattingPlan, profile: Profile) -> Tensor:
        image, coc, labels = request.image, request.coc, request.labels
        if self.bank is not None and labels is not None:
            settings = self.bank, plan.quality.merging, plan.highest
            return blur_with_bank(image, labels, *settings, interpolate=self.interpolate)
        if plan.uniform is not None and not coc.requires_grad and not torch.compiler.is_compiling():
            return blur_uniform(image, plan.uniform, profile)
        return blur_one_layer(image, coc, profile, plan.detail)

    def planned(self, plan: SplattingPlan) -> Planned:
        """The same renderer with its plan fixed, for `torch.export` and the like."""
        return Planned(self, plan)
