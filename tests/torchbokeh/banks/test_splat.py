"""Splats from a bank against dense PSFs, their properties, and the keywords of `KernelSplatting` that are for banks."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchbokeh import KernelSplatting, Polygon
from torchbokeh.banks.splat import packed, splat_bank, unpacked
from torchbokeh.ops.capsules import _density
from torchbokeh.ops.merge import Merging
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Combined, Disc, Labels, PsfBank
from torchbokeh.psfs.combined import capsule
from torchbokeh.psfs.represent import Represented, Target, laplacian, nonzero

F64 = torch.float64


@pytest.fixture(scope="module")
def bank() -> PsfBank:
    return PsfBank.load("combined")


def scene(h: int, w: int, radius: float, dx: float, dy: float, dtype: torch.dtype = torch.float32) -> Labels:
    motion = torch.tensor([dx, dy], dtype=dtype).view(1, 2, 1, 1).expand(1, 2, h, w).contiguous()
    return Labels(coc=torch.full((1, 1, h, w), radius, dtype=dtype), motion=motion)


def mixed(
    h: int, w: int, reach: float, length: float, seed: int = 0, dtype: torch.dtype = F64
) -> tuple[Tensor, Labels]:
    draw = torch.Generator().manual_seed(seed)
    values = torch.rand(1, 4, h, w, dtype=dtype, generator=draw)
    coc = reach * (2 * torch.rand(1, 1, h, w, dtype=dtype, generator=draw) - 1)
    motion = length * (2 * torch.rand(1, 2, h, w, dtype=dtype, generator=draw) - 1)
    return values, Labels(coc=coc, motion=motion)


def dot(n: int) -> Tensor:
    values = torch.zeros(1, 1, n, n)
    values[0, 0, n // 2, n // 2] = 1.0
    return values


def turned_capsule(radius: float, length: float, angle: float, n: int, fine: int = 5) -> np.ndarray:
    """A dense capsule, sampled at ``fine**2`` places of each pixel."""
    at = (np.arange(n * fine) + 0.5) / fine - n / 2
    x, y = np.meshgrid(at, at)
    along, across = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    chord = np.sqrt(np.maximum(radius**2 - across**2, 0))
    overlap = np.minimum(along + length / 2, chord) - np.maximum(along - length / 2, -chord)
    picture = np.maximum(overlap, 0).reshape(n, fine, n, fine).mean((1, 3))
    return picture / picture.sum()


@pytest.mark.parametrize(
    ("radius", "length", "error", "gain"),
    # Thin ones suffer most from what is shared by four pixels.
    [(6.0, 9.0, 0.15, 0.002), (3.0, 25.0, 0.28, 0.01), (12.0, 40.0, 0.08, 0.002), (1.0, 30.0, 0.4, 0.03)],
)
@pytest.mark.parametrize("angle", [0.0, 0.5, math.pi / 2, 2.5])
def test_a_dot_in_motion_is_a_capsule(
    bank: PsfBank, radius: float, length: float, error: float, gain: float, angle: float
) -> None:
    n = 101
    labels = scene(n, n, radius, length * math.cos(angle), length * math.sin(angle))
    got = splat_bank(dot(n), labels, bank)[0, 0].double().numpy()
    want = turned_capsule(radius, length, angle, n)
    assert got.sum() == pytest.approx(1, abs=gain)
    assert np.abs(got - want).sum() < error
    centre = np.arange(n) - n // 2
    for axis in (0, 1):
        assert abs(got.sum(axis) @ centre) < 0.05
    # The variance gives length and direction back.
    along = centre[None] * math.cos(angle) + centre[:, None] * math.sin(angle)
    assert (got * along**2).sum() / got.sum() == pytest.approx(radius**2 / 4 + length**2 / 12, rel=0.14, abs=0.4)


def test_interpolation_is_nearer_than_the_nearest_sample(bank: PsfBank) -> None:
    n, errors = 161, []
    want = turned_capsule(14.3, 47.0, 0.0, n)
    for interpolate in (False, True):
        got = splat_bank(dot(n), scene(n, n, 14.3, 47.0, 0.0), bank, interpolate=interpolate)[0, 0].double().numpy()
        errors.append(np.abs(got - want).sum())
    assert errors[1] < errors[0]


def test_what_stands_still_is_a_disc(bank: PsfBank) -> None:
    values, labels = mixed(20, 30, 6.0, 0.3)
    got = splat_bank(values, labels, bank)
    want = splat_spans(values, labels.coc, Disc().profile(), integrate=True)
    torch.testing.assert_close(got, want)


def test_a_sign_of_motion_changes_nothing(bank: PsfBank) -> None:
    values, labels = mixed(20, 24, 5.0, 12.0)
    back = labels._replace(motion=-labels.motion)
    torch.testing.assert_close(splat_bank(values, labels, bank), splat_bank(values, back, bank), atol=1e-9, rtol=0)


def test_it_is_linear_and_its_gradient_is_the_adjoint(bank: PsfBank) -> None:
    values, labels = mixed(18, 22, 7.0, 20.0)
    other, aim = torch.rand_like(values), torch.rand_like(values)
    both = splat_bank(values - 2 * other, labels, bank)
    torch.testing.assert_close(both, splat_bank(values, labels, bank) - 2 * splat_bank(other, labels, bank))
    asked = values.clone().requires_grad_()
    (grad,) = torch.autograd.grad((aim * splat_bank(asked, labels, bank)).sum(), asked)
    torch.testing.assert_close((grad * other).sum(), (aim * splat_bank(other, labels, bank)).sum())


def test_what_is_kept_from_inference_can_be_trained_with() -> None:
    with torch.inference_mode():
        bank = PsfBank.load("combined")
        values, labels = mixed(9, 10, 4.0, 9.0, dtype=torch.float32)
        splat_bank(values, labels, bank)
    values, labels = mixed(9, 10, 4.0, 9.0, dtype=torch.float32)
    asked = [t.clone().requires_grad_() for t in (values, labels.coc, labels.motion)]
    splat_bank(asked[0], Labels(coc=asked[1], motion=asked[2]), bank).square().sum().backward()
    assert all(t.grad.isfinite().all() for t in asked)


def test_with_interpolation_gradients_reach_radius_and_motion(bank: PsfBank) -> None:
    values, labels = mixed(9, 10, 4.0, 9.0, seed=4)
    aim = torch.rand_like(values)
    coc, motion = (t.clone().requires_grad_() for t in (labels.coc, labels.motion))

    def loss(coc: Tensor, motion: Tensor) -> Tensor:
        return (aim * splat_bank(values, Labels(coc=coc, motion=motion), bank, interpolate=True)).sum()

    grads = torch.autograd.grad(loss(coc, motion), [coc, motion])
    assert all(float(g.abs().max()) > 1e-3 for g in grads)
    draw = torch.Generator().manual_seed(2)
    for k, grad in enumerate(grads):
        step = torch.rand(grad.shape, dtype=F64, generator=draw) - 0.5
        near = []
        for e in (1e-6, -1e-6):
            maps = [labels.coc, labels.motion]
            maps[k] = maps[k] + e * step
            near.append(loss(*maps).item())
        assert (near[0] - near[1]) / 2e-6 == pytest.approx((grad * step).sum().item(), rel=2e-3)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("highest", [0, 1])
def test_a_highlight_has_no_ripples(bank: PsfBank, dtype: torch.dtype, highest: int) -> None:
    values, labels = torch.ones(1, 2, 90, 100, dtype=dtype), scene(90, 100, 9.3, 20.0, 12.0, dtype)
    values[0, 0, 45, 50] = 1e6
    merging = Merging(4.0, 0.015) if highest else None
    out = splat_bank(values, labels, bank, merging, highest=highest)
    plain = splat_bank(torch.ones_like(values), labels, bank, merging, highest=highest)
    lit = out[0, 0] - plain[0, 0]
    assert float(lit.min()) > -0.6  # what the pixel itself would have spread
    far = torch.cat([lit[:10].flatten(), lit[-10:].flatten(), lit[:, :10].flatten(), lit[:, -10:].flatten()])
    assert float(far.abs().max()) < 1e-3
    assert float(lit.sum()) == pytest.approx(1e6, rel=1e-4)
    torch.testing.assert_close(out[0, 1], plain[0, 1], atol=2e-2, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_merging_changes_little(bank: PsfBank, dtype: torch.dtype) -> None:
    values, labels = mixed(72, 96, 1.0, 8.0, dtype=dtype)
    x = torch.linspace(4, 24, 96, dtype=dtype).expand(1, 1, 72, 96).contiguous()
    labels = labels._replace(coc=x, motion=torch.cat([x, 0.5 * x], 1))
    exact = splat_bank(values, labels, bank)
    merged = splat_bank(values, labels, bank, Merging(4.0, 0.015), highest=2)
    assert float((merged - exact).abs().sum() / exact.abs().sum()) < 0.03
    assert not torch.equal(merged, exact)


def test_float32_is_near_float64(bank: PsfBank) -> None:
    values, labels = mixed(30, 40, 12.0, 30.0)
    single = splat_bank(values.float(), Labels(*(None if t is None else t.float() for t in labels)), bank)
    double = splat_bank(values, labels, bank)
    assert float((single - double).abs().max()) < 2e-4  # some pixels take another sample, as their labels are rounded


def test_a_row_of_segments_is_the_whole_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Combined, "extent", lambda self, coordinates: None)
    model = Combined(radius=8.0, length=16.0)
    psf = capsule(4.0, 16.0)
    whole = Represented("laplacian", nonzero(laplacian(psf)))
    bank = PsfBank(model, [whole] * len(model.grid))
    n = 81
    got = splat_bank(dot(n), scene(n, n, 4.0, 48.0, 0.0), bank)[0, 0].double().numpy()
    want = np.zeros((n, n))
    long = capsule(4.0, 48.0)[0]
    y, x = (n - long.shape[0]) // 2, (n - long.shape[1]) // 2
    want[y : y + long.shape[0], x : x + long.shape[1]] = long
    assert np.abs(got - want).max() < 1e-4 * want.max() + 1e-7


def test_averages_of_motion_do_not_cancel() -> None:
    motion = torch.tensor([[3.0, -3.0, 0.0, 1e-9], [4.0, -4.0, 2.0, 0.0]], dtype=F64).view(1, 2, 1, 4)
    labels = Labels(coc=torch.ones(1, 1, 1, 4, dtype=F64), motion=motion)
    again = unpacked(labels.coc, packed(labels), labels).motion
    cross = again[:, 0] * motion[:, 1] - again[:, 1] * motion[:, 0]
    assert float(cross.abs().max()) < 1e-6
    torch.testing.assert_close(again.norm(dim=1), motion.norm(dim=1), atol=2e-6, rtol=1e-9)
    both = packed(labels)[..., :2].mean(-1, keepdim=True)
    torch.testing.assert_close(
        unpacked(labels.coc[..., :1], both, labels).motion.abs().flatten(), torch.tensor([3.0, 4.0], dtype=F64)
    )
    depth = torch.tensor([[[[2.0, torch.inf]]]])
    with_depth = Labels(coc=depth, depth=depth)
    assert unpacked(depth, packed(with_depth), with_depth).depth[0, 0, 0, 0] == 2
    with pytest.raises(ValueError, match=r"labels\.coc: expected one"):
        splat_bank(
            torch.ones(1, 1, 1, 1),
            Labels(depth=torch.ones(1, 1, 1, 1)),
            PsfBank.load("combined"),
            Merging(4, 1),
            highest=1,
        )


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_constant_in_constant_out(bank: PsfBank, quality: str) -> None:
    _, labels = mixed(40, 50, 9.0, 20.0, dtype=torch.float32)
    blur = KernelSplatting(bank=bank, quality=quality)
    out = blur(torch.full((1, 3, 40, 50), 0.7), labels.coc, motion=labels.motion)
    torch.testing.assert_close(out, torch.full_like(out, 0.7), atol=1e-5, rtol=0)


def test_the_module_is_its_function(bank: PsfBank) -> None:
    values, labels = mixed(40, 50, 9.0, 20.0, dtype=torch.float32)
    image = values[:, :3]
    covered = torch.cat([image, torch.ones_like(image[:, :1])], 1)
    for interpolate in (False, True):
        blur = KernelSplatting(bank=bank, quality="exact", interpolate=interpolate)
        out = splat_bank(covered, labels, bank, interpolate=interpolate)
        torch.testing.assert_close(blur(image, labels.coc, motion=labels.motion), out[:, :3] / out[:, 3:])
        plan = blur.plan(image, labels.coc, motion=labels.motion)
        assert not plan.sharp
        again = blur(image, labels.coc, motion=labels.motion, plan=plan)
        assert torch.equal(again, blur(image, labels.coc, motion=labels.motion))
    merged = KernelSplatting(bank=bank, quality="fast")
    plan = merged.plan(image, 4 * labels.coc, motion=labels.motion)
    assert plan.highest == 1
    out = splat_bank(covered, labels._replace(coc=4 * labels.coc), bank, plan.quality.merging, highest=1)
    torch.testing.assert_close(merged(image, 4 * labels.coc, motion=labels.motion), out[:, :3] / out[:, 3:])


def test_what_is_refused(bank: PsfBank) -> None:
    image, coc = torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 8, 8)
    with pytest.raises(TypeError, match="bank: expected a PsfBank or None, got str"):
        KernelSplatting(bank="combined")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="aperture: expected none beside a bank"):
        KernelSplatting(Polygon(5), bank=bank)
    with pytest.raises(ValueError, match="motion: expected None without a bank"):
        KernelSplatting()(image, coc, motion=torch.zeros(1, 2, 8, 8))
    with pytest.raises(ValueError, match=r"motion: expected shape \(1, 2, 8, 8\), got \(1, 1, 8, 8\)"):
        KernelSplatting(bank=bank)(image, coc, motion=coc)
    with pytest.raises(ValueError, match="combined: expected coc and motion, got no motion"):
        KernelSplatting(bank=bank)(image, coc)
    with pytest.raises(ValueError, match="combined: expected coc and motion, got no coc"):
        KernelSplatting(bank=bank).plan(image, motion=torch.zeros(1, 2, 8, 8))
    wide = torch.full((1, 2, 8, 8), 6e4).half()
    wide[:, 1] = -6e4  # finite, though their difference is infinite in half precision
    KernelSplatting(bank=bank).plan(image.half(), coc.half(), motion=wide)
    with pytest.raises(ValueError, match="motion: expected finite values, got 1 that are not"):
        KernelSplatting(bank=bank)(
            image, coc, motion=torch.full((1, 2, 8, 8), 1.0).index_put((torch.tensor(0),) * 4, torch.tensor(math.nan))
        )
    with pytest.raises(ValueError, match="depth: expected values above 0"):
        KernelSplatting(bank=bank)(image, coc, depth=coc)
    with pytest.raises(ValueError, match="depth: expected either depth or coc, got neither"):
        KernelSplatting()(image)


def test_targets_are_what_a_bank_says_of_itself(bank: PsfBank) -> None:
    assert bank.info["target"] == Target()._asdict()
    assert np.mean(bank.info["ssim"]) > 0.97
    torch.testing.assert_close(bank.gains(), torch.ones_like(bank.gains()), atol=2e-4, rtol=0)


@pytest.mark.parametrize("name", ["stylized", "physical-lens"])
def test_pixels_without_more_labels_are_merged(name: str) -> None:
    image, coc = torch.full((1, 3, 64, 64), 0.7), torch.full((1, 1, 64, 64), 16.0)
    blur = KernelSplatting(bank=PsfBank.load(name), quality="fast")
    assert blur.plan(image, coc).highest > 0
    exact = KernelSplatting(bank=PsfBank.load(name), quality="exact")(image, coc)
    torch.testing.assert_close(blur(image, coc), exact, atol=1e-3, rtol=0)


def test_highlights_of_coloured_psfs_do_not_leak() -> None:
    bank, image, coc = PsfBank.load("physical-lens"), torch.ones(1, 6, 96, 96), torch.full((1, 1, 96, 96), 6.0)
    lit = image.clone()
    lit[:, :3, 36, 40] = 1e6
    added = (splat_bank(lit, Labels(coc=coc), bank) - splat_bank(image, Labels(coc=coc), bank))[0, :3]
    y, x = torch.meshgrid(torch.arange(96.0) - 36, torch.arange(96.0) - 40, indexing="ij")
    assert float(added[:, torch.hypot(y, x) > 45].abs().max()) < 1e-6
    assert float(added.min()) > -0.5
    torch.testing.assert_close(added.sum((1, 2)), torch.full((3,), 1e6), rtol=0.01, atol=0)


def test_a_cluster_of_highlights_does_not_hide_itself(bank: PsfBank) -> None:
    image, labels = torch.ones(1, 2, 96, 96), scene(96, 96, 19.0, 8.0, 8.0)
    lit = image.clone()
    lit[0, 0, 22:27, 30:35] = 3e5
    added = (splat_bank(lit, labels, bank) - splat_bank(image, labels, bank))[0, 0]
    assert float(added[60:].abs().max()) < 1e-3


def test_a_disc_far_wider_than_the_picture_covers_it_evenly(bank: PsfBank) -> None:
    image = torch.rand(1, 3, 12, 17, generator=torch.Generator().manual_seed(0))
    labels = scene(12, 17, 1e4, 6.0, -3.0)
    blur = KernelSplatting(bank=bank, quality="exact")
    out = blur(image, labels.coc, motion=labels.motion)
    torch.testing.assert_close(out, image.mean((2, 3), keepdim=True).expand_as(out), atol=2e-3, rtol=0)
    near = KernelSplatting(quality="exact")(image, labels.coc)
    torch.testing.assert_close(out, near, atol=2e-3, rtol=0)


def by_density(values: Tensor, labels: Labels) -> Tensor:
    """Every capsule in closed form at the pixels of the picture, without its sum: it may be as long as it likes."""
    h, w = values.shape[2:]
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    place = torch.stack([x.flatten(), y.flatten()], 1).to(values)
    radius, motion = labels.coc.flatten(), labels.motion[0].flatten(1).T
    centre = place if labels.offset is None else place + labels.offset[0].flatten(1).T
    out = torch.zeros_like(values).flatten(2)
    for shift in ((-0.25, -0.25), (-0.25, 0.25), (0.25, -0.25), (0.25, 0.25)):
        light = _density(place + torch.tensor(shift).to(values), radius, motion, centre)
        out += values.flatten(2) @ (light / (8 * math.pi * radius[:, None] ** 2))
    return out.view_as(values)


@pytest.mark.parametrize("from_start", [False, True])
@pytest.mark.parametrize("highlight", [1.0, 1e5])
def test_only_the_part_of_a_way_that_crosses_the_picture_is_drawn(
    bank: PsfBank, from_start: bool, highlight: float
) -> None:
    draw = torch.Generator().manual_seed(3)
    ways = torch.randn(1, 2, 20, 26, dtype=F64, generator=draw)
    ways = ways / ways.norm(dim=1, keepdim=True)
    values = torch.rand(1, 3, 20, 26, dtype=F64, generator=draw)
    values[:, -1], values[0, 0, 7, 9] = 1.0, highlight
    found = []
    for length in (30.0, 300.0, 2000.0, 1e5):
        motion = length * ways
        labels = Labels(torch.full((1, 1, 20, 26), 4.0, dtype=F64), None, motion, motion / 2 if from_start else None)
        got, want = splat_bank(values, labels, bank), by_density(values, labels)
        assert float((got - want).abs().sum() / want.abs().sum()) < 0.025
        found.append(got[:, :-1] / got[:, -1:])
    torch.testing.assert_close(found[2], found[3], rtol=1e-6, atol=0)  # both ends of all ways are beyond the picture


def test_a_long_way_has_the_gradient_of_the_part_that_is_drawn(bank: PsfBank) -> None:
    values, labels = mixed(14, 17, 4.0, 1.0, seed=5)
    draw = torch.Generator().manual_seed(1)
    aim = torch.rand(values.shape, dtype=F64, generator=draw)
    step = torch.randn(labels.motion.shape, dtype=F64, generator=draw)  # type: ignore[union-attr]
    angle = (labels.motion * 40).requires_grad_()  # the longest of them are cut

    def loss(motion: Tensor) -> Tensor:
        return (aim * splat_bank(values, labels._replace(motion=motion), bank, interpolate=True)).sum()

    (grad,) = torch.autograd.grad(loss(angle), angle)
    lengths = angle.detach().norm(dim=1)
    assert float(lengths.min()) < 30 < 38 < float(lengths.max())
    with torch.no_grad():
        change = [loss(angle + e * step).item() for e in (1e-6, -1e-6)]  # there are kinks a little farther away
    assert (change[0] - change[1]) / 2e-6 == pytest.approx((grad * step).sum().item(), rel=2e-3)


def test_wide_discs_on_long_ways_cover_the_picture_evenly(bank: PsfBank) -> None:
    values = torch.rand(1, 4, 14, 11, generator=torch.Generator().manual_seed(1))
    ways = [scene(14, 11, r, 1600.0, -1200.0)._replace(offset=None) for r in (1e4, 3000.0)]
    for merging in (None, Merging(4.0, 0.015)):
        out = splat_bank(values, ways, bank, merging, highest=0 if merging is None else 1)
        light = sum(0.5 / (math.pi * r**2) for r in (1e4, 3000.0)) * values.sum((2, 3), keepdim=True)
        torch.testing.assert_close(out, light.expand_as(out), rtol=1e-2, atol=0)
