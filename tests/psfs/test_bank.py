"""Banks: built, written, read, refused; what they hold."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from torchbokeh.psfs import bank as module
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.build import build, build_sample
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.model import PsfModel
from torchbokeh.psfs.models import MODELS, model_from
from torchbokeh.psfs.represent import DOMAINS, Represented, Target, laplacian, nonzero, scanline
from torchbokeh.psfs.sheet import contact_sheet
from torchbokeh.psfs.similarity import centred
from torchbokeh.psfs.simple_lens import SimpleLens
from torchbokeh.psfs.table import held_out, integrated, resized, sparsity


class Small(SimpleLens):
    """A model of six samples."""

    def __init__(self, radius: float = 6.0) -> None:
        super().__init__(radius)
        self.axes = (self.axes[0].__class__("radius", "px", radius - 0.5, 2.0, 21),)


@pytest.fixture
def model(monkeypatch: pytest.MonkeyPatch) -> PsfModel:
    monkeypatch.setitem(MODELS, "simple-lens", Small)
    return Small()


@pytest.fixture
def small(model: PsfModel) -> PsfBank:
    samples = [build_sample(model, k, Target()).represented for k in range(len(model.grid))]
    return PsfBank(model, samples, {"support": [1] * len(samples)})


def test_a_bank_holds_its_samples(small: PsfBank) -> None:
    assert len(small) == 6
    assert small.counts.tolist()[-1] == len(small.offsets) == len(small.values)
    for number in range(len(small)):
        psf = small.model.prefiltered(*small.model.grid.box(number))
        got = integrated(small.sample(number), psf.shape[1:])  # type: ignore[arg-type]
        np.testing.assert_allclose(got, psf, atol=0.08 * psf.max())
        assert small.reach()[number] == np.abs(small.sample(number).sparse.points).max()
    torch.testing.assert_close(small.gains(), torch.ones(6, 1), rtol=1e-5, atol=0)


def test_tables_hold_the_samples_of_one_domain(small: PsfBank) -> None:
    tables = [small.table(domain) for domain in DOMAINS]
    assert sum(len(t.offsets) for t in tables) == len(small.offsets)
    for number in range(len(small)):
        sizes = [int(t.counts[number + 1] - t.counts[number]) for t in tables]
        assert sizes[int(small.domains[number])] == int(small.counts[number + 1] - small.counts[number])
        assert sum(s > 0 for s in sizes) == 1


def test_a_transform_leaves_nothing_of_its_own_in_a_table() -> None:
    bank = PsfBank.load("simple-lens")
    torch.func.grad(lambda t: t * bank.table("laplacian").weights.sum())(torch.ones(()))
    assert not torch._C._functorch.is_functorch_wrapped_tensor(bank.table("laplacian").weights)


@pytest.mark.parametrize("domain", DOMAINS)
def test_gains_are_the_light_of_a_sample(domain: str) -> None:
    psf = np.concatenate([capsule(3.0, 4.0), 0.25 * capsule(3.0, 4.0), 2 * capsule(3.0, 4.0)])
    sparse = {"direct": nonzero, "scanline": scanline, "laplacian": lambda p: nonzero(laplacian(p))}[domain](psf)
    samples = [Represented(domain, sparse)] * 6  # type: ignore[arg-type]
    gains = PsfBank(Small(), samples).gains()
    torch.testing.assert_close(gains, torch.tensor([[1.0, 0.25, 2.0]]).expand(6, 3), rtol=1e-5, atol=1e-6)


def test_a_file_gives_the_same_bank(small: PsfBank, tmp_path: Path) -> None:
    path = tmp_path / "small.safetensors"
    small.save(path)
    again = PsfBank.load(path)
    assert list(tmp_path.iterdir()) == [path]
    assert again.model.settings() == small.model.settings()
    assert again.info == small.info
    for name, a in small.named_buffers():
        b = again.get_buffer(name)
        assert a.dtype == b.dtype, name
        assert torch.equal(a, b), name
    small.save(tmp_path / "twice.safetensors")
    assert path.read_bytes() == (tmp_path / "twice.safetensors").read_bytes()


def test_nothing_half_written_is_left(small: PsfBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match=r"bank.safetensors: cannot be written \(disk full\)"):
        small.save(tmp_path / "bank.safetensors")
    assert list(tmp_path.iterdir()) == []


def test_other_files_are_refused(small: PsfBank, tmp_path: Path) -> None:
    path = tmp_path / "bank.safetensors"
    small.save(path)
    whole = path.read_bytes()
    with pytest.raises(FileNotFoundError, match="source: expected a file or one of"):
        PsfBank.load(tmp_path / "none")
    for cut in (0, 7, 100, len(whole) - 1):
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match="expected a safetensors file, but it is cut or something else"):
            PsfBank.load(path)
    path.write_bytes(whole[:-3] + b"\x00\x01\x02")
    with pytest.raises(ValueError, match="the data was changed"):
        PsfBank.load(path)
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(ValueError, match="got another safetensors file"):
        PsfBank.load(path)
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="expected"):
        PsfBank.load(path)
    monstrous = tmp_path / "large.safetensors"
    with monstrous.open("wb") as file:
        file.truncate(module.LARGEST_FILE + 1)
    with pytest.raises(ValueError, match="expected at most 64 MB"):
        PsfBank.load(monstrous)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 99}, "expected a bank of PSFs of version 1, got version 99"),
        ({"format": "other"}, "got version None"),
        ({"model": "nonsense"}, "name: expected one of"),
        ({"settings": {"wrong": 1}}, "settings: expected those of simple-lens"),
        ({"settings": {"radius": 7.0}}, "its samples stand elsewhere"),
        ({"digest": ""}, "the data was changed"),
        ({"info": {"ssim": [math.nan]}}, "its header cannot be read .*expected finite numbers, got NaN"),
        ({"info": {"ssim": [math.inf]}}, "its header cannot be read .*expected finite numbers, got Infinity"),
    ],
)
def test_a_header_that_does_not_fit_is_refused(
    small: PsfBank, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = tmp_path / "bank.safetensors"
    small.save(path)
    with safe_open(path, "pt") as file:
        head = json.loads(file.metadata()["torchbokeh"])
    save_file(load_file(path), path, {"torchbokeh": json.dumps({**head, **change})})
    with pytest.raises(ValueError, match=message):
        PsfBank.load(path)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_values_that_are_not_finite_are_refused(small: PsfBank, tmp_path: Path, value: float) -> None:
    small.values[0, 0] = value
    small.save(tmp_path / "bank.safetensors")
    with pytest.raises(ValueError, match="its tensors do not fit each other"):
        PsfBank.load(tmp_path / "bank.safetensors")


def test_counts_whose_differences_wrap_are_refused(small: PsfBank, tmp_path: Path) -> None:
    # As int32, from 1.5e9 to -1.5e9 it goes up, to gigabytes of points.
    small.counts[1], small.counts[2] = 1_500_000_000, -1_500_000_000
    assert bool((small.counts[:3].diff() >= 0).all())
    small.save(tmp_path / "bank.safetensors")
    with pytest.raises(ValueError, match="its tensors do not fit each other"):
        PsfBank.load(tmp_path / "bank.safetensors")


@pytest.mark.parametrize("place", [k / 40 for k in range(40)])
def test_no_changed_byte_is_taken_for_a_bank(small: PsfBank, tmp_path: Path, place: float) -> None:
    path = tmp_path / "bank.safetensors"
    small.save(path)
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 0x15
    path.write_bytes(content)
    try:
        again = PsfBank.load(path)
    except ValueError:
        return
    # A byte of what is only kept, such as the measurements, may change without harm.
    for name, a in small.named_buffers():
        assert torch.equal(a, again.get_buffer(name))


@pytest.mark.slow
def test_building_goes_on_where_it_was_left_and_gives_the_same_bits(tmp_path: Path) -> None:
    model = SimpleLens(radius=3.0)
    whole = build(model, tmp_path / "a.safetensors", workers=2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.safetensors"]
    parts = tmp_path / "b.safetensors.parts"
    parts.mkdir()
    order = json.dumps(
        {"model": "simple-lens", "settings": {"radius": 3.0}, "target": Target()._asdict()}, sort_keys=True
    )
    (parts / "order.json").write_text(order)
    found = build_sample(model, 0, Target())
    marked = np.full((1, 1), 3.0)
    scores = np.array([found.support, 1.0, 1.0, 0.0, 0.1])
    np.savez(parts / "00000.npz", domain="direct", points=np.zeros((1, 2), int), values=marked, scores=scores)
    again = build(model, tmp_path / "b.safetensors", workers=1)
    # The part that was there is taken as it is.
    first = int(whole.counts[1])
    assert again.values[0] == 3.0
    assert torch.equal(again.values[1:], whole.values[first:])
    assert torch.equal(again.offsets[1:], whole.offsets[first:])
    other = tmp_path / "c.safetensors.parts"
    other.mkdir()
    (other / "order.json").write_text("something else")
    np.savez(other / "00000.npz", domain="direct", points=np.zeros((1, 2), int), values=marked, scores=scores)
    build(model, tmp_path / "c.safetensors", workers=2)
    assert (tmp_path / "c.safetensors").read_bytes() == (tmp_path / "a.safetensors").read_bytes()


def test_numbers_of_samples_must_fit(model: PsfModel) -> None:
    with pytest.raises(ValueError, match="samples: expected 6 for simple-lens, got 0"):
        PsfBank(model, [])
    with pytest.raises(ValueError, match="workers: expected at least 1, got 0"):
        build(model, "never", workers=0)
    with pytest.raises(ValueError, match="name: expected one of"):
        model_from("nothing")


def test_a_model_of_ones_own_is_passed_in(small: PsfBank, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "own.safetensors"
    monkeypatch.setattr(Small, "name", "own")
    small.save(path)
    with pytest.raises(ValueError, match="name: expected one of"):
        PsfBank.load(path)
    with pytest.raises(ValueError, match=r"model: expected 'own', whose bank .* got 'combined'"):
        PsfBank.load(path, Combined())
    assert torch.equal(PsfBank.load(path, Small()).values, small.values)


def test_held_out_psfs_are_near_their_samples(small: PsfBank) -> None:
    found = list(held_out(small, 20))
    assert len(found) == 20
    assert all(0 <= f.coordinates[0] <= 5.5 for f in found)
    assert 0.6 < np.mean([f.ssim for f in found]) < 1
    assert [f.ssim for f in held_out(small, 20)] == [f.ssim for f in found]
    assert sparsity(small).shape == (6,)


@pytest.mark.parametrize("domain", ["direct", "laplacian"])
@pytest.mark.parametrize("factor", [0.8, 1.0, 1.15])
def test_a_sample_is_drawn_larger(domain: str, factor: float) -> None:
    psf = capsule(8.0, 12.0)
    sparse = nonzero(psf) if domain == "direct" else nonzero(laplacian(psf))
    got = integrated(resized(Represented(domain, sparse), factor), (61, 61))  # type: ignore[arg-type]
    want = centred(capsule(8.0 * factor, 12.0 * factor), (61, 61))
    assert got.sum() == pytest.approx(1, abs=2e-3)
    assert np.abs(got - want).sum() < (0.12 if domain == "direct" else 0.06) * (factor != 1) + 1e-9


def test_extents_are_those_of_the_middles(small: PsfBank) -> None:
    assert torch.equal(small.extents, torch.ones(6, dtype=torch.float64))


def test_a_contact_sheet_shows_five_pictures_of_each(small: PsfBank) -> None:
    sheet = contact_sheet(small, 3, 40)
    assert sheet.shape == (1, 3, 3 * 44, 5 * 44)
    assert 0 <= sheet.min() < sheet.max() <= 1


@pytest.mark.parametrize("name", ["stylized", "physical-lens"])
def test_a_dense_sample_is_the_psf_and_nothing_beyond_its_points(name: str) -> None:
    bank = PsfBank.load(name)
    used = torch.zeros(len(bank), dtype=torch.bool)
    for domain in bank.domains.unique().tolist():
        used[(bank.domains == domain).nonzero()[-1]] = True
    for fine in (1, 2):
        dense = bank.dense(used, fine)
        assert not dense.domains.any()
        assert torch.equal(dense.counts.diff() > 0, used)
        assert float(dense.values.min()) >= 0
        assert bool((dense.reach() <= bank.reach() + 0.5)[used].all())
        torch.testing.assert_close(dense.gains()[used], bank.gains()[used], rtol=1e-5, atol=1e-6)
    for number in used.nonzero()[:, 0].tolist():
        want = bank.model.dense(bank.model.grid.centres()[number].tolist())
        want /= want.sum((1, 2), keepdims=True)
        got = centred(bank._picture(number), want.shape[1:])
        got /= got.sum((1, 2), keepdims=True)
        assert np.abs(got - want).sum() / 3 < 0.2
