"""Banks: the sparse PSFs of a whole model in one file (LKS section 6.1)."""

import hashlib
import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torchbokeh.ops.checks import check_kind
from torchbokeh.ops.points import PointTable
from torchbokeh.ops.system.files import replacing
from torchbokeh.psfs.model import FRAME, PsfModel
from torchbokeh.psfs.models import MODELS, model_from
from torchbokeh.psfs.refit import Sparse, drawn, reconstruction
from torchbokeh.psfs.represent import DOMAINS, Domain, Represented

FORMAT, VERSION = "torchbokeh-psf-bank", 1
BANKS = Path(__file__).parent / "banks"
"""Where the banks that come with the package are."""

LARGEST_FILE = 64 << 20
"""Bytes of a file of a bank, at most: what is larger is refused before it is read."""

FARTHEST = FRAME // 2 + 1
"""Px of a point from the centre of its sample, along x or y, at most: the Laplacian goes one beyond a dense PSF."""

FAINT = 3e-3
"""Of its maximum: what a drawn sample holds below this are the ripples of its points."""

KEPT = 64
"""Samples that are kept as drawn, at most: they take up to 2 MB each."""

_DTYPES = {"offsets": torch.int16, "values": torch.float32, "counts": torch.int32, "domains": torch.uint8}


