"""export(): a solution in the format that a file's name asks for."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..core.errors import RadiosityError
from ..core.files import check_writable
from ..solver import Solution
from .cameras import cameras
from .geometry import RAISE, LitMesh, lit_mesh
from .gltf import write_glb
from .mitsuba_xml import write_xml
from .ply import write_ply
from .tone import checked, exposure_of


def _ply(solution: Solution, mesh: LitMesh, path: Path, exposure: float) -> None:
    write_ply(mesh, path, exposure)


def _glb(solution: Solution, mesh: LitMesh, path: Path, exposure: float) -> None:
    write_glb(replace(mesh, vertices=mesh.raised(RAISE * mesh.size)), path, solution.model, exposure)


def _xml(solution: Solution, mesh: LitMesh, path: Path, exposure: float) -> None:
    write_xml(replace(mesh, vertices=mesh.raised(solution.model.patches.lift[0])), path, cameras(solution.model.scene))


WRITERS: dict[str, Callable[[Solution, LitMesh, Path, float], None]] = {".ply": _ply, ".glb": _glb, ".xml": _xml}


def export(
    solution: Solution,
    path: str | os.PathLike[str],
    exposure: float | str = 1.0,
    progress: Callable[[str, int, int | None], None] | None = None,
) -> None:
    """Write the lit mesh of a solution as .ply, .glb or .xml, as the name says.

    exposure: what radiance is multiplied by for colours, a number or "auto"; 1 shows what a picture in .png shows.
    progress: called with ("export", done, total). Raises RadiosityError for another name, for a file that cannot be
    written, and for an exposure of one that holds light (.xml).
    """
    path, report = Path(path), progress or (lambda stage, done, total: None)
    exposure = checked(exposure, path)
    check_target(path)
    report("export", 0, 2)
    mesh = lit_mesh(solution)
    report("export", 1, 2)
    WRITERS[path.suffix.lower()](solution, mesh, path, exposure_of(mesh, exposure))
    report("export", 2, 2)


def check_target(path: Path) -> None:
    """Raise RadiosityError if ``path`` is no file that `export` could write."""
    if path.suffix.lower() not in WRITERS:
        hint = "add --lightmap SIZE, or " if path.suffix.lower() == ".exr" else ""
        raise RadiosityError(f"-o {path}: {hint}choose a name that ends in {', '.join(WRITERS)}")
    check_writable(path)
