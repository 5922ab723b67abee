"""What a scene is to the solver, shape by shape and lamp by lamp, before anything is solved; refused parts, too."""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from .lights import LIGHTS
from .materials import inspect, inspect_emitter, inspect_part, is_diffuse
from .model import Model
from .tessellate import children, parts


@dataclass(frozen=True)
class ShapeRow:
    """A shape, or a member of an instance. Counts are None while the scene cannot be read because parts are refused."""

    name: str
    kind: str  # Mitsuba's class
    faces: int | None
    fronts: int | None  # patches
    backs: int | None
    bsdf: str  # its class
    treatment: str  # "diffuse", "traced", "diffuse lobe, others traced", or why it is refused


@dataclass(frozen=True)
class LampRow:
    """A lamp; the power of those on surfaces is what all faces of the shape emit."""

    name: str
    kind: str
    power: tuple[float, ...] | None  # W per channel; None where it cannot be known
    treatment: str  # "leaves from patches", "shot and looked for", or why it is refused


@dataclass(frozen=True)
class Report:
    """All of it. ``model`` is None if anything is refused; ``refused`` says what, and what to do."""

    shapes: list[ShapeRow]
    lamps: list[LampRow]
    model: Model | None
    refused: list[str]


def report(scene: "mi.Scene | Model") -> Report:
    """Describe a scene (or a Model of one)."""
    model, refused = (scene, []) if isinstance(scene, Model) else _read(scene)
    scene = scene.scene if isinstance(scene, Model) else scene
    found = model.faces.parts if model else parts(scene)
    counts = _counts(model) if model else [(_faces(part), None, None) for part in found]
    shapes = [
        ShapeRow(part.name, part.shape.class_name(), faces, fronts, backs, _bsdf(part.shape.bsdf()), _treatment(part))
        for part, (faces, fronts, backs) in zip(found, counts)
    ]
    return Report(shapes, [*_surface_lamps(found, model), *_free_lamps(scene, model)], model, refused)


def _read(scene):
    """The Model of a scene, or None, and why there is none."""
    findings = inspect(scene)
    if findings:
        return None, [f"{finding.what}: {finding.why}" for finding in findings]
    try:
        return Model(scene), []
    except RadiosityError as error:
        return None, [str(error)]


def _counts(model):
    """Faces, and patches in front and behind, of all parts."""
    shape, n = model.faces.shape, len(model.faces.parts)
    face, back = np.array(model.patches.face), np.array(model.patches.back).astype(bool)
    columns = (np.bincount(of, minlength=n).tolist() for of in (shape, shape[face[~back]], shape[face[back]]))
    return list(zip(*columns))


def _faces(part):
    return part.shape.face_count() if isinstance(part.shape, mi.Mesh) else None


def _bsdf(bsdf):
    """Class of a BSDF, and of those in it."""
    if bsdf is None:
        return ""
    inner = ", ".join(dict.fromkeys(_bsdf(part) for part in children(bsdf) if isinstance(part, mi.BSDF)))
    return bsdf.class_name() + (f" ({inner})" if inner else "")


def _treatment(part):
    why = list(inspect_part(part))
    if why:
        return "refused: " + "; ".join(why)
    bsdf = part.shape.bsdf()
    if is_diffuse(bsdf):
        return "diffuse"
    has_lobe = mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
    return "diffuse lobe, others traced" if has_lobe else "traced"


def _surface_lamps(found, model):
    """Shapes that emit from patches."""
    for number, part in enumerate(found):
        emitter = part.shape.emitter() if part.shape.is_emitter() else None
        if emitter is None or not getattr(LIGHTS.get(emitter.class_name()), "on_surface", False):
            continue
        power = None
        if model:
            own = model.faces.shape == number
            power = tuple((model.lights.exitance[own] * model.faces.area[own, None]).sum(axis=0).tolist())
        yield LampRow(part.name, emitter.class_name(), power, "leaves from patches")


def _free_lamps(scene, model):
    """Lamps that are no surfaces, and those that are refused."""
    lights = {light.emitter.ptr: light for light in model.lights.free} if model else {}
    for index, emitter in enumerate(scene.emitters()):
        why = list(inspect_emitter(emitter))
        if not why and LIGHTS.find(emitter.class_name()).on_surface:
            continue
        light = lights.get(emitter.ptr)
        name = f"emitter '{emitter.id()}'" if emitter.id() else f"emitter {index}"
        treatment = "refused: " + "; ".join(why) if why else "shot and looked for"
        yield LampRow(name, emitter.class_name(), light and tuple(light.power()), treatment)
