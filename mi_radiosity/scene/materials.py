"""Reflectances of the faces, and what of a Mitsuba scene is modelled at all."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.points import triangle
from .lights import LIGHTS
from .tessellate import can_mesh, label

DIFFUSE = {"SmoothDiffuse"}
NESTING = {"TwoSidedBRDF", "BlendBSDF"}
CONSTANT = {"SRGBReflectanceSpectrum", "UniformSpectrum", "SRGBEmitterSpectrum", "D65Spectrum"}
POINTS = 16  # of a textured face, that its mean is taken over


class Materials:
    """What the faces are made of: ``rho`` [2 sides, faces, 3], ``two_sided`` [faces], ``textured`` (is any of them?).

    Raises RadiosityError for reflectances that conserve no energy, naming the shape.
    """

    def __init__(self, faces):
        self._faces = faces
        shapes = faces.scene.shapes()
        two_sided = np.array([mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.BackSide) for s in shapes])
        self.two_sided = two_sided[faces.shape]
        self.textured = any(is_textured(s.bsdf()) for s in shapes)
        self.rho = self._mean(POINTS if self.textured else 1)
        faces.refuse(~np.isfinite(self.rho).all(axis=(0, 2)), "has a reflectance that is not a number: repair its BSDF")
        faces.refuse(
            (self.rho >= 1).any(axis=(0, 2)),
            "has a reflectance of 1 or more, which conserves no energy: make it less than 1",
        )
        faces.refuse((self.rho < 0).any(axis=(0, 2)), "has a negative reflectance: make it 0 or more")

    def _mean(self, points):
        """ρ averaged over points of every face [2 sides, faces, 3]."""
        n = len(self._faces)
        face, third, rho = dr.arange(mi.UInt32, n), mi.Float(1 / 3), np.zeros((2, n, 3))
        for k in range(points):
            spread = triangle(*(mi.Float(x) for x in ((k + 0.5) / points, (k * 7 % points + 0.5) / points)))
            u, v = (x + dr.zeros(mi.Float, n) for x in ((third, third) if points == 1 else spread))
            for side in range(2):
                value = self.reflectance_at(face, u, v, dr.full(mi.Bool, side == 1, n))
                rho[side] += np.array(value, dtype=np.float64).reshape(3, n).T / points
        return rho

    def reflectance_at(self, face, u, v, back):
        """ρ at points of faces, on the back side where ``back`` (Bool). Returns Color3f [n]."""
        si = self._faces.surface(face, u, v)
        si.wi = mi.Vector3f(0, 0, dr.select(back, -1.0, 1.0))
        return mi.Color3f(si.bsdf().eval_diffuse_reflectance(si))


# ---- What is modelled ------------------------------------------------------------------------------


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
    parts = (part for part in _nested(bsdf) if isinstance(part, mi.BSDF))
    return next((bad for part in parts if (bad := _unsupported_bsdf(part))), None)


def is_textured(bsdf) -> bool:
    """Does the reflectance of ``bsdf`` vary over a surface?"""
    return any(
        is_textured(part) if isinstance(part, mi.BSDF) else part.class_name() not in CONSTANT for part in _nested(bsdf)
    )


def _inspect_shape(shape, name):
    if not can_mesh(shape):
        yield Finding(name, "only meshes and disks are modelled: export it as a mesh")
        return
    if shape.interior_medium() is not None or shape.exterior_medium() is not None:
        yield Finding(name, "participating media are not modelled: remove the medium")
    if bad := _unsupported_bsdf(shape.bsdf()):
        yield Finding(name, f"its BSDF {bad} is not diffuse: use 'diffuse', 'twosided' or a 'blendbsdf' of those")
    if shape.is_emitter() and mi.has_flag(shape.emitter().flags(), mi.EmitterFlags.SpatiallyVarying):
        yield Finding(name, "its radiance is textured: use a constant radiance")


def inspect(scene) -> list[Finding]:
    """List everything in ``scene`` that the solver does not model."""
    findings = []
    for index, shape in enumerate(scene.shapes()):
        findings += _inspect_shape(shape, f"{label(shape, index)} ({shape.class_name()})")
    for index, emitter in enumerate(scene.emitters()):
        if emitter.class_name() not in LIGHTS:
            what = f"emitter '{emitter.id() or index}' ({emitter.class_name()})"
            findings.append(Finding(what, "only constant area emitters are modelled: use an 'area' emitter"))
    return findings


def require_supported(scene) -> None:
    """Raise RadiosityError, naming the first part of ``scene`` that is not modelled."""
    findings = inspect(scene)
    if findings:
        more = f" (and {len(findings) - 1} more: see `mi-radiosity info`)" if len(findings) > 1 else ""
        raise RadiosityError(f"{findings[0].what}: {findings[0].why}{more}")
