"""From what single cards show to layers: their order, their number, and what they make together."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchbokeh.scenes.layering import Fragments, assign_layers, flatten, stack_layers

few = settings(deadline=None, max_examples=60)


def fragment(
    top: int, left: int, height: int, width: int, depth: float | Tensor, alpha: float | Tensor = 1.0, seed: int = 0
) -> Fragments:
    generator = torch.Generator().manual_seed(seed)
    rgba = torch.rand(4, height, width, generator=generator)
    rgba[3] = alpha
    rgba[:3] *= rgba[3]
    z = depth if isinstance(depth, Tensor) else torch.full((height, width), depth)
    return Fragments(top, left, rgba, z[None], torch.rand(4, height, width, generator=generator))


def over(layers: Tensor) -> Tensor:
    out = torch.zeros(4, *layers.shape[2:])
    for layer in layers.flip(0):
        out = layer + (1 - layer[3]) * out
    return out


def test_a_card_comes_behind_all_that_cover_it_and_no_further() -> None:
    cards = [
        fragment(0, 0, 4, 4, 5.0),  # behind the next two
        fragment(0, 0, 2, 2, 1.0),
        fragment(1, 1, 2, 2, 2.0),  # behind the one above
        fragment(9, 9, 2, 2, 9.0),  # alone
        fragment(0, 4, 4, 4, 9.0),  # its border touches the first one's, but no pixel is shared
    ]
    assert assign_layers(cards) == ([2, 0, 1, 0, 0], False)


def test_transparent_pixels_cover_nothing() -> None:
    alpha = torch.zeros(4, 4)
    alpha[0, 0] = 0.5
    ring, behind = fragment(0, 0, 4, 4, 1.0, alpha), fragment(1, 1, 2, 2, 2.0)
    assert assign_layers([ring, behind]) == ([0, 0], False)
    assert assign_layers([ring, fragment(0, 0, 2, 2, 2.0)]) == ([0, 1], False)


def test_equal_depths_are_in_the_order_of_the_scene() -> None:
    cards = [fragment(0, 0, 2, 2, 3.0, seed=k) for k in range(3)]
    assert assign_layers(cards) == ([0, 1, 2], False)
    assert torch.equal(stack_layers(cards, None, (2, 2))["image"], cards[0].rgba[:3])


def test_cards_that_cross() -> None:
    slope = torch.linspace(1, 2, 6).expand(3, 6)
    cards = [fragment(0, 0, 3, 6, slope, seed=1), fragment(0, 0, 3, 6, 3 - slope, 0.5, seed=2)]
    assert assign_layers(cards)[1]
    seen = stack_layers(cards, None, (3, 6))
    assert seen["layers"].shape[0] == 2
    for x in range(6):
        front, back = (cards[0], cards[1]) if x < 3 else (cards[1], cards[0])
        for layer, card in zip((0, 1), (front, back), strict=True):
            for name, want in (("layers", card.rgba), ("layer_depth", card.depth), ("layer_motion", card.motion[:2])):
                assert torch.equal(seen[name][layer][:, :, x], want[:, :, x])


def test_a_ring() -> None:
    # a over b in one corner, b over c in another, c over a in a third.
    a, b, c = (torch.full((1, 3), 2.0) for _ in range(3))
    a[0, 0], b[0, 0] = 1.0, 1.5
    b[0, 1], c[0, 1] = 1.0, 1.5
    c[0, 2], a[0, 2] = 1.0, 1.5
    masks = [torch.tensor([[1.0, 0, 1]]), torch.tensor([[1.0, 1, 0]]), torch.tensor([[0.0, 1, 1]])]
    cards = [fragment(0, 0, 1, 3, z, m, seed=k) for k, (z, m) in enumerate(zip((a, b, c), masks, strict=True))]
    for order in itertools.permutations(range(3)):
        seen = stack_layers([cards[k] for k in order], None, (1, 3))
        want = torch.stack([cards[x].rgba[:3, 0, x] for x in range(3)], 1)
        assert torch.equal(seen["image"][:, 0], want)
        assert torch.equal(seen["depth"], torch.ones(1, 1, 3))


@few
@given(seed=st.integers(0, 2**31), count=st.integers(0, 7), most=st.integers(1, 8) | st.none(), rough=st.booleans())
def test_layers_are_the_cards_in_the_order_of_depth(seed: int, count: int, most: int | None, rough: bool) -> None:
    draw = torch.Generator().manual_seed(seed)
    size = (6, 7)
    cards = []
    for k in range(count):
        top, left = (int(torch.randint(0, n - 1, (), generator=draw)) for n in size)
        h = int(torch.randint(1, size[0] - top + 1, (), generator=draw))
        w = int(torch.randint(1, size[1] - left + 1, (), generator=draw))
        depth = 1 + torch.rand(h, w, generator=draw) if rough else 1 + torch.rand((), generator=draw).expand(h, w)
        alpha = torch.rand(h, w, generator=draw) * (torch.rand(h, w, generator=draw) < 0.8)
        alpha[0, 0] = 0.5  # what shows nothing is no fragment
        cards.append(fragment(top, left, h, w, depth, alpha, seed=k))
    seen = stack_layers(cards, most, size)
    assert len(seen["layers"]) <= (count if most is None else min(most, count))
    # All cards, sorted in every pixel.
    rgba, depth = torch.zeros(count, 4, *size), torch.full((count, 1, *size), torch.inf)
    for k, card in enumerate(cards):
        rgba[k][card.place], depth[k][card.place] = card.rgba, card.depth
    order = depth.sort(dim=0, stable=True).indices
    picture = torch.cat([seen["image"], seen["alpha"]])
    torch.testing.assert_close(picture, over(rgba.gather(0, order.expand_as(rgba))), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(picture, over(seen["layers"]), rtol=1e-5, atol=1e-6)
    if most is None:
        there = seen["layers"][:, 3:] > 0
        assert int(there.sum()) == int((rgba[:, 3:] > 0).sum())
        for a, b in itertools.combinations(range(len(there)), 2):
            assert bool((seen["layer_depth"][a] <= seen["layer_depth"][b])[there[a] & there[b]].all())


def test_depth_and_motion_are_those_of_what_is_seen_most_of() -> None:
    rgba = torch.zeros(3, 4, 1, 4)
    # Seen of the three: .4 .6*.8 .12*1 | .6 .32 .08 | .5 .5 0 | 0 0 .3
    rgba[:, 3, 0] = torch.tensor([[0.4, 0.6, 0.5, 0], [0.8, 0.8, 1, 0], [1, 1, 1, 0.3]])
    depth = torch.tensor([1.0, 2.0, 3.0]).view(3, 1, 1, 1).expand(3, 1, 1, 4)
    motion = torch.cat([10 * depth, -depth], 1)
    picture, front, moved = flatten(rgba, depth, motion)
    assert front.flatten().tolist() == [2, 1, 1, 3]
    assert moved[:, 0].T.tolist() == [[20, -2], [10, -1], [10, -1], [30, -3]]
    torch.testing.assert_close(picture[3, 0], torch.tensor([1.0, 1.0, 1.0, 0.3]))


@pytest.mark.parametrize("count", [0, 2])
def test_nothing_seen_is_infinitely_far_and_still(count: int) -> None:
    rgba, depth = torch.zeros(count, 4, 2, 3), torch.ones(count, 1, 2, 3)
    picture, front, moved = flatten(rgba, depth, torch.ones(count, 2, 2, 3))
    assert picture.shape == (4, 2, 3)
    assert front.shape == (1, 2, 3)
    assert not picture.any()
    assert not moved.any()
    assert bool(front.isposinf().all())


def test_no_cards() -> None:
    seen = stack_layers([], 3, (2, 3))
    assert seen["layers"].shape == (0, 4, 2, 3)
    assert seen["image"].shape == (3, 2, 3)
    assert bool(seen["depth"].isposinf().all())
