"""A renderer whose plan is fixed: for compilers and exporters, which see one graph of it."""

from typing import Any, Protocol, TypeVar

from torch import Tensor, nn

from torchbokeh.compose.routes import Pieces
from torchbokeh.picture.request import Request
from torchbokeh.plan.plan import Plan, SplattingPlan

AnyPlan = Plan | SplattingPlan

P = TypeVar("P", bound=AnyPlan)


class PlannedRenderer(Protocol):
    """A renderer that checks a request, decides once what it needs, and paints the picture by that plan."""

    def request(self, *inputs: Any, **maps: Any) -> Request:
        """Check inputs, and turn depth into circles of confusion."""
        ...

    def decide(self, request: Request) -> Any:
        """The plan: what a request needs."""
        ...

    def pieces(self, plan: Any) -> Pieces:
        """The shapes of the aperture that a plan splats with."""
        ...

    def paint(self, request: Request, plan: Any, pieces: Pieces) -> Tensor:
        """The picture of a request, with its margin, in at least float32."""
        ...


def fitting(plan: object, kind: type[P], request: Request) -> P:
    """The plan of a caller's, after a check that it fits.

    Raises:
        TypeError: it is not of the ``kind`` of the renderer.
        ValueError: it was made for other requests.
    """
    if not isinstance(plan, kind):
        raise TypeError(f"plan: expected a {kind.__name__}, got {type(plan).__name__}")
    plan.check(request)
    return plan


class Planned(nn.Module):
    """A renderer that carries out one plan, without a look at its inputs or at the shape of its aperture.

    It is made by `torchbokeh.LensBlur.planned` and `torchbokeh.KernelSplatting.planned`. Whoever passes inputs unlike
    those that the plan was made for gets what the plan says.

    Args:
        renderer: kept as a submodule.
        plan: what to do.
    """

    def __init__(self, renderer: PlannedRenderer, plan: AnyPlan) -> None:
        super().__init__()
        self.renderer, self.plan = renderer, plan
        # Shapes of apertures are made by sorting and searching; they are constants here.
        self.pieces = renderer.pieces(plan)

    def forward(self, *inputs: Tensor, **maps: Any) -> Tensor:
        """Render; arguments and result are those of the renderer, but for ``plan``."""
        request = self.renderer.request(*inputs, **maps)
        picture = self.renderer.paint(request, self.plan, self.pieces)
        return request.answered(picture, self.plan.unused(request, self.pieces[1][0]))
