"""Training of the integration network: kernels of a pyramid that undo the 5-point Laplacian."""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.learn.integration import PyramidIntegrator

LEVELS = 5
"""Finest levels that have kernels of their own, the last of them for all that are coarser."""

KINDS = ("discs", "noise", "smooth", "spikes")

SIZES = (40, 64, 128)
"""Sides of the pictures in px."""

ITERATIONS = 60
"""Of L-BFGS in each step of the training."""

MARGIN = 12
"""Empty pixels around every picture: what is integrated vanishes on its border, and the far field is seen."""


def laplacian_pictures(kind: str, count: int, size: int, seed: int) -> Tensor:
    """Pictures whose Laplacians a pyramid has to integrate, with `MARGIN` empty pixels around.

    Args:
        kind: one of `KINDS`: overlapping discs, white noise, smooth noise, or noise with a few HDR spikes.
        count: how many.
        size: of their sides in px, at least 8.
        seed: of the random numbers.

    Returns:
        ``(1, count, size + 2 MARGIN, size + 2 MARGIN)``, double.

    Raises:
        ValueError: an unknown kind.

    Example:
        >>> laplacian_pictures("discs", 2, 16, seed=0).shape
        torch.Size([1, 2, 40, 40])
    """
    draw = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=draw, dtype=torch.float64)

    if kind == "discs":
        at = torch.arange(size, dtype=torch.float64)
        y, x, radius, height = (t[..., None, None] for t in uniform(4, count, 6))
        away = torch.hypot(at[:, None] - size * y, at - size * x)
        found = ((away < 2 + size / 4 * radius) * height).sum(1)
    elif kind == "noise":
        found = uniform(count, size, size)
    elif kind == "smooth":
        found = F.interpolate(uniform(1, count, size // 8, size // 8), size=(size, size), mode="bicubic")[0]
    elif kind == "spikes":
        found = 0.3 * uniform(count, size, size)
        found.flatten(1).scatter_(1, torch.randint(size * size, (count, 5), generator=draw), 100.0)
    else:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    return F.pad(found[None], (MARGIN,) * 4)


def relative_errors(integrator: Callable[[Tensor], Tensor], pictures: Tensor) -> tuple[float, float]:
    """How far an integrator is from pictures ``(1, N, H, W)`` whose Laplacians it is given.

    Returns:
        The relative L1 error, the mean over pictures; and the far field: the mean of what it leaves in the empty
        margin, relative to the mean of the picture within.
    """
    from torchbokeh.ops.integrate import laplacian

    with torch.no_grad():
        off = (integrator(laplacian(pictures)) - pictures).abs()
    outside = torch.ones_like(pictures[:1, :1])
    outside[..., MARGIN:-MARGIN, MARGIN:-MARGIN] = 0
    inside = 1 - outside
    size = pictures.abs().sum((2, 3))
    far = (off * outside).sum((2, 3)) / outside.sum() / (size / inside.sum())
    return float((off.sum((2, 3)) / size).mean()), float(far.mean())


def fit_integrator(
    levels: int = LEVELS, steps: int = 30, seed: int = 0, sizes: Sequence[int] = SIZES
) -> Iterator[tuple[float, PyramidIntegrator]]:
    """Fit the kernels of a pyramid by L-BFGS, from the published ones, to pictures of all `KINDS`.

    The loss of a picture is its relative error, the mean of L1 and of the square of L2. Everything is in double.

    Args:
        levels: how many levels have kernels of their own.
        steps: of `ITERATIONS` iterations each.
        seed: of the pictures.
        sizes: of their sides in px.

    Yields:
        After every step the loss, and the pyramid, which goes on changing.

    Raises:
        ValueError: ``levels`` is not positive.

    Example:
        >>> losses = [loss for loss, _ in fit_integrator(levels=1, steps=2, sizes=[16])]
        >>> losses[1] < losses[0]
        True
    """
    if levels < 1:
        raise ValueError(f"levels: expected at least 1, got {levels}")
    pyramid = PyramidIntegrator("published").double()
    pyramid.h1, pyramid.h2, pyramid.g = (
        torch.nn.Parameter(F.pad(kernel.detach(), (0, 6 - kernel.shape[1])).repeat(levels, 1))
        for kernel in (pyramid.h1, pyramid.h2, pyramid.g)
    )
    largest = max(sizes) + 2 * MARGIN
    groups = [laplacian_pictures(kind, 3, size, seed + 10 * size + k) for size in sizes for k, kind in enumerate(KINDS)]
    pictures = torch.cat([F.pad(g, (0, largest - g.shape[3], 0, largest - g.shape[2])) for g in groups], 1)
    buffers, size = pyramid.differentiate(pictures), pictures.abs().sum((2, 3))
    energy = pictures.square().sum((2, 3))
    optimizer = torch.optim.LBFGS(pyramid.parameters())

    def closure() -> Tensor:
        optimizer.zero_grad()
        off = pyramid(buffers) - pictures
        loss = (off.square().sum((2, 3)) / energy + off.abs().sum((2, 3)) / size).mean()
        loss.backward()
        return loss.detach()

    for _ in range(steps):
        # A new one at every step: from its old curvatures the search sometimes finds no way on.
        optimizer = torch.optim.LBFGS(
            pyramid.parameters(), max_iter=ITERATIONS, history_size=ITERATIONS, line_search_fn="strong_wolfe"
        )
        yield float(optimizer.step(closure)), pyramid
