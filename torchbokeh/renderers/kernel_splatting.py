"""One layer: every pixel spreads its point-spread function, and the sum is divided by the coverage."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchbokeh.banks.splat import bank_labels, blur_with_bank
from torchbokeh.ops.checks import check_flag, check_image
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.convolve import CONVOLVE_FROM, blur_uniform
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.merge import Merging, highest_level, splat_merged
from torchbokeh.ops.spans import MIN_RADIUS, Profile
from torchbokeh.ops.splat import splat_spans
from torchbokeh.picture.coc import signed_coc
from torchbokeh.plan.quality import QUALITIES, Quality, check_quality, choose, merged_shares
from torchbokeh.psfs.aperture import Aperture, parse_aperture
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels


@dataclass(frozen=True)
class SplattingPlan:
    """What one layer needs.

    Attributes:
        size: ``(H, W)`` of the image.
        largest: the largest radius in px.
        quality: the operating point.
        highest: the coarsest level that pixels are merged on; 0 if none are.
        predicted_error: relative L1 error against the exact splat, see `Quality`.
        sharp: every radius is below half a pixel: the image passes through.
        uniform: the signed radius in px that all pixels share, where one convolution does it; else None.
    """

    size: tuple[int, int]
    largest: float
    quality: Quality
    highest: int
    predicted_error: float
    sharp: bool
    uniform: float | None = None

    def __str__(self) -> str:
        height, width = self.size
        head = f"{width} x {height} image, radius up to {self.largest:.1f} px."
        if self.sharp:
            return f"{head}\nEverything is within half a pixel of sharp: the image passes through unchanged."
        if self.uniform is not None:
            return f"{head}\nEvery pixel has the same PSF: a single convolution."
        if self.highest == 0:
            return f"{head}\nQuality {self.quality.name!r}: every pixel is splatted by itself."
        return (
            f"{head}\nQuality {self.quality.name!r}: blocks of up to {2**self.highest} x {2**self.highest} pixels are "
            f"merged; predicted relative error {self.predicted_error:.2g}."
        )


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
        Quality 'balanced': blocks of up to 4 x 4 pixels are merged; predicted relative error 0.019.

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
        return self._plan(image, self._labels(image, coc, depth, motion).coc)

    def _plan(self, image: Tensor, coc: Tensor | None) -> SplattingPlan:
        coc = torch.zeros_like(image[:, :1]) if coc is None else coc.detach()
        radius = coc.abs()
        size = (image.shape[-2], image.shape[-1])
        if image.numel() == 0:
            return SplattingPlan(size, 0.0, QUALITIES[0], 0, 0.0, True)
        look = [*coc.aminmax(), *merged_shares(radius, self.quality, self.tolerance)]
        low, high, *shares = torch.stack(look).tolist()
        largest = max(-low, high)
        quality, error = choose(self.quality, self.tolerance, shares)
        highest = 0 if quality.merging is None else highest_level(largest, size, quality.merging)
        if self.bank is not None:
            return SplattingPlan(size, largest, quality, highest if self.bank.model.merges else 0, error, False)
        one = low if low == high and highest == 0 and largest >= CONVOLVE_FROM else None
        return SplattingPlan(size, largest, quality, highest, error, largest <= MIN_RADIUS, one)

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
            plan: a plan made earlier with `plan`; the radii are then not looked at again.

        Returns:
            ``(B, C, H, W)`` in the dtype of ``image``, differentiable to ``image``, ``coc`` and the aperture; with a
            bank as `torchbokeh.banks.splat.splat_bank` says: without ``interpolate``, maps that only choose a sample
            get no gradient.

        Raises:
            TypeError: an argument is not a floating-point tensor, or not a `SplattingPlan`.
            ValueError: shapes, devices or values do not fit: see the message.
        """
        labels = self._labels(image, coc, depth, motion)
        if plan is None:
            plan = self._plan(image, labels.coc)
        elif not isinstance(plan, SplattingPlan):
            raise TypeError(f"plan: expected a SplattingPlan, got {type(plan).__name__}")
        elif plan.size != tuple(image.shape[-2:]):
            raise ValueError(f"plan: expected one for size {tuple(image.shape[-2:])}, got one for {plan.size}")
        given = [t for t in labels if t is not None]
        asked = any(t.requires_grad for t in given)
        profile = self.aperture.profile()
        if plan.sharp and not (asked or profile.knots.requires_grad):
            return image.clone()
        with torch.autocast(image.device.type, enabled=False):
            dtype = compute_dtype(image, *given)
            source, labels = image.to(dtype), Labels(*(None if t is None else t.to(dtype) for t in labels))
            if self.bank is not None:
                out = blur_with_bank(
                    source, labels, self.bank, plan.quality.merging, plan.highest, interpolate=self.interpolate
                )
            elif plan.uniform is not None and not asked:
                out = blur_uniform(source, plan.uniform, profile)
            else:
                out = blur_one_layer(source, labels.required_coc(), profile, plan.quality.merging, plan.highest)
        return out.to(image.dtype)

    def _labels(self, image: Tensor, coc: Tensor | None, depth: Tensor | None, motion: Tensor | None) -> Labels:
        if self.bank is not None:
            return bank_labels(self.bank, image, coc, depth, motion)
        for name, given in (("depth", depth), ("motion", motion)):
            if given is not None:
                raise ValueError(f"{name}: expected None without a bank, got a tensor")
        check_image("image", image, ("B", "C", "H", "W"))
        return Labels(signed_coc(None, image, None, coc))


def blur_one_layer(image: Tensor, coc: Tensor, profile: Profile, merging: Merging | None, highest: int) -> Tensor:
    """Splat ``image (B, C, H, W)`` with ``coc (B, 1, H, W)`` and divide by the coverage.

    Args:
        image: linear radiance.
        coc: signed radius in px.
        profile: the unit shape of the PSF.
        merging: how far to merge by radius; ``None``: not at all.
        highest: the coarsest level to merge on.
    """
    if merging is None:
        out = splat_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, profile, integrate=True)
        return out[:, :-1] / out[:, -1:].clamp_min(TINY)
    return splat_merged(image, coc, profile, merging, highest=highest, ones=True, normalise=True)[:, :-1]
