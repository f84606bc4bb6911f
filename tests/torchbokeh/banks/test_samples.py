"""What samples of any bank do, and a model that says no more than it must."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from torchbokeh import KernelSplatting
from torchbokeh.banks.splat import splat_bank
from torchbokeh.psfs import Axis, Labels, Place, PsfBank, PsfModel, SimpleLens
from torchbokeh.psfs.combined import capsule
from torchbokeh.psfs.models import MODELS
from torchbokeh.psfs.represent import Represented, nonzero


class Boxes(PsfModel):
    """A square whose side in px is the depth in metres."""

    name = "boxes"
    axes = (Axis("side", "px", 9.0, 1.0, 6),)

    def dense(self, coordinates):
        n = 2 * int(coordinates[0] // 2) + 1
        return np.full((1, n, n), 1 / n**2)

    def place(self, labels):
        return Place(labels.depth)


@pytest.mark.parametrize("brightness", [1.0, 1e3, 1e5])
@pytest.mark.parametrize("where", [(8, 9), (slice(None), slice(12))])
def test_a_model_of_dense_and_place_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: tuple[int | slice, int | slice], brightness: float
) -> None:
    monkeypatch.setitem(MODELS, "boxes", Boxes)
    model = Boxes()
    psfs = [model.dense(place) for place in model.grid.centres().tolist()]
    PsfBank(model, [Represented("direct", nonzero(psf)) for psf in psfs]).save(tmp_path / "bank.safetensors")
    bank = PsfBank.load(tmp_path / "bank.safetensors")
    assert isinstance(bank.model, Boxes)
    image = torch.rand(1, 3, 24, 30, generator=torch.Generator().manual_seed(0)) + 0.5
    image[..., where[0], where[1]] *= brightness
    depth = torch.full((1, 1, 24, 30), 7.0)
    psf = torch.from_numpy(psfs[int(model.grid.index(torch.tensor([7.0])))])[None].float()
    assert psf.shape[2] > 1

    def spread(t: torch.Tensor) -> torch.Tensor:
        return F.conv2d(t.movedim(1, 0), psf, padding=psf.shape[2] // 2).movedim(0, 1)

    want = spread(image) / spread(torch.ones_like(depth))
    torch.testing.assert_close(KernelSplatting(bank=bank)(image, depth=depth), want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("name", "radius", "error"), [("simple-lens", 250.0, 1e-3), ("physical-lens", 120.0, 0.1)])
def test_psfs_beyond_what_a_bank_samples_are_scaled(name: str, radius: float, error: float) -> None:
    wide, labels = PsfBank.load(name), Labels(coc=torch.full((1, 1, 16, 13), radius))
    assert radius > 2 * wide.model.axes[0].bound
    values = torch.ones(1, 2 * wide.values.shape[1], 16, 13)
    near = splat_bank(values, labels._replace(coc=labels.coc / 2), wide)[..., 6:10, 5:9]
    # Around the middle of the picture, what arrives is the density in the middle of PSFs of twice the size.
    torch.testing.assert_close(4 * splat_bank(values, labels, wide)[..., 6:10, 5:9], near, rtol=error, atol=0)


def test_psfs_that_need_too_large_a_buffer_are_refused() -> None:
    blur = KernelSplatting(bank=PsfBank.load("physical-lens"), quality="exact")
    with pytest.raises(ValueError, match=r"coc: expected PSFs .* got PSFs that reach 2\d{4} px beyond 12 x 9 pixels"):
        blur(torch.rand(1, 3, 9, 12), torch.full((1, 1, 9, 12), 1e4))


def test_coloured_psfs_spread_each_channel_by_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    psfs = np.concatenate([capsule(2.0, 0.0), 0.5 * capsule(2.0, 0.0), 0.25 * capsule(2.0, 0.0)])
    model = SimpleLens()
    sample = Represented("direct", nonzero(psfs))
    bank = PsfBank(model, [sample] * len(model.grid))
    image, coc = torch.rand(1, 6, 15, 16), torch.full((1, 1, 15, 16), 2.0)
    plain = KernelSplatting(bank=bank, quality="exact")(image, coc)
    torch.testing.assert_close(plain, KernelSplatting(quality="exact")(image, coc), rtol=1e-2, atol=8e-3)
    monkeypatch.setattr(SimpleLens, "tints", True)
    tinted = KernelSplatting(bank=bank, quality="exact")(image, coc)
    gain = torch.tensor([1.0, 0.5, 0.25]).repeat(2)[:, None, None]
    torch.testing.assert_close(tinted, plain * gain)
    with pytest.raises(ValueError, match="image: expected a multiple of 3 channels for coloured PSFs, got 4"):
        KernelSplatting(bank=bank)(image[:, :4], coc)


def test_psfs_that_depend_on_the_place_do_not_depend_on_what_is_dark() -> None:
    # A dark picture is a list of pixels, each of which must keep its place.
    bank, coc = PsfBank.load("physical-lens"), torch.full((1, 1, 48, 64), 5.0)
    dot, haze = torch.zeros(1, 3, 48, 64), torch.full((1, 3, 48, 64), 1.0)
    dot[..., 10, 50] = 1.0
    covered = [torch.cat([t, t], 1) for t in (dot, haze, dot + haze)]
    alone, without, within = (splat_bank(t, Labels(coc=coc), bank) for t in covered)
    torch.testing.assert_close(alone, within - without, atol=1e-5, rtol=0)


def test_half_precision_overflows_as_in_torch() -> None:
    # A yellow and magenta star: more red light than there was, and less green.
    blur = KernelSplatting(bank=PsfBank.load("stylized"), quality="exact")
    image, coc = torch.full((1, 3, 9, 8), 65504.0), torch.full((1, 1, 9, 8), 4.0)
    out = blur(image.half(), coc.half())
    assert (out[:, 0] == torch.inf).all()
    assert out[:, 1:].isfinite().all()
    torch.testing.assert_close(out, blur(image.double(), coc.double()).half())
    assert blur(image.bfloat16(), coc.bfloat16()).isfinite().all()


def test_pixels_without_light_and_empty_pictures_cost_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    bank = PsfBank.load("combined")
    motion = torch.tensor([60.0, 0.0]).view(1, 2, 1, 1).expand(1, 2, 12, 14)
    labels = Labels(coc=torch.full((1, 1, 12, 14), 30.0), motion=motion)
    monkeypatch.setattr("torchbokeh.banks.samples.splat_points", None)
    assert float(splat_bank(torch.zeros(1, 4, 12, 14), labels, bank).abs().max()) == 0
    empty = KernelSplatting(bank=bank)(torch.zeros(0, 3, 4, 5), torch.zeros(0, 1, 4, 5), motion=torch.zeros(0, 2, 4, 5))
    assert empty.shape == (0, 3, 4, 5)
