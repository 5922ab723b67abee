"""Radiosity shown: shadings by name, and the `radiosity` integrator."""

from .denoise import CleanPicture, require_denoiser
from .film import linear_rgb
from .image import write_image
from .integrator import register
from .lux import Lux, lux_scale
from .scene_integrator import hides_emitters, solve_options, unmodelled
from .shaders import SHADERS, Flat, Gouraud, Look, Shader

__all__ = [
    "SHADERS",
    "CleanPicture",
    "Flat",
    "Gouraud",
    "Look",
    "Lux",
    "Shader",
    "hides_emitters",
    "linear_rgb",
    "lux_scale",
    "register",
    "require_denoiser",
    "solve_options",
    "unmodelled",
    "write_image",
]
