"""Radiosity shown: a continuous field over the mesh, and the `radiosity` integrator."""

from .field import Field
from .image import write_image
from .integrator import SHADINGS, register, render

__all__ = ["Field", "SHADINGS", "register", "render", "write_image"]
