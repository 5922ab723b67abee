"""Channels of films: pictures in the pixel format that a sensor's film has, and linear RGB from such pictures."""

import re

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError

FORMATS = {  # `pixel_format` of hdrfilm: the format of bitmaps
    "luminance": "Y",
    "luminance_alpha": "YA",
    "rgb": "RGB",
    "rgba": "RGBA",
    "xyz": "XYZ",
    "xyza": "XYZA",
}
PRINTED = {"y": "luminance", "ya": "luminance_alpha"}  # what descriptions of films call two of them
COMPONENTS = {"float16": "Float16", "float32": "Float32", "uint32": "UInt32"}


def film_settings(film: "mi.Film") -> dict[str, str]:
    """Settings of a film by name, such as ``pixel_format`` and ``component_format``.

    Mitsuba shows these to Python only in the film's description.
    """
    found: dict[str, str] = dict(re.findall(r"^  (\w+) = (\w+),?$", str(film), flags=re.MULTILINE))
    return {name: PRINTED[value] if value in PRINTED else value for name, value in found.items()}


def pixel_format(film: "mi.Film") -> "mi.Bitmap.PixelFormat":
    """The format of bitmaps of a film. Raises RadiosityError for films of other classes than hdrfilm."""
    name = film_settings(film).get("pixel_format")
    if name not in FORMATS:
        raise RadiosityError(f"the film {film.class_name()} has no pixel_format that is known: use hdrfilm")
    return getattr(mi.Bitmap.PixelFormat, FORMATS[name])


def component_format(film: "mi.Film") -> "mi.Struct.Type":
    """The number format of the files that a film writes."""
    return getattr(mi.Struct.Type, COMPONENTS[film_settings(film)["component_format"]])


def has_alpha(film: "mi.Film") -> bool:
    """Does a film have an alpha channel?"""
    return bool(mi.has_flag(film.flags(), mi.FilmFlags.Alpha))


def as_bitmap(image: "mi.TensorXf | np.ndarray", film: "mi.Film | None" = None) -> "mi.Bitmap":
    """A bitmap of a picture [height, width, channels] in the channels of ``film``; without a film Mitsuba tells the
    format from the number of channels."""
    values = np.array(image, dtype=np.float32)
    return mi.Bitmap(values) if film is None else mi.Bitmap(values, pixel_format(film))


def linear_rgb(image: "mi.TensorXf | np.ndarray", film: "mi.Film") -> np.ndarray:
    """Linear RGB of a picture [height, width, channels] in the channels of ``film`` (float32 [height, width, 3]).

    XYZ becomes RGB, luminance becomes grey, alpha is left out; RGB is returned as it is.
    """
    values = np.array(image, dtype=np.float32)
    if pixel_format(film) in (mi.Bitmap.PixelFormat.RGB, mi.Bitmap.PixelFormat.RGBA):
        return values[..., :3]
    return _converted(mi.Bitmap(values, pixel_format(film)), mi.Bitmap.PixelFormat.RGB)


def on_film(rgb: np.ndarray, alpha: np.ndarray | None, film: "mi.Film") -> np.ndarray:
    """A picture in the channels of ``film`` from linear RGB [height, width, 3] and, where the film has alpha, alpha
    [height, width]; the inverse of `linear_rgb`, as far as the film keeps colours (float32)."""
    wanted, source = pixel_format(film), mi.Bitmap.PixelFormat.RGB
    values = np.ascontiguousarray(rgb, dtype=np.float32)
    if alpha is not None:
        values = np.concatenate([values, np.asarray(alpha, dtype=np.float32)[..., None]], axis=2)
        source = mi.Bitmap.PixelFormat.RGBA
    converted = values if wanted == source else _converted(mi.Bitmap(values, source), wanted)
    return converted.reshape(*rgb.shape[:2], -1)  # bitmaps of one channel have no third dimension


def _converted(bitmap, wanted):
    return np.array(bitmap.convert(wanted, mi.Struct.Type.Float32, False), dtype=np.float32)
