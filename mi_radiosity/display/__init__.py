"""Radiosity shown: shadings by name, and the `radiosity` integrator."""

from .denoise import CleanPicture, require_denoiser
from .image import write_image
from .integrator import register
from .lux import Lux, lux_scale
from .shaders import SHADERS, Flat, Gouraud, Look, Shader

__all__ = [
    "SHADERS",
    "CleanPicture",
    "Flat",
    "Gouraud",
    "Look",
    "Lux",
    "Shader",
    "lux_scale",
    "register",
    "require_denoiser",
    "write_image",
]
