"""The front door: image and depth in, the picture a lens would take out."""

from collections.abc import Mapping, Sequence
from functools import partial
from numbers import Real

import torch
from torch import Tensor, nn

from torchbokeh.compose.colours import Given, blur_colours, plan_colours
from torchbokeh.compose.surfaces import (
    COARSE,
    Moving,
    Surface,
    compose,
    foreground_over_rest,
    split_foreground,
)
from torchbokeh.lens import Lens
from torchbokeh.ops.checks import check_image
from torchbokeh.ops.convolve import blur_uniform, blur_with
from torchbokeh.ops.dispatch import compute_dtype, has_kernel
from torchbokeh.ops.spans import Profile, subdivide
from torchbokeh.picture.coc import signed_coc, signed_map
from torchbokeh.picture.motion import ADVANCE, Motion, check_motion, look_at_motion, moving_picture, ways
from torchbokeh.plan.decide import Wishes, decide, look_at
from torchbokeh.plan.plan import Plan
from torchbokeh.plan.quality import check_quality
from torchbokeh.psfs.aperture import Aperture, Disc, parse_aperture
from torchbokeh.psfs.combined import STILL, turned_capsule
from torchbokeh.renderers.kernel_splatting import blur_one_layer

Background = Tensor | tuple[Tensor, Tensor] | None

