"""What of a Mitsuba scene is modelled, and what is not and why."""

from dataclasses import dataclass

import mitsuba as mi

from ..core.errors import RadiosityError

DIFFUSE = {"SmoothDiffuse"}
NESTING = {"TwoSidedBRDF", "BlendBSDF"}
CONSTANT = {"SRGBReflectanceSpectrum", "UniformSpectrum", "SRGBEmitterSpectrum", "D65Spectrum"}


@dataclass(frozen=True)
class Finding:
    """One part of a scene that is not modelled."""

    what: str  # "shape 'ball' (Sphere)"
    why: str  # what is wrong and what to do


def _nested(obj):
    """The Mitsuba objects that ``obj`` is made of, itself excluded."""

    class Collect(mi.TraversalCallback):
        found = ()

        def put(self, name, value, flags):
            if hasattr(value, "class_name"):
                self.found += (value,)

    callback = Collect()
    obj.traverse(callback)
    return callback.found


def _unsupported_bsdf(bsdf):
    """Class name of the first part of ``bsdf`` that is not diffuse, or None."""
    kind = bsdf.class_name()
    if kind in DIFFUSE:
        return None
    if kind not in NESTING:
        return kind
    return next((bad for part in _nested(bsdf) if isinstance(part, mi.BSDF) and (bad := _unsupported_bsdf(part))), None)


def is_textured(bsdf):
    """Does the reflectance of ``bsdf`` vary over a surface?"""
    return any(
        is_textured(part) if isinstance(part, mi.BSDF) else part.class_name() not in CONSTANT for part in _nested(bsdf)
    )


def label(shape, index):
    """How a shape is called in messages: its id, or its place in the scene."""
    return f"shape '{shape.id()}'" if shape.id() else f"shape {index}"


def inspect(scene):
    """List everything in ``scene`` that the solver does not model (list of Finding)."""
    findings = []
    for index, shape in enumerate(scene.shapes()):
        name = f"{label(shape, index)} ({shape.class_name()})"
        if not isinstance(shape, mi.Mesh) and shape.class_name() != "Disk":
            findings.append(Finding(name, "only meshes and disks are modelled: export it as a mesh"))
            continue
        if shape.interior_medium() is not None or shape.exterior_medium() is not None:
            findings.append(Finding(name, "participating media are not modelled: remove the medium"))
        if bad := _unsupported_bsdf(shape.bsdf()):
            findings.append(
                Finding(name, f"its BSDF {bad} is not diffuse: use 'diffuse', 'twosided' or a 'blendbsdf' of those")
            )
        if shape.is_emitter() and mi.has_flag(shape.emitter().flags(), mi.EmitterFlags.SpatiallyVarying):
            findings.append(Finding(name, "its radiance is textured: use a constant radiance"))
    for index, emitter in enumerate(scene.emitters()):
        if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            findings.append(
                Finding(
                    f"emitter '{emitter.id() or index}' ({emitter.class_name()})",
                    "only constant area emitters are modelled: use an 'area' emitter",
                )
            )
    return findings


def require_supported(scene):
    """Raise RadiosityError, naming the first part of ``scene`` that is not modelled."""
    findings = inspect(scene)
    if findings:
        more = f" (and {len(findings) - 1} more: see `mi-radiosity info`)" if len(findings) > 1 else ""
        raise RadiosityError(f"{findings[0].what}: {findings[0].why}{more}")
