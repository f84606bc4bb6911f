"""What is compared: every way to blur one layer is a `Method`, image and CoC in, image out."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

import torchbokeh
from torchbokeh.report.internals import QUALITY_NAMES
from torchbokeh.report.rows import OWN

Blur = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Method:
    """One way to blur a picture as one layer.

    Attributes:
        name: for tables and plots.
        family: methods of one family share a colour in plots.
        description: one line that says what it does and at which settings.
        run: ``(image (1, 3, H, W), coc (1, 1, H, W)) -> (1, 3, H, W)``, on ``torch.get_num_threads()`` threads.
        work: seconds that a thread of a common processor takes, about, for a CoC map. It decides what a report leaves
            out as too slow, nothing else.
        normalised: whether a constant image stays constant.
        one_depth: only for CoC maps that are the same everywhere.
    """

    name: str
    family: str
    description: str
    run: Blur
    work: Callable[[Tensor], float]
    normalised: bool = True
    one_depth: bool = False

    def obstacle(self, coc: Tensor, cap: float) -> str | None:
        """Why this method is not run on a CoC map, in one line; None where it is.

        Args:
            coc: ``(1, 1, H, W)``.
            cap: seconds that one run may take.
        """
        if self.one_depth and coc.max() - coc.min() > 1e-3:
            return "takes one blur radius for the whole picture"
        seconds = self.work(coc) / torch.get_num_threads()
        if seconds > cap:
            return f"would take about {seconds:.2g} s, more than the limit of {cap:g} s"
        return None


def own_methods() -> dict[str, Method]:
    """The operating points of this package's one-layer splat, from exact to fast."""
    return {own_name(quality): _own(quality) for quality in QUALITY_NAMES}


def own_name(quality: str) -> str:
    """What the operating point of a quality is called."""
    return f"{OWN} {quality}"


def _own(quality: str) -> Method:
    splatting = torchbokeh.KernelSplatting(aperture="disc", quality=quality)

    def work(coc: Tensor) -> float:
        return coc.numel() * 4e-9 * (20 + 2 * coc.abs().mean().item())  # at most: two points for every row of a disc

    def blur(image: Tensor, coc: Tensor) -> Tensor:
        # Like the others, and the reference: what lies beyond the border is not known, lights or not.
        return splatting(image, coc, plan=replace(splatting.plan(image, coc), surrounded=0, lit=0.0))

    how = "two points for every row of a disc" + ("" if quality == "exact" else ", wide discs merged by radius")
    return Method(own_name(quality), OWN, f"KernelSplatting(quality={quality!r}): {how}", blur, work)
