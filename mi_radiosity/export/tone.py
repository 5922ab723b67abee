"""From radiance to what screens and viewers take."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import RadiosityError
from ..core.numbers import real_number

if TYPE_CHECKING:
    from .geometry import LitMesh

HOLD_LIGHT = (".xml", ".exr")  # such files are not made of colours
BRIGHT = 0.98  # share of the lit area that the exposure "auto" shows without clipping


def checked(exposure: float | str, path: Path | None = None) -> float | str:
    """A number > 0, or "auto". Raises RadiosityError for anything else, and if the file at ``path`` holds light, which
    has no exposure."""
    value: float | str = "auto"
    if not (isinstance(exposure, str) and exposure == "auto"):
        try:
            value = real_number("exposure", float(exposure) if isinstance(exposure, str) else exposure, 0)
        except ValueError:  # RadiosityError is one of them
            raise RadiosityError(f"the exposure must be 'auto' or a number greater than 0, not {exposure}") from None
    if value != 1 and path is not None and path.suffix.lower() in HOLD_LIGHT:
        raise RadiosityError(f"{path} holds light, which has no exposure: leave that out")
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
