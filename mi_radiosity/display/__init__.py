"""Radiosity shown: shadings by name, a continuous field over the mesh, and the `radiosity` integrator."""

from .field import Field
from .image import write_image
from .integrator import register, render
from .shaders import SHADERS, Flat, Gouraud, Look, Shader

__all__ = ["SHADERS", "Field", "Flat", "Gouraud", "Look", "Shader", "register", "render", "write_image"]
