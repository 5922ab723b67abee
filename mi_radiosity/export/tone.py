"""From radiance to what screens and viewers take."""

from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import RadiosityError

if TYPE_CHECKING:
    from .geometry import LitMesh

BRIGHT = 0.98  # share of the lit area that the exposure "auto" shows without clipping


def checked(exposure: float | str) -> float | str:
    """A number > 0, or "auto". Raises RadiosityError for anything else."""
    if exposure == "auto":
        return "auto"
    try:
        value = float(exposure)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise RadiosityError(f"the exposure must be 'auto' or a number greater than 0, not {exposure}")
    return value


def exposure_of(mesh: "LitMesh", exposure: float | str) -> float:
    """The number itself; for "auto" what brings 98 % of the area that is no lamp below 1."""
    if exposure != "auto":
        return float(exposure)
    brightest = (mesh.radiosity / np.pi).max(axis=1)[mesh.triangles].max(axis=1)
    lamp = mesh.emission.max(axis=1)[mesh.triangles].max(axis=1) > 0
    weight = np.where(lamp, 0, mesh.areas())
    order = np.argsort(brightest)
    share = np.cumsum(weight[order])
    level = brightest[order][np.searchsorted(share, BRIGHT * share[-1])]
    return float(1 / level) if level > 0 else 1.0
