"""All PSF models by name."""

from typing import Any

from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import PsfModel
from torchbokeh.psfs.physical_lens import PhysicalLens
from torchbokeh.psfs.simple_lens import SimpleLens
from torchbokeh.psfs.stylized import Stylized
from torchbokeh.psfs.volume import Volume

MODELS: dict[str, type[PsfModel]] = {
    model.name: model for model in (SimpleLens, Combined, PhysicalLens, Volume, Stylized)
}
"""Every model that comes with the package."""


def model_from(name: str, settings: dict[str, Any] | None = None) -> PsfModel:
    """A model by its name, with settings as `PsfModel.settings` gives them.

    Raises:
        ValueError: there is none of that name, or a setting does not fit.
    """
    if name not in MODELS:
        raise ValueError(f"name: expected one of {', '.join(sorted(MODELS))}, got {name!r}")
    try:
        return MODELS[name](**(settings or {}))
    except (TypeError, OverflowError) as error:
        raise ValueError(f"settings: expected those of {name}, got {settings} ({error})") from error
