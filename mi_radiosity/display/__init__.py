"""Radiosity shown: shadings by name, and the `radiosity` integrator."""

from ..solver import Field
from .image import write_image
from .integrator import register, render
from .shaders import SHADERS, Look, Shader

__all__ = ["SHADERS", "Field", "Look", "Shader", "register", "render", "write_image"]