class PsfBank(nn.Module):
    """The samples of a PSF model as sparse points, each in the domain that suits it.

    Args:
        model: whose samples they are; its grid tells which sample a coordinate takes.
        samples: one for each box of the grid, in order.
        info: anything to keep with them that JSON can hold.

    Attributes:
        offsets: ``(P, 2)`` int16, points as (dx, dy) in px from the centre, one sample after the other.
        values: ``(P, C)`` float32; C is 1, or 3 for coloured PSFs.
        counts: ``(K+1,)`` int32: sample k owns the points ``counts[k] .. counts[k+1]-1``.
        domains: ``(K,)`` uint8, indices into `torchbokeh.psfs.represent.DOMAINS`.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: the number of samples is not that of the grid.

    Example:
        >>> bank = PsfBank.load("combined")
        >>> bank.model.name, len(bank) == len(bank.model.grid)
        ('combined', True)
    """

    offsets: Tensor
    values: Tensor
    counts: Tensor
    domains: Tensor

    def __init__(self, model: PsfModel, samples: Sequence[Represented], info: dict[str, Any] | None = None) -> None:
        check_kind("model", model, PsfModel)
        if not isinstance(samples, Sequence) or not all(isinstance(s, Represented) for s in samples):
            raise TypeError(f"samples: expected a sequence of Represented, got {type(samples).__name__}")
        if info is not None and not isinstance(info, dict):
            raise TypeError(f"info: expected a dict or None, got {type(info).__name__}")
        if len(samples) != len(model.grid):
            raise ValueError(f"samples: expected {len(model.grid)} for {model.name}, got {len(samples)}")
        offsets, values = ([s.sparse[k] for s in samples] for k in (0, 1))
        domains = torch.tensor([DOMAINS.index(s.domain) for s in samples], dtype=torch.uint8)
        self._fill(model, info, _points(offsets, values, torch.int16) | {"domains": domains})

    def _fill(self, model: PsfModel, info: dict[str, Any] | None, tensors: dict[str, Tensor]) -> "PsfBank":
        super().__init__()
        self.model = model
        self.info = dict(info or {})
        self._tables: dict[tuple[Domain, int, torch.device], PointTable] = {}
        self._pictures: dict[int, NDArray[np.float64]] = {}
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)
        return self

    def __len__(self) -> int:
        """The number of samples."""
        return len(self.domains)

    def extra_repr(self) -> str:
        """Model and size, for ``print``."""
        return f"{self.model.name}, {len(self)} samples, {len(self.offsets)} points"

    def sample(self, number: int) -> Represented:
        """One sample as it was built, its values rounded to float32."""
        first, last = self.counts[number : number + 2].tolist()
        points, values = self.offsets[first:last].cpu().long().numpy(), self.values[first:last].cpu().double().numpy()
        return Represented(DOMAINS[int(self.domains[number])], Sparse(points, values))

    def table(self, domain: Domain, channel: int = 0) -> PointTable:
        """The points of one domain as a table of all samples, for `torchbokeh.ops.points.splat_points`.

        Samples of other domains have no points in it.
        """
        key = domain, channel, self.values.device
        if key not in self._tables:
            with torch.inference_mode(False):  # what is kept may be asked for gradients later
                here = self.domains == DOMAINS.index(domain)
                sizes = self.counts.diff()
                chosen = here.repeat_interleave(sizes)
                counts = torch.cat([sizes.new_zeros(1), torch.where(here, sizes, 0).cumsum(0)]).long()
                found = PointTable(self.offsets[chosen].float(), self.values[chosen, channel], counts)
            if torch._C._functorch.is_functorch_wrapped_tensor(found[0]):
                return found  # a transform of torch.func took part in it: nobody else may have it
            self._tables[key] = found
        return self._tables[key]

    def dense(self, used: Tensor, fine: int = 1) -> "PsfBank":
        """The samples pixel by pixel, in the domain ``direct``, with nothing beyond their points: for bright pixels.

        Args:
            used: ``(K,)`` bool; the other samples are left without points.
            fine: points along each side of a pixel, for PSFs that are turned or enlarged.
        """
        offsets = [np.zeros((0, 2))] * len(self)
        values = [np.zeros((0, self.values.shape[1]))] * len(self)
        steps = (np.arange(fine) + 0.5) / fine - 0.5
        for number in used.nonzero()[:, 0].tolist():
            picture = self._picture(number)
            y, x = np.nonzero((picture > 0).any(0))
            place = np.stack([x - picture.shape[2] // 2, y - picture.shape[1] // 2], 1)
            offsets[number] = np.concatenate([place + np.array([dx, dy]) for dy in steps for dx in steps])
            values[number] = np.tile(picture[:, y, x].T / fine**2, (fine**2, 1))
        with torch.inference_mode(False):
            direct = torch.full((len(self),), DOMAINS.index("direct"), dtype=torch.uint8)
            tensors = _points(offsets, values, torch.float32) | {"domains": direct}
            return PsfBank.__new__(PsfBank)._fill(self.model, self.info, tensors).to(self.values.device)

    def _picture(self, number: int) -> NDArray[np.float64]:
        """What the points of a sample integrate to, within their reach: ``(C, h, w)``, centred, >= 0."""
        found = self._pictures.get(number)
        if found is None:
            domain, sparse = self.sample(number)
            side = 2 * int(np.abs(sparse.points).max(initial=0)) + 1
            found = reconstruction(sparse, (side, side)) if domain == "laplacian" else drawn(sparse, (side // 2,) * 2)
            found = found.cumsum(2) if domain == "scanline" else found
            # What a sparse PSF has there beside its light are ripples.
            found = np.where(found > FAINT * found.max(initial=0.0), found, 0.0)
            gain = self.gains()[number].cpu().double().numpy()[:, None, None]
            sums = found.sum((1, 2), keepdims=True)
            found = found * np.divide(gain, sums, out=np.zeros_like(sums), where=sums > 0)
            if len(self._pictures) < KEPT:
                self._pictures[number] = found
        return found

    def reach(self) -> Tensor:
        """Largest distance ``(K,)`` in px of a point of each sample from its centre, along x or y."""
        far = self.offsets.float().abs().amax(1)
        return far.new_zeros(len(self)).scatter_reduce(0, self._owners(), far, "amax")

    def _owners(self) -> Tensor:
        """The sample ``(P,)`` of each point."""
        return torch.arange(len(self), device=self.counts.device).repeat_interleave(self.counts.diff())

    @cached_property
    def extents(self) -> Tensor:
        """`PsfModel.extent` of every sample, ``(K,)`` float64 on the CPU: 1 where the model has none."""
        with torch.inference_mode(False):
            found = self.model.extent(self.model.grid.centres())
            return torch.ones(len(self), dtype=torch.float64) if found is None else found

    def gains(self) -> Tensor:
        """What each sample sums to, ``(K, C)``: 1, but for the fit, unless the model tints.

        The sum of the values in the direct domain; minus their first moment along x after row differences; a quarter of
        their second moment in the Laplacian domain, since the Laplacian of ``x**2 + y**2`` is 4.
        """
        x, y = self.offsets.double().unbind(1)
        owner = self._owners()
        factors = torch.stack([torch.ones_like(x), -x, (x * x + y * y) / 4])
        factor = factors.gather(0, self.domains.long()[owner][None])[0]
        sums = self.values.new_zeros(len(self), self.values.shape[1], dtype=torch.float64)
        return sums.index_add(0, owner, self.values.double() * factor[:, None]).float()

    def save(self, path: str | Path) -> None:
        """Write a safetensors file: all of it, or nothing.

        Raises:
            OSError: the file cannot be written.
        """
        from safetensors.torch import save

        tensors = {name: getattr(self, name).cpu().contiguous() for name in _DTYPES}
        head = {
            "format": FORMAT,
            "version": VERSION,
            "model": self.model.name,
            "settings": self.model.settings(),
            "grid": _grid_of(self.model),
            "info": self.info,
            "digest": _digest(tensors),
        }
        content = save(tensors, {"torchbokeh": json.dumps(head, sort_keys=True)})
        with replacing(path) as temporary:
            temporary.write_bytes(content)

    @classmethod
    def load(cls, source: str | Path, model: PsfModel | None = None) -> "PsfBank":
        """Read a bank that `save` wrote.

        Args:
            source: a file, or the name of a model whose bank comes with the package.
            model: whose samples they are, if the file is of a model of your own.

        Raises:
            FileNotFoundError: there is no such file, and no model of that name.
            TypeError: an argument of the wrong kind.
            ValueError: the file is no bank, was cut or changed, or belongs to another version.
        """
        if not isinstance(source, str | Path):
            raise TypeError(f"source: expected a file or the name of a model, got {type(source).__name__}")
        if model is not None and not isinstance(model, PsfModel):
            raise TypeError(f"model: expected a PsfModel or None, got {type(model).__name__}")
        path = BANKS / f"{source}.safetensors" if source in MODELS else Path(source)
        if not path.is_file():
            raise FileNotFoundError(
                f"source: expected a file or one of {', '.join(sorted(MODELS))}, got {str(source)!r}"
            )
        head, tensors = _read(path)
        if model is None:
            try:
                model = model_from(head["model"], head["settings"])
            except ValueError as error:
                raise ValueError(f"{path}: expected a model of this version ({error})") from error
        elif model.name != head["model"]:
            raise ValueError(f"model: expected {head['model']!r}, whose bank {path} is, got {model.name!r}")
        if _grid_of(model) != head["grid"]:
            raise ValueError(f"{path}: its samples stand elsewhere than those of this version's model {model.name!r}")
        if (len(tensors["domains"]), tensors["values"].shape[1]) != (len(model.grid), model.channels):
            raise ValueError(f"{path}: expected {len(model.grid)} samples of {model.channels} channels, got others")
        return cls.__new__(cls)._fill(model, head["info"], tensors)


def installed() -> list[str]:
    """Models whose banks come with the package."""
    return [name for name in MODELS if (BANKS / f"{name}.safetensors").is_file()]


def _points(offsets: Sequence[NDArray], values: Sequence[NDArray], dtype: torch.dtype) -> dict[str, Tensor]:
    """The points of all samples as the buffers of a `PsfBank`, with offsets of a dtype."""
    return {
        "offsets": torch.from_numpy(np.concatenate(offsets)).to(dtype),
        "values": torch.from_numpy(np.concatenate(values)).float(),
        "counts": torch.tensor([0, *np.cumsum([len(v) for v in values])], dtype=torch.int32),
    }


def _grid_of(model: PsfModel) -> list[list[float]]:
    grid = model.grid
    return [list(grid.bounds), list(grid.betas), list(grid.cells)]


def _digest(tensors: dict[str, Tensor]) -> str:
    found = hashlib.sha256()
    for name in _DTYPES:
        found.update(tensors[name].numpy().tobytes())
    return found.hexdigest()


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Header and tensors of a file, checked."""
    from safetensors import SafetensorError, safe_open

    size = path.stat().st_size
    if size > LARGEST_FILE:
        raise ValueError(f"{path}: expected at most {LARGEST_FILE >> 20} MB, got {size >> 20} MB")
    try:
        with safe_open(path, "pt") as file:
            text = (file.metadata() or {}).get("torchbokeh")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dictionary
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: expected a safetensors file, but it is cut or something else ({error})") from error
    if text is None:
        raise ValueError(f"{path}: expected a bank of PSFs, got another safetensors file")
    try:
        head = json.loads(text, parse_constant=_refuse)
        version = head["version"] if head["format"] == FORMAT else None
        kinds = (("model", str), ("settings", dict), ("grid", list), ("info", dict))
        if version == VERSION and not all(isinstance(head[name], kind) for name, kind in kinds):
            raise TypeError("an entry of another kind")
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected a bank of PSFs, but its header cannot be read ({error})") from error
    if version != VERSION:
        raise ValueError(f"{path}: expected a bank of PSFs of version {VERSION}, got version {version}")
    _check(path, head, tensors)
    return head, tensors


def _refuse(constant: str) -> None:
    raise ValueError(f"expected finite numbers, got {constant}")


def _check(path: Path, head: dict[str, Any], tensors: dict[str, Tensor]) -> None:
    """Raise a ValueError unless the contents are what `PsfBank.save` writes."""
    if {name: t.dtype for name, t in tensors.items()} != _DTYPES:
        raise ValueError(f"{path}: expected the tensors {', '.join(_DTYPES)}, got {', '.join(tensors) or 'none'}")
    if head.get("digest") != _digest(tensors):
        raise ValueError(f"{path}: the data was changed since it was written: its digest is another")
    offsets, values, counts, domains = (tensors[name] for name in _DTYPES)
    fits = (
        values.dim() == 2
        and values.shape[1] in (1, 3)
        and offsets.shape == (len(values), 2)
        and domains.dim() == 1
        and counts.shape == (len(domains) + 1,)
        and counts[[0, -1]].tolist() == [0, len(values)]
        and bool((counts[1:] >= counts[:-1]).all())  # differences of int32 may wrap
        and bool((domains < len(DOMAINS)).all())
        and bool(((offsets >= -FARTHEST) & (offsets <= FARTHEST)).all())
        and bool(values.isfinite().all())
    )
    if not fits:
        raise ValueError(f"{path}: expected a bank of PSFs, but its tensors do not fit each other")
