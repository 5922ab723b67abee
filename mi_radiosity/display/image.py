"""Pictures on disk."""

import json
import os

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError, warn_of
from ..core.files import writing
from .film import as_bitmap, component_format, linear_rgb

LARGEST_HALF = 65504.0  # the largest float16


def write_image(
    path: str | os.PathLike[str], image: "mi.TensorXf", stats: dict | None = None, film: "mi.Film | None" = None
) -> None:
    """Write a picture (mi.TensorXf [height, width, channels]) as Mitsuba writes those of ``film``.

    EXR: linear, with ``stats`` in its header, in the film's pixel_format and component_format; float32 without a film.
    PNG: 8-bit sRGB without alpha, as `mi.util.write_bitmap` writes it. Warns of values that are infinite in the film's
    float16. Raises RadiosityError if the file cannot be written, or would hold NaN.
    """
    values = np.array(image)
    if not np.isfinite(values).all():
        raise RadiosityError(f"{path} would hold values that are not numbers: the film or the scene has NaN")
    if str(path).lower().endswith(".png"):
        # Brighter than white is white: Mitsuba makes values of some 3,000 and more black.
        colors = values if film is None else linear_rgb(values, film)
        bitmap = mi.util.convert_to_bitmap(mi.TensorXf(np.clip(colors, 0, 1)))
    else:
        bitmap = as_bitmap(values, film)
        if film is not None:
            kind = component_format(film)
            if kind == mi.Struct.Type.Float16 and np.abs(values).max(initial=0) > LARGEST_HALF:
                warn_of(
                    f"{path}: values above {LARGEST_HALF:,.0f} are infinite in float16: set component_format float32"
                )
            bitmap = bitmap.convert(bitmap.pixel_format(), kind, False)
        if stats:
            bitmap.metadata()["mi_radiosity"] = json.dumps(stats)
    with writing(path) as temporary:
        try:
            bitmap.write(temporary)
        except RuntimeError as error:
            raise OSError(str(error)) from None
