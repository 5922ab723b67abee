"""export(): a solution in the format that a file's name asks for."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from ..core.errors import RadiosityError, warn_of
from ..core.files import check_writable
from ..solver import Solution
from .cameras import sensors, warn_of_lost_cameras
from .geometry import RAISE, LitMesh, lit_mesh
from .gltf import write_glb
from .mitsuba_xml import check_mesh_path, mesh_path, write_xml
from .ply import write_ply
from .shown import hidden_parts, warn_of_losses, without
from .tone import checked, exposure_of


def _ply(solution: Solution, mesh: LitMesh, path: Path, exposure: float) -> None:
    write_ply(mesh, path, exposure)


def _glb(solution: Solution, mesh: LitMesh, path: Path, exposure: float) -> None:
    write_glb(replace(mesh, vertices=mesh.raised(RAISE * mesh.size)), path, solution.model, exposure)


def _xml(solution: Solution, mesh: LitMesh, path: Path, exposure: float) -> None:
    views, others = sensors(solution.model.scene)
    for name in others:
        warn_of(f"sensor '{name}' cannot be written into a scene of its own, and is left out")
    write_xml(replace(mesh, vertices=mesh.raised(solution.model.patches.lift[0])), path, views)


WRITERS: dict[str, Callable[[Solution, LitMesh, Path, float], None]] = {".ply": _ply, ".glb": _glb, ".xml": _xml}


def export(
    solution: Solution,
    path: str | os.PathLike[str],
    exposure: float | str = 1.0,
    progress: Callable[[str, int, int | None], None] | None = None,
    hide_emitters: bool | None = None,
) -> list[Path]:
    """Write the lit mesh of a solution as .ply, .glb or .xml, as the name says.

    exposure: what radiance is multiplied by for colours, a number or "auto"; 1 shows what a picture in .png shows.
    progress: called with ("export", done, total). hide_emitters: leave emitters out; by default as the scene's own
    integrator says. Returns the files written: an .xml has its mesh in NAME_mesh.ply beside it. Issues a
    RadiosityWarning for everything that the file leaves out.
    Raises RadiosityError for another name, for a file that cannot be written, for an exposure of one that holds light
    (.xml), and if NAME_mesh.ply is another file than that of an earlier export.
    """
    path, report = Path(path), progress or (lambda stage, done, total: None)
    exposure = checked(exposure, path)
    check_target(path)
    report("export", 0, 2)
    kind, model = path.suffix.lower(), solution.model
    mesh = without(lit_mesh(solution), hidden_parts(model, hide_emitters))
    warn_of_losses(model, mesh.shape.tolist(), textures=kind == ".glb")
    if kind == ".glb":
        warn_of_lost_cameras(model.scene, "glTF")
    report("export", 1, 2)
    WRITERS[kind](solution, mesh, path, exposure_of(mesh, exposure))
    report("export", 2, 2)
    return [path, mesh_path(path)] if kind == ".xml" else [path]


def check_target(path: Path) -> None:
    """Raise RadiosityError if ``path`` is no file that `export` could write."""
    if path.suffix.lower() not in WRITERS:
        hint = "add --lightmap SIZE, or " if path.suffix.lower() == ".exr" else ""
        raise RadiosityError(f"-o {path}: {hint}choose a name that ends in {', '.join(WRITERS)}")
    check_writable(path)
    if path.suffix.lower() == ".xml":
        check_mesh_path(path)
