"""A solution taken home: measured, as a mesh for other programs, a scene that shines by itself, a page to walk in."""

from .api import WRITERS, export
from .geometry import LitMesh, lit_mesh
from .page import view, write_page

__all__ = ["WRITERS", "LitMesh", "export", "lit_mesh", "view", "write_page"]
