"""Pictures on disk."""

import json
import os

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.files import writing


def write_image(path: str | os.PathLike[str], image: "mi.TensorXf", stats: dict | None = None) -> None:
    """Write a picture (mi.TensorXf [height, width, channels]): EXR linear, with ``stats`` in its
    header; PNG as 8-bit sRGB. Raises RadiosityError if it cannot be written."""
    values = np.array(image)
    if not np.isfinite(values).all():
        raise RadiosityError(f"{path} would hold values that are not numbers: the film or the scene has NaN")
    bitmap = mi.Bitmap(image)
    if str(path).lower().endswith(".png"):
        # Brighter than white is white: Mitsuba makes values of some 3,000 and more black.
        bitmap = mi.util.convert_to_bitmap(mi.TensorXf(np.clip(values, 0, 1)))
    elif stats:
        bitmap.metadata()["mi_radiosity"] = json.dumps(stats)
    with writing(path) as temporary:
        try:
            bitmap.write(temporary)
        except RuntimeError as error:
            raise OSError(str(error)) from None
