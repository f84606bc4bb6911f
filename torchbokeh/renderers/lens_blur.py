"""The front door: image and depth in, the picture a lens would take out."""

import sys

import torch
from torch import Tensor, nn

from torchbokeh.compose.colours import Mixture, in_light
from torchbokeh.compose.routes import ROUTES, Pieces
from torchbokeh.compose.surroundings import Surrounding
from torchbokeh.lens.base import Lens
from torchbokeh.ops.checks import check_choice, check_whole, is_number, is_whole
from torchbokeh.ops.spans import subdivide
from torchbokeh.picture.motion import ADVANCE, Displacements
from torchbokeh.picture.request import Background, Optics, Request
from torchbokeh.plan.colours import plan_colours
from torchbokeh.plan.decide import decide
from torchbokeh.plan.look import PlanSettings, look_at
from torchbokeh.plan.plan import Plan
from torchbokeh.plan.quality import check_quality
from torchbokeh.psfs.aperture import Aperture, Disc, parse_aperture
from torchbokeh.renderers.planned import Planned, fitting

MOST = 64
"""Sub-apertures along each direction of the lens, at most."""


class LensBlur(nn.Module):
    """Depth of field: every pixel spreads over its circle of confusion, near surfaces cover far ones.

    A first look at the scene makes a `Plan` of what it needs; only that is done, and what begins to be needed comes
    gradually, so that no picture jumps as a scene changes. A plain image is split into what stands in front of the
    focus plane and the rest, whose hidden part is filled in or given by the caller. Input in layers is taken as it is.
    Every surface is splatted (`torchbokeh.ops.splat.splat_spans`) and composed front to back
    (`torchbokeh.compose.surfaces.compose`), normalised by coverage: a constant image stays constant.

    Half precision is computed in float32, and the result rounded. A pixel that is NaN or infinite spoils its own
    channel of its own picture alone: the rows of its PSF, from there to the right border; with motion, where something
    is filled in or where one convolution does it, all of it.

    Gradients reach all tensors that are passed, and the numbers of lens, dispersion and aperture. At a given plan they
    are the derivatives of what is painted, but for choices, which they take as made:

    * the plan itself (which part is needed and how far, where bins lie), which layers and pixels are not there, with an
      alpha of 0, what counts as a highlight, and which sample of a bank stands for a motion. What is left out, a radius
      or a motion below half a pixel and a radius that ``max_coc`` cuts get 0;
    * where pixels are merged, their shares in two levels, and the rounding of radii to 1/64 of a cell, which is left
      out: the gradient is that of the smooth blur that merging approximates;
    * with ``shutter_depth``, radii come from there; ``depth`` then only says what is in front.

    The backward pass draws PSFs anew: what is kept for it does not grow with them. Second derivatives are
    those of a gradient to the image, as a penalty on it needs; others, forward mode and ``torch.func.grad`` raise a
    RuntimeError that names the operator.

    Args:
        lens: turns depth into signed CoC; may be left out if ``coc=`` is passed to every call.
        aperture: ``"disc"``, ``"N-gon"`` such as ``"6-gon"``, or a `torchbokeh.psfs.Aperture`.
        layers: most soft bins of constant parallax per surface, or ``"auto"``.
        quality: ``"exact"``, ``"high"``, ``"balanced"`` or ``"fast"``. All but the first merge wide PSFs by radius, so
            that more blur costs less (`torchbokeh.ops.merge`); the last two also compose more coarsely, see
            `torchbokeh.plan.quality.Quality`.
        tolerance: relative L1 error of the splats to keep to, as far as it can be predicted; picks the quality instead.
        max_coc: largest radius in px; larger ones are cut to it. ``None``: no limit.
        subapertures: the lens is cut into ``subapertures**2`` pieces that are composed one by one, which keeps the
            relation of coverage and lens position where blurred surfaces overlap. ``"auto"``: at the two best
            qualities, 3 where all that is hidden is known and 2 where it is guessed; 1 where nothing hides anything.
            With motion, the lens is not cut.
        shutter: which moment of the exposure a picture with motion shows: ``"centre"`` or ``"start"``.
        margin: px on each side of the input that lie beyond the sensor, and are cut off in the end: light from there is
            then known at the border. The sensor width of the lens is that of the picture without them.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a value out of its range.

    Example:
        >>> import torch
        >>> import torchbokeh as tb
        >>> blur = tb.LensBlur(tb.ThinLens(0.050, 1.8, focus_distance=2.0, sensor_width=0.036))
        >>> image, depth = torch.rand(1, 3, 32, 48), torch.full((1, 1, 32, 48), 5.0)
        >>> blur(image, depth).shape
        torch.Size([1, 3, 32, 48])
    """

    def __init__(
        self,
        lens: Lens | None = None,
        aperture: str | Aperture = "disc",
        layers: int | str = "auto",
        quality: str = "exact",
        *,
        tolerance: float | None = None,
        max_coc: float | None = None,
        subapertures: int | str = "auto",
        shutter: str = "centre",
        margin: int = 0,
    ) -> None:
        super().__init__()
        if lens is not None and not isinstance(lens, Lens):
            raise TypeError(f"lens: expected a Lens, got {type(lens).__name__}")
        check_quality(quality, tolerance)
        if max_coc is not None and not is_number(max_coc):
            raise TypeError(f"max_coc: expected a number or None, got {max_coc!r}")
        if max_coc is not None and not max_coc > 0:
            raise ValueError(f"max_coc: expected a radius in px above 0, got {max_coc}")
        check_choice("shutter", shutter, ADVANCE)
        self.lens = lens
        self.aperture = parse_aperture(aperture)
        self.layers = _count("layers", layers)
        self.quality = quality
        self.tolerance = tolerance
        self.max_coc = max_coc
        self.subapertures = _count("subapertures", subapertures, MOST)
        self.shutter = shutter
        self.margin = check_whole("margin", margin, 0)

    def extra_repr(self) -> str:
        """The settings, for ``print``."""
        return (
            f"layers={self.layers or 'auto'}, quality={self.quality!r}, tolerance={self.tolerance}, "
            f"max_coc={self.max_coc}, subapertures={self.subapertures or 'auto'}, shutter={self.shutter!r}, "
            f"margin={self.margin}"
        )

    def plan(
        self,
        image: Tensor,
        depth: Tensor | None = None,
        *,
        coc: Tensor | None = None,
        motion: Displacements = None,
        shutter_depth: Tensor | None = None,
        background: Background = None,
    ) -> Plan:
        """Look at a scene once and say what it needs. Arguments are those of `forward`.

        Of a batch it is one plan with all that any of the pictures needs. Two small copies from the device, which a
        forward pass with ``plan=`` saves.
        """
        return self.decide(
            self.request(image, depth, coc=coc, motion=motion, shutter_depth=shutter_depth, background=background)
        )

    def forward(
        self,
        image: Tensor,
        depth: Tensor | None = None,
        *,
        coc: Tensor | None = None,
        motion: Displacements = None,
        shutter_depth: Tensor | None = None,
        background: Background = None,
        plan: Plan | None = None,
    ) -> Tensor:
        """Blur a picture.

        Args:
            image: ``(B, C, H, W)`` linear radiance, any number of channels; or layers ``(B, L, 4, H, W)`` of
                premultiplied RGBA, front to back.
            depth: ``(B, 1, H, W)``, or ``(B, L, 1, H, W)`` for layers: metres (``inf`` is sky) for a `ThinLens`,
                disparity for a `DisparityLens`.
            coc: signed CoC radius in px, in the place of ``depth``.
            motion: displacement (dx, dy) in px over the open shutter, ``(B, 2, H, W)`` or ``(B, L, 2, H, W)``: motion
                blur in the same pass, for which the aperture must be a disc. A sequence of such is a curved way: one
                after the other, each takes an equal part of the exposure.
            shutter_depth: depth (CoC where ``coc`` is passed) of what each pixel shows when the shutter opens and when
                it closes, ``(B, 2, H, W)`` or ``(B, L, 2, H, W)``: what comes nearer is blurred differently on its way.
                The radius changes evenly in time.
            background: what the foreground hides, for a plain image: an image ``(B, C, H, W)``, or a pair of it and
                its depth (its CoC where ``coc`` is passed). Without one it is filled from its surroundings.
            plan: a plan made earlier with `plan`, for all pictures of the batch; they are then not looked at again.
                Without one, each has its own, and is what it would be alone.

        Returns:
            ``(B, C, H, W)``; for layers ``(B, 4, H, W)``, premultiplied. Smaller by the margin, if there is one.

        Raises:
            TypeError: an argument is not a floating-point tensor, or not a `Plan`.
            ValueError: shapes, devices or values do not fit: see the message.
        """
        request = self.request(image, depth, coc=coc, motion=motion, shutter_depth=shutter_depth, background=background)
        if image.numel() == 0:
            return request.answered(image if image.dim() == 4 else image.sum(1))
        requests = request.items() if plan is None else [request]
        plans = [self.decide(one) if plan is None else fitting(plan, Plan, one) for one in requests]
        shapes = [self.pieces(own) for own in plans]  # before the blur, which a compiler then sees whole
        pictures = [
            one.answered(self.paint(one, own, pieces), own.unused(one, pieces[1][0]))
            for one, own, pieces in zip(requests, plans, shapes, strict=True)
        ]
        return torch.cat(pictures) if len(pictures) > 1 else pictures[0]

    def request(
        self,
        image: Tensor,
        depth: Tensor | None = None,
        *,
        coc: Tensor | None = None,
        motion: Displacements = None,
        shutter_depth: Tensor | None = None,
        background: Background = None,
    ) -> Request:
        """Check what `forward` is called with, and turn depth into circles of confusion."""
        request = Request.of(
            Optics(self.lens, self.margin, self.max_coc, self.shutter),
            image,
            depth,
            coc=coc,
            motion=motion,
            shutter_depth=shutter_depth,
            background=background,
        )
        if request.motion and not isinstance(self.aperture, Disc):
            raise ValueError(f"motion: expected None with an aperture that is not a disc, {self.aperture}")
        return request

    def decide(self, request: Request) -> Plan:
        """What a request needs."""
        settings = PlanSettings(self.quality, self.tolerance, self.layers, self.subapertures, repr(self.aperture))
        look = look_at(request, settings)
        return plan_colours(decide(look, settings), look, settings, request)

    def pieces(self, plan: Plan) -> Pieces:
        """The whole aperture and all of its divisions into sub-apertures that occur in a plan."""
        profile = self.aperture.profile()
        return {count: subdivide(profile, count) for count in {1, *plan.cuts}}

    def paint(self, request: Request, plan: Plan, pieces: Pieces) -> Tensor:
        """The picture ``(B, C, H, W)`` of a request, with its margin, in at least float32.

        Args:
            request: as `request` found it good.
            plan: what to do.
            pieces: those of `pieces`.
        """
        mixture, colour = Mixture(), None
        with torch.autocast(request.image.device.type, enabled=False):
            whole = one = request.working()
            for picture in plan.pictures():
                if picture.colour is not colour:
                    colour = picture.colour
                    one = whole if colour is None else in_light(whole, colour)
                around = Surrounding(picture.plan.surrounded)
                part = around.cut(ROUTES[picture.plan.route](around.of(one), picture.plan, pieces))
                mixture.add(part, colour, picture.share, layered=request.layered)
            return mixture.total()

    def planned(self, plan: Plan) -> Planned:
        """The same renderer with its plan fixed, for `torch.export` and the like."""
        return Planned(self, plan)


def _count(name: str, value: int | str, most: int = sys.maxsize) -> int | None:
    """A positive number, or ``None`` for ``"auto"``."""
    if isinstance(value, str) and value == "auto":
        return None
    if not is_whole(value):
        raise TypeError(f"{name}: expected an int or 'auto', got {value!r}")
    return check_whole(name, value, 1, most)
