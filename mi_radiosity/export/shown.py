"""What of a scene an exported file shows; a warning, naming the shapes, for everything that the file leaves out."""

from collections.abc import Iterable
from dataclasses import fields, replace

import numpy as np

from ..core.errors import warn_of
from ..display import hides_emitters
from ..scene import Model
from ..scene.lights import varies
from ..scene.materials import is_diffuse, is_textured, textures_of, varies_over_uv
from .geometry import LitMesh

NAMED = 3  # shapes that a warning names
ATTRIBUTE = "MeshAttribute"  # Mitsuba's class of textures that are colours of vertices or faces
OF_TRIANGLES = ("triangles", "leaf", "shape", "back", "above")  # the arrays of a LitMesh that have a row per triangle


def hidden_parts(model: Model, hide_emitters: bool | None = None) -> list[int]:
    """Numbers of the parts of a scene that are emitters which are not to be shown.

    hide_emitters: None for what the scene's own integrator says. Warns of emitters that are left out.
    """
    hide = hides_emitters(model.scene) if hide_emitters is None else hide_emitters
    hidden = [number for number, part in enumerate(model.faces.parts) if part.shape.is_emitter()] if hide else []
    _warn(model, hidden, "the scene hides its emitters, so the file leaves it out")
    return hidden


def without(mesh: LitMesh, parts: list[int]) -> LitMesh:
    """A mesh without the triangles of some parts, and without the vertices that only these have."""
    kept = ~np.isin(mesh.shape, parts)
    if kept.all():
        return mesh
    used, triangles = np.unique(mesh.triangles[kept], return_inverse=True)
    arrays = {
        field.name: getattr(mesh, field.name)[kept if field.name in OF_TRIANGLES else used] for field in fields(mesh)
    }
    return replace(mesh, **arrays | {"triangles": triangles.reshape(-1, 3)})


def warn_of_losses(model: Model, parts: Iterable[int], textures: bool) -> None:
    """Warn of what a file with the lit mesh of some parts cannot show. textures: does the file hold textures?"""
    shown = [(number, model.faces.parts[number].shape) for number in sorted(set(parts))]
    traced = [number for number, shape in shown if not is_diffuse(shape.bsdf())]
    textured = [number for number, shape in shown if is_textured(shape.bsdf())]
    glowing = [number for number, shape in shown if shape.is_emitter() and varies(shape.emitter())]
    _warn(model, traced, "its BSDF has lobes that are not diffuse, and the file shows its diffuse lobe only")
    means = [n for n in textured if n in traced]
    _warn(model, means, "the file shows means of its texture over elements")
    flat = [n for n in textured if n not in traced and not _only_attributes(model, n)]
    if textures:
        emits = [n for n in flat if model.faces.parts[n].shape.is_emitter()]
        _warn(model, emits, "it emits light, so the file shows means of its reflectance over elements")
        flat = [n for n in flat if n not in emits and not varies_over_uv(model.faces.parts[n].shape.bsdf())]
    _warn(model, flat, "the file shows its texture at the vertices of the mesh only")
    _warn(model, glowing, "the file shows means of its emission's texture over elements")
    if model.lights.sky_light:
        warn_of("the file holds the light of the environment emitter on surfaces, but no picture of the environment")


def _only_attributes(model, number):
    """Does the reflectance of a part vary with colours of vertices or faces only, which the file holds as they are?"""
    return all(name == ATTRIBUTE for name in textures_of(model.faces.parts[number].shape.bsdf()))


def _warn(model, numbers, why):
    if not numbers:
        return
    names = list(dict.fromkeys(model.faces.parts[number].name for number in numbers))
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    warn_of(f"{', '.join(names[:NAMED])}{more}: {why}")
