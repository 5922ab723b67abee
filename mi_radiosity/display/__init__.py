"""Radiosity shown: shadings by name, and the `radiosity` integrator."""

from ..solver import Field
from .denoise import CleanPicture, require_denoiser
from .image import write_image
from .integrator import register, render
from .lux import Lux, lux_scale
from .shaders import SHADERS, Flat, Gouraud, Look, Shader

__all__ = [
    "SHADERS",
    "CleanPicture",
    "Field",
    "Flat",
    "Gouraud",
    "Look",
    "Lux",
    "Shader",
    "lux_scale",
    "register",
    "render",
    "require_denoiser",
    "write_image",
]
