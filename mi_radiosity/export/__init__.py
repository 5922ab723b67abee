"""A solution taken home: measured, as a mesh for other programs, a scene that shines by itself, a page to walk in."""

from .api import WRITERS, export
from .geometry import LitMesh, lit_mesh
from .grids import Grid, file_grid, plane_grid, shape_grid
from .lightmap import Lightmap, lightmap
from .lightmap_files import export_lightmap
from .measure import Measurement, measure, write_measurement
from .page import view, write_page

__all__ = [
    "WRITERS",
    "Grid",
    "Lightmap",
    "LitMesh",
    "Measurement",
    "export",
    "export_lightmap",
    "file_grid",
    "lightmap",
    "lit_mesh",
    "measure",
    "plane_grid",
    "shape_grid",
    "view",
    "write_measurement",
    "write_page",
]