Pieces = Mapping[int, Sequence[Profile]]

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

    The backward pass draws PSFs anew: what is kept for it does not grow with them. There are no second derivatives.

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
        if max_coc is not None and (not isinstance(max_coc, Real) or isinstance(max_coc, bool)):
            raise TypeError(f"max_coc: expected a number or None, got {max_coc!r}")
        if max_coc is not None and not max_coc > 0:
            raise ValueError(f"max_coc: expected a radius in px above 0, got {max_coc}")
        if not isinstance(shutter, str) or shutter not in ADVANCE:
            raise ValueError(f"shutter: expected one of {', '.join(map(repr, ADVANCE))}, got {shutter!r}")
        self.lens = lens
        self.aperture = parse_aperture(aperture)
        self.layers = _count("layers", layers)
        self.quality = quality
        self.tolerance = tolerance
        self.max_coc = max_coc
        self.subapertures = _count("subapertures", subapertures)
        if self.subapertures is not None and self.subapertures > MOST:
            raise ValueError(f"subapertures: expected at most {MOST}, got {subapertures}")
        self.shutter = shutter
        self.margin = margin if margin == 0 and not isinstance(margin, bool) else _whole("margin", margin)

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
        motion: Motion = None,
        shutter_depth: Tensor | None = None,
        background: Background = None,
    ) -> Plan:
        """Look at a scene once and say what it needs. Arguments are those of `forward`.

        One small copy from the device, which a forward pass with ``plan=`` saves.
        """
        given, cut = self._inputs(image, depth, coc, (motion, shutter_depth), background)
        return self._plan(given, cut)

    def _plan(self, given: Given, cut: Tensor | None) -> Plan:
        known = given.behind is not None
        wishes = Wishes(self.quality, self.tolerance, self.layers, self.subapertures, repr(self.aperture), known)
        look = look_at(given.image, given.signed, cut, wishes)
        moves = look_at_motion(given.image, given.motion, given.ends)
        plan = decide(look, moves, wishes)
        if self.lens is None:
            return plan
        margin, limit = self.margin, self.max_coc
        return plan_colours(plan, look, moves, wishes, self.lens, given.signed, margin=margin, limit=limit)

    def forward(
        self,
        image: Tensor,
        depth: Tensor | None = None,
        *,
        coc: Tensor | None = None,
        motion: Motion = None,
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
            plan: a plan made earlier with `plan`; the scene is then not looked at again. A batch shares one plan, so
                pictures and gradients depend a little on what else is in it: with the same plan for all, those of
                several processes are those of one with the whole batch.

        Returns:
            ``(B, C, H, W)``; for layers ``(B, 4, H, W)``, premultiplied. Smaller by the margin, if there is one.

        Raises:
            TypeError: an argument is not a floating-point tensor, or not a `Plan`.
            ValueError: shapes, devices or values do not fit: see the message.
        """
        given, cut = self._inputs(image, depth, coc, (motion, shutter_depth), background)
        if image.numel() == 0:
            return self._cropped(image.clone() if image.dim() == 4 else image.sum(1))
        if plan is None:
            plan = self._plan(given, cut)
        self._check_plan(plan, given)
        profile = self.aperture.profile()
        out = self._blur(given, plan, {count: subdivide(profile, count) for count in plan.cuts})
        return self._cropped(_tied(out, given, plan, profile)).to(image.dtype)

    def _blur(self, given: Given, plan: Plan, pieces: Pieces) -> Tensor:
        """The picture ``(B, C, H, W)``, as mixed from plans.

        Args:
            given: the picture and its maps.
            plan: what to do.
            pieces: the sub-apertures, by how many there are each way.
        """
        if plan.colours:
            assert self.lens is not None
            blur = partial(self._of_one_light, pieces=pieces)
            own = blur_colours(given, plan, self.lens, blur, margin=self.margin, limit=self.max_coc)
        else:
            own = self._painted(given, plan, pieces[plan.subapertures])
        out = own
        for other, share in plan.fading:
            out = out + share * (self._blur(given, other, pieces) - own)
        return out

    def _of_one_light(self, given: Given, plan: Plan, pieces: Pieces) -> Tensor:
        return _tied(self._blur(given, plan, pieces), given, plan, self.aperture.profile())

    def _painted(self, given: Given, plan: Plan, pieces: Sequence[Profile]) -> Tensor:
        """The picture by one plan alone, of one light, or of all where they are blurred alike."""
        image, signed, motion, ends, behind = given
        moves = motion if plan.moves else None
        ends = ends if plan.approaches else None
        if plan.sharp and not signed.requires_grad:
            return image.clone()
        asked = any(t.requires_grad for t in (signed, *ways(moves)))
        dtype = compute_dtype(signed, image)
        with torch.autocast(image.device.type, enabled=False):
            merging, coarse = plan.quality.merging, plan.quality.coarse
            source, radii = image.to(dtype).contiguous(), signed.to(dtype).contiguous()
            still = moves is None and ends is None
            moving = partial(moving_picture, image, moves, ends, plan.parts, self.shutter)
            if image.dim() == 5:
                colour, cover = source[:, :, :-1], source[:, :, -1:]
                opaque = () if image.requires_grad else plan.opaque
                surfaces = [
                    Surface(colour[:, k], None if k in opaque else cover[:, k], radii[:, k], bins, moving(k))
                    for k, bins in zip(plan.layers, plan.bins, strict=True)
                ]
                if not (coarse and still):
                    surfaces = [s.continued() for s in surfaces]
                if not surfaces:
                    return torch.zeros_like(source[:, 0])
                return torch.cat(compose(surfaces, pieces, merging, plan.highest, coarse=coarse), 1)
            if plan.uniform is not None and not asked:
                return self._convolved(source, plan, plan.uniform)
            if len(plan.bins) == 2:
                return self._over_rest(source, radii, behind, plan, pieces, moving())
            if still and len(plan.bins[0]) == 1 and len(pieces) == 1:
                return blur_one_layer(source, radii, pieces[0], merging, plan.highest)
            surface = Surface(source, None, radii, plan.bins[0], moving())
            return compose([surface], pieces, merging, plan.highest)[0]

    def _cropped(self, out: Tensor) -> Tensor:
        height, width = out.shape[-2:]
        return out[..., self.margin : max(height - self.margin, 0), self.margin : max(width - self.margin, 0)]

    def _convolved(self, image: Tensor, plan: Plan, radius: float) -> Tensor:
        if not plan.moves or plan.pan is None:
            return blur_uniform(image, radius, self.aperture.profile())
        # What lies farther away than the picture is large need not be drawn.
        height, width = image.shape[-2:]
        psf = torch.from_numpy(turned_capsule(abs(radius), plan.pan, ADVANCE[self.shutter], (width - 1, height - 1)))
        return blur_with(image, psf[None, None].to(image))

    def _over_rest(
        self,
        image: Tensor,
        radii: Tensor,
        behind: tuple[Tensor, Tensor | None] | None,
        plan: Plan,
        pieces: Sequence[Profile],
        moving: Moving | None,
    ) -> Tensor:
        coarse, merging = plan.quality.coarse, plan.quality.merging
        asked = torch.is_grad_enabled() and any(
            t.requires_grad for t in (image, radii, pieces[0].knots, pieces[0].bulge)
        )
        simple = behind is None and moving is None and len(pieces) == 1 and image.shape[1] <= 3 and not asked
        if merging is not None and coarse and simple and has_kernel(image):
            return foreground_over_rest(image.detach(), radii.detach(), plan.bins, pieces[0], merging, plan.highest)
        surfaces = split_foreground(image, radii, behind, plan.bins, COARSE if coarse else 1, moving)
        return compose(surfaces, pieces, merging, plan.highest, coarse=coarse)[0]

    def _inputs(
        self,
        image: Tensor,
        depth: Tensor | None,
        coc: Tensor | None,
        moves: tuple[Motion, Tensor | None],
        background: Background,
    ) -> tuple[Given, Tensor | None]:
        """Check everything; return it with its signed CoC, and where ``max_coc`` cut that."""
        layered = isinstance(image, Tensor) and image.dim() == 5
        check_image("image", image, ("B", "L", 4, "H", "W") if layered else ("B", "C", "H", "W"))
        if image.numel() and 2 * self.margin >= min(image.shape[-2:]):
            raise ValueError(f"margin: expected less than half of {tuple(image.shape[-2:])}, got {self.margin}")
        signed = signed_coc(self.lens, image, depth, coc, self.margin)
        limit = self.max_coc
        cut = None if limit is None else signed.abs() > limit
        signed = signed if limit is None else signed.clamp(-limit, limit)
        if self.lens is not None and self.lens.dispersion is not None and image.shape[1] != 3 and not layered:
            raise ValueError(f"image: expected 3 channels for a lens with dispersion, got {image.shape[1]}")
        motion, shutter_depth = moves
        is_coc = coc is not None
        ends = None
        if shutter_depth is not None:
            signed_ends = partial(signed_map, self.lens, image, "shutter_depth", is_coc=is_coc, channels=2)
            ends = signed_ends(shutter_depth, margin=self.margin)
            ends = ends if limit is None else ends.clamp(-limit, limit)
        check_motion(image, motion)
        if (motion is not None or ends is not None) and not isinstance(self.aperture, Disc):
            raise ValueError(f"motion: expected None with an aperture that is not a disc, {self.aperture}")
        if background is None:
            return Given(image, signed, motion, ends, None), cut
        if layered:
            raise ValueError("background: expected None for layers (make it the last layer), got a background")
        pair = background if isinstance(background, tuple) else (background, None)
        if len(pair) != 2:
            raise ValueError(f"background: expected an image or a pair of it and its depth, got {len(pair)} values")
        colour, behind = pair
        check_image("background", colour, tuple(image.shape), like=image)
        if behind is not None:
            behind = signed_map(self.lens, image, "background[1]", behind, is_coc=is_coc, margin=self.margin)
            behind = behind if limit is None else behind.clamp(-limit, limit)
        return Given(image, signed, motion, ends, (colour, behind)), cut

    @staticmethod
    def _check_plan(plan: Plan, given: Given) -> None:
        if not isinstance(plan, Plan):
            raise TypeError(f"plan: expected a Plan, got {type(plan).__name__}")
        image = given.image
        known = all(isinstance(n, int) for n in image.shape)  # an export may leave the size open
        if known and plan.size != tuple(image.shape[-2:]):
            raise ValueError(f"plan: expected one for size {tuple(image.shape[-2:])}, got one for {plan.size}")
        if plan.motion > STILL[0] and given.motion is None:
            raise ValueError("plan: expected the motion it was made with, got none")
        if plan.approaches and given.ends is None:
            raise ValueError("plan: expected the shutter_depth it was made with, got none")
        count = image.shape[1] if image.dim() == 5 else 0
        if plan.layer_count != count:
            raise ValueError(f"plan: expected one for {count} layers, got one for {plan.layer_count}")
        if plan.hidden in ("filled", "given") and (plan.hidden == "given") != (given.behind is not None):
            raise ValueError(f"plan: expected the background it was made with ({plan.hidden}), got another")


def _tied(out: Tensor, given: Given, plan: Plan, profile: Profile) -> Tensor:
    """The picture, with a gradient of 0, and not of None, to what the plan leaves out.

    Among scenes that are trained on there may be one that stands still, or is sharp all over.
    """
    if not torch.is_grad_enabled():
        return out
    left_out = [] if plan.moves else [*ways(given.motion)]
    if given.ends is not None:
        left_out.append(given.signed if plan.approaches else given.ends)
    if plan.sharp:
        left_out += profile
    if plan.layer_count and not plan.layers:
        left_out += [given.image, given.signed]
    for t in left_out:
        if t.requires_grad:
            out = out + t[None][:0].sum()  # nothing of it: not even what is infinite counts
    return out


def _count(name: str, value: int | str) -> int | None:
    """A positive number, or ``None`` for ``"auto"``."""
    return None if isinstance(value, str) and value == "auto" else _whole(name, value, " or 'auto'")


def _whole(name: str, value: object, other: str = "") -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise TypeError(f"{name}: expected an int{other}, got {value!r}")
    if value < 1:
        raise ValueError(f"{name}: expected at least 1, got {value}")
    return value
