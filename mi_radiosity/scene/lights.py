"""Lamps: one class per kind, and all lamps of a scene behind one face."""

import copy
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import opaque_index, owned, owned_vectors, totals
from ..core.errors import RadiosityError
from ..core.plugins import Registry
from ..core.points import kronecker
from .averages import Averages
from .faces import Faces
from .state import Parameters

LIGHTS = Registry("emitter")
SAMPLES = 1 << 18  # rays that a lamp's power is averaged over
GLANCES = 1 << 12  # directions in which a sky is looked at for a sun
SHARP = 300 / (4 * np.pi)  # density over directions, 1/sr, of parts of a sky that are as small and bright as a sun


class Light:
    """A kind of lamp. A subclass names, as ``emitters``, the classes of Mitsuba's emitters it stands for.

    A kind that covers surfaces says ``on_surface = True`` and defines `exitance`: its light leaves from patches,
    as all reflected light does. Any other kind is made once per lamp, with the ``emitter``, its ``scene`` and the
    box around all faces (``low``, ``high`` [3]), and defines `power`, `shoot` and `sample`. Places are those of the
    scene, in m.
    """

    emitters: tuple[str, ...] = ()
    on_surface = False
    color: Any = 1.0  # what rays see of it that leave the scene is multiplied by

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        for name in vars(cls).get("emitters", ()):
            LIGHTS.add(name, cls)

    def __init__(self, emitter: "mi.Emitter", scene: "mi.Scene", low: np.ndarray, high: np.ndarray) -> None:
        self.emitter, self.scene, self.low, self.high = emitter, scene, low, high

    @staticmethod
    def refusal(emitter: "mi.Emitter") -> str | None:
        """Why an emitter of this kind cannot be used, and what to do, or None."""

    @property
    def is_sky(self) -> bool:
        """Is it what rays see that leave the scene?"""
        return self.emitter.is_environment()

    @staticmethod
    def exitance(emitter: "mi.EmitterPtr", si: "mi.SurfaceInteraction3f") -> "mi.Color3f":
        """E = π L_e of emitters at points of their shapes, W/m² (EmitterPtr, SurfaceInteraction3f ─► Color3f [n])."""
        raise NotImplementedError

    def power(self) -> Sequence[float]:
        """What `shoot` sends into the scene, W (three floats)."""
        raise NotImplementedError

    def shoot(
        self, x: "mi.Float", y: "mi.Float", s: "mi.Float", t: "mi.Float"
    ) -> "tuple[mi.Point3f, mi.Vector3f, mi.Color3f]":
        """Rays from four uniform numbers each (Float [n]): origin, unit direction, and the power each would
        carry were it the only one, whose mean is `power` (Point3f, Vector3f, Color3f [n])."""
        raise NotImplementedError

    def sample(self, point: "mi.Point3f", s: "mi.Float", t: "mi.Float") -> "tuple[mi.Vector3f, mi.Float, mi.Color3f]":
        """Towards the lamp from points, with two uniform numbers each: unit direction, distance (infinite for emitters
        at infinity), and the irradiance of an unblocked surface that faces that way, over the density of the sample
        (Vector3f, Float, Color3f [n])."""
        raise NotImplementedError

    def fingerprint(self) -> bytes:
        """What tells it from other lamps: all parameters of the emitter."""
        return bytes(Parameters(self.emitter))

    def density(self, direction: "mi.Vector3f") -> "mi.Float":
        """Density of `sample` over directions, 1/sr, if rays that leave the scene see the lamp; else 0 (Float [n])."""
        return mi.Float(0)

    @property
    def may_be_sharp(self) -> bool:
        """Is some of it as if from a point, so that its shadows are sharp, and no ray meets it by chance?"""
        return not self.is_sky

    def is_sharp(self, direction: "mi.Vector3f") -> "mi.Bool":
        """Is it so, seen along directions (Bool [n])?"""
        return dr.full(mi.Bool, self.may_be_sharp, dr.width(direction))

    def share_of_rays(self, direction: "mi.Vector3f", cosine: "mi.Float", rays_per_line: "float | None") -> "mi.Float":
        """The balance heuristic's weight of cosine-distributed rays that see the lamp, of which there are so many per
        `sample` (None: there are no samples) (Float [n])."""
        if rays_per_line is None:
            return mi.Float(1)
        density, of_rays = self.density(direction), rays_per_line * dr.maximum(cosine, 0) * dr.inv_pi
        return dr.select(density > 0, of_rays / (density + of_rays), 0)

    def lights_up(
        self,
        rays: Any,
        x: "mi.Point3f",
        normal: "mi.Vector3f",
        s: "mi.Float",
        t: "mi.Float",
        active: "mi.Bool | bool" = True,
        rays_per_line: float = 0.0,
        only_sharp: bool = False,
    ) -> "tuple[mi.Color3f, mi.Color3f, mi.Bool]":
        """H at points x, relative to the patches' origin, with their normals: one `sample` each, weighed against the
        rays that see the lamp, and by itself (two Color3f [n]); and is it sharp light (Bool [n])?"""
        direction, distance, irradiance = self.sample(x + rays.patches.origin, s, t)
        cosine, sharp = dr.dot(direction, normal), self.is_sharp(direction)
        lit = active & (cosine > 0) & (dr.max(irradiance) > 0)
        if only_sharp:
            lit &= sharp
        start = x + normal * rays.patches.lift
        hidden = rays.blocked_along(start, direction, distance, lit)
        found = dr.select(lit & ~hidden, irradiance * cosine, 0)
        return found * (1 - self.share_of_rays(direction, cosine, rays_per_line)), found, sharp


class Area(Light):
    """Mitsuba's `area`: a radiance L_e on the front of any shape, constant or textured."""

    emitters = ("AreaLight",)
    on_surface = True

    @staticmethod
    def exitance(emitter: "mi.EmitterPtr", si: "mi.SurfaceInteraction3f") -> "mi.Color3f":
        si.wi = mi.Vector3f(0, 0, 1)
        return dr.pi * mi.Color3f(emitter.eval(si))


class Free(Light):
    """Lamps at a point, by Mitsuba's own sampling: `point`, `spot` and `projector`, textured or not."""

    emitters: tuple[str, ...] = ("PointLight", "SpotLight", "Projector")

    def __init__(self, emitter: "mi.Emitter", scene: "mi.Scene", low: np.ndarray, high: np.ndarray) -> None:
        super().__init__(emitter, scene, low, high)
        number = dr.arange(mi.UInt32, SAMPLES)
        weight = self.shoot(*kronecker(number, opaque_index(0), opaque_index(0)))[2]
        dr.eval(weight)  # in one go: sums one by one would draw all again
        self._power = [total / SAMPLES for total in totals([mi.Float64(w) for w in weight])]

    def power(self) -> Sequence[float]:
        return self._power

    def fingerprint(self) -> bytes:
        """Power and a few rays, to three digits: not all parameters are shown to Python."""
        number = dr.arange(mi.UInt32, 16)
        origin, direction, weight = self.shoot(*kronecker(number, opaque_index(0), opaque_index(0)))
        rows = [np.array(x, dtype=np.float64).reshape(3, -1).T for x in (origin, direction, weight)]
        rows[0] = (rows[0] - self.low) / max(np.max(self.high - self.low), 1e-30)
        rows[2] = rows[2] / max(*self._power, 1e-30)
        power = [float(f"{p:.3g}") for p in self._power]
        return (np.concatenate([power, np.round(np.column_stack(rows).ravel(), 2)]) + 0.0).tobytes()

    def shoot(
        self, x: "mi.Float", y: "mi.Float", s: "mi.Float", t: "mi.Float"
    ) -> "tuple[mi.Point3f, mi.Vector3f, mi.Color3f]":
        ray, weight = self.emitter.sample_ray(0.0, 0.0, mi.Point2f(x, y), mi.Point2f(s, t))
        n = dr.width(x)
        return ray.o + dr.zeros(mi.Point3f, n), ray.d + dr.zeros(mi.Vector3f, n), _sound(weight, n)

    def sample(self, point: "mi.Point3f", s: "mi.Float", t: "mi.Float") -> "tuple[mi.Vector3f, mi.Float, mi.Color3f]":
        it = dr.zeros(mi.SurfaceInteraction3f, dr.width(point))
        it.p = point
        sample, weight = self.emitter.sample_direction(it, mi.Point2f(s, t))
        n = dr.width(point)
        return sample.d + dr.zeros(mi.Vector3f, n), sample.dist, _sound(weight, n)


class Infinite(Free):
    """Lamps that are far away: `directional`, `constant`, `envmap`, `sunsky` and `timed_sunsky`.

    Directions are Mitsuba's. Rays start on the box around the scene, uniformly on its outline as seen from there, so
    that ``power`` is what enters the box and no ray misses it: Mitsuba's own start on a sphere around it.
    """

    emitters = (
        "DirectionalEmitter",
        "ConstantBackgroundEmitter",
        "EnvironmentMapEmitter",
        "SunskyEmitter",
        "TimedSunskyEmitter",
    )

    def sample(self, point: "mi.Point3f", s: "mi.Float", t: "mi.Float") -> "tuple[mi.Vector3f, mi.Float, mi.Color3f]":
        """The distance is infinite. Mitsuba's own distance ends at a bounding sphere, and Mitsuba 3.9.1 makes that
        sphere too small in scenes whose rectangles it has merged (docs/mitsuba_issues.md)."""
        direction, _, irradiance = super().sample(point, s, t)
        return direction, dr.full(mi.Float, dr.inf, dr.width(point)), irradiance

    @cached_property
    def may_be_sharp(self) -> bool:
        """As some directions drawn by what they bring tell: a sun is among them."""
        if not self.is_sky:
            return True
        s, t, _, _ = kronecker(dr.arange(mi.UInt32, GLANCES), opaque_index(0), opaque_index(0))
        direction = self.sample(
            dr.zeros(mi.Point3f, GLANCES) + mi.Point3f(*map(float, self.low + self.high)) / 2, s, t
        )[0]
        return bool(dr.any(self.is_sharp(direction)))

    def is_sharp(self, direction: "mi.Vector3f") -> "mi.Bool":
        """All of a lamp of one direction; of a sky the sun, and what else is like it."""
        return self.density(direction) > SHARP if self.is_sky else super().is_sharp(direction)

    def density(self, direction: "mi.Vector3f") -> "mi.Float":
        if not self.is_sky:
            return mi.Float(0)
        sample = dr.zeros(mi.DirectionSample3f, dr.width(direction))
        sample.d = direction
        return self.emitter.pdf_direction(dr.zeros(mi.Interaction3f), sample)

    def shoot(
        self, x: "mi.Float", y: "mi.Float", s: "mi.Float", t: "mi.Float"
    ) -> "tuple[mi.Point3f, mi.Vector3f, mi.Color3f]":
        low, high = (mi.Vector3f(*(dr.opaque(mi.Float, c) for c in corner)) for corner in (self.low, self.high))
        size = high - low
        centre = mi.Point3f(low + 0.5 * size) + dr.zeros(mi.Point3f, dr.width(x))
        towards, _, radiance = self.sample(centre, x, y)
        # The three sides of the box that face the lamp, by their area across the direction.
        sides = mi.Vector3f(size.y * size.z, size.z * size.x, size.x * size.y) * dr.abs(towards)
        outline = sides.x + sides.y + sides.z
        at = s * outline
        first, second = at < sides.x, at < sides.x + sides.y
        s = dr.select(
            first, at / sides.x, dr.select(second, (at - sides.x) / sides.y, (at - sides.x - sides.y) / sides.z)
        )
        s = dr.clip(s, 0, 1)
        near = dr.select(towards > 0, mi.Vector3f(1), 0)
        place = dr.select(first, mi.Vector3f(near.x, s, t), mi.Vector3f(t, near.y, s))
        place = dr.select(second, place, mi.Vector3f(s, t, near.z))
        pad = 2.0**-10 * dr.norm(size)
        return mi.Point3f(low + place * size + towards * pad), -towards, radiance * outline


class DirectionalArea(Free):
    """Mitsuba's `directionalarea` on a flat shape: light along its normal, which falls on what is straight ahead."""

    emitters = ("DirectionalArea",)

    @staticmethod
    def refusal(emitter: "mi.Emitter") -> str | None:
        normal = _normals(emitter.get_shape())
        if dr.all(dr.dot(normal, dr.gather(mi.Vector3f, normal, 0)) > 1 - 1e-5):
            return None
        return "its emitter 'directionalarea' is on a curved shape: put it on a flat one, or use 'area'"

    def __init__(self, emitter: "mi.Emitter", scene: "mi.Scene", low: np.ndarray, high: np.ndarray) -> None:
        self._normal = mi.Vector3f(*(dr.mean(c) for c in _normals(emitter.get_shape())))
        super().__init__(emitter, scene, low, high)

    def sample(self, point: "mi.Point3f", s: "mi.Float", t: "mi.Float") -> "tuple[mi.Vector3f, mi.Float, mi.Color3f]":
        n, pad = dr.width(point), dr.opaque(mi.Float, 2.0**-14 * np.linalg.norm(self.high - self.low))
        towards = -self._normal + dr.zeros(mi.Vector3f, n)
        si = self.scene.ray_intersect(mi.Ray3f(point + towards * pad, towards))
        # The ray runs against the emission of a flat shape, so it hits the front. Mitsuba's si.n is no proof of the
        # side: it points backwards on mirrored rectangles.
        met = si.shape == mi.ShapePtr(self.emitter.get_shape())
        _, radiance = self.emitter.sample_wavelengths(si, 0.0, met)
        return towards, dr.select(met, si.t + 0.5 * pad, 1), dr.select(met, _sound(radiance, n), 0)


class Lights:
    """The lamps of a scene: ``exitance`` of its faces, the mean of each, W/m² [faces, 3], and the ``free`` ones that
    are no surfaces; ``textured``: does the exitance vary over a face?

    Raises RadiosityError if there is no emitter where one is ``required``, or if the light of one is impossible, naming
    the shape.
    """

    def __init__(self, faces: Faces, required: bool = True) -> None:
        self._faces, self.required = faces, required
        self._dim: Any = None
        emitters = [part.shape.emitter() for part in faces.parts]
        kinds = [None if emitter is None else LIGHTS.find(emitter.class_name()) for emitter in emitters]
        self._kinds = list(dict.fromkeys(kind for kind in kinds if kind and kind.on_surface))
        lamps = [kind in self._kinds for kind in kinds]
        textured = np.array([lamp and varies(emitter) for emitter, lamp in zip(emitters, lamps)], dtype=bool)
        self.textured, self._averages = bool(textured.any()), Averages(faces, textured[faces.shape])
        if self._kinds:
            self._emitters = mi.EmitterPtr([e if lamp else None for e, lamp in zip(emitters, lamps)])
            self._kind = owned(mi.UInt32, [self._kinds.index(kind) if kind in self._kinds else 0 for kind in kinds])
            self._shape = owned(mi.UInt32, faces.shape)
        self.exitance = self._of_faces(np.flatnonzero(np.array(lamps)[faces.shape]))
        self.free = self._free()
        if required and not self._kinds and not self.free:
            raise RadiosityError("the scene has no light: add a lamp, such as an 'area' emitter of a shape")

    def _of_faces(self, lamps):
        """E of all faces, those of ``lamps`` (int [n]) only being more than 0."""
        faces, exitance, n = self._faces, np.zeros((len(self._faces), 3)), len(lamps)
        if n:
            face, zero, one = owned(mi.UInt32, lamps), dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
            mean = self.mean_exitance(face, zero, zero, one)
            exitance[lamps] = np.array(mean, dtype=np.float64).reshape(3, n).T
        faces.refuse(
            ~np.isfinite(exitance).all(axis=1) | (exitance < 0).any(axis=1),
            "emits a radiance that is negative or not a number: repair its emitter",
        )
        return exitance

    def _free(self):
        """Lamps that are no surfaces, in an order that does not depend on Mitsuba's."""
        scene, box = self._faces.scene, (self._faces.low, self._faces.high)
        kinds = [(emitter, LIGHTS.find(emitter.class_name())) for emitter in scene.emitters()]
        lights = [kind(emitter, scene, *box) for emitter, kind in kinds if not kind.on_surface]
        return sorted(lights, key=lambda light: light.fingerprint())

    def dimmed(self, shapes: np.ndarray, free: "list[Light]") -> "Lights":
        """The same lamps, exitance times ``shapes`` [shapes of faces.tracing, 3], and ``free`` in the place of those
        that are no surfaces."""
        other = copy.copy(self)
        other.exitance, other.free = self.exitance * shapes[self._faces.shape], free
        other._dim = owned_vectors(mi.Color3f, shapes)
        return other

    # ---- Light at points and in directions -----------------------------------------------------

    def exitance_at(
        self, face: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool" = True
    ) -> "mi.Color3f":
        """E at points of the fronts of faces (Color3f [n])."""
        total = mi.Color3f(0)
        if self._kinds:
            si, shape = self._faces.surface(face, u, v), dr.gather(mi.UInt32, self._shape, face, active)
            emitter, which = (dr.gather(type(x), x, shape, active) for x in (self._emitters, self._kind))
            for number, kind in enumerate(self._kinds):
                total += dr.select(active & (which == number), kind.exitance(emitter, si), 0)
            if self._dim is not None:
                total *= dr.gather(mi.Color3f, self._dim, shape, active)
        return total

    def mean_exitance(self, face: "mi.UInt32", u0: "mi.Float", v0: "mi.Float", scale: "mi.Float") -> "mi.Color3f":
        """E averaged over triangles (u0 + scale a, v0 + scale b) of faces' fronts (see `Averages`; Color3f [n])."""

        def value(face, u, v, back):
            return self.exitance_at(face, u, v)

        return self._averages.mean(value, face, dr.full(mi.Bool, False, dr.width(face)), u0, v0, scale)

    def at(
        self, patches: Any, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool" = True
    ) -> "mi.Color3f":
        """E at points of patches (Color3f [n])."""
        mean = dr.gather(mi.Color3f, patches.emission, patch, active)
        if not self.textured:
            return mean
        shines = active & (dr.max(mean) > 0)
        return self.exitance_at(dr.gather(mi.UInt32, patches.face, patch, shines), u, v, shines)

    def sky(self, direction: "mi.Vector3f", active: "mi.Bool | bool" = True) -> "mi.Color3f":
        """E = π L of what rays see that leave the scene in a direction (Vector3f ─► Color3f [n])."""
        if self.sky_light is None:
            return mi.Color3f(0)
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
        si.wi = -direction
        seen = dr.select(active, mi.Color3f(self.sky_light.emitter.eval(si, active)), 0)
        return dr.pi * seen * self.sky_light.color

    @property
    def any_power(self) -> bool:
        """Does any emitter have power?"""
        on_surfaces = (self.exitance * self._faces.area[:, None]).any()
        return bool(on_surfaces) or any(any(light.power()) for light in self.free)

    @property
    def may_be_sharp(self) -> bool:
        """Does a lamp that is no surface cast sharp shadows?"""
        return any(light.may_be_sharp for light in self.free)

    @property
    def sky_light(self) -> Light | None:
        """The lamp that rays see which leave the scene, or None."""
        return next((light for light in self.free if light.is_sky), None)


def varies(emitter: "mi.Emitter") -> bool:
    """Is the radiance of an emitter textured?"""
    return bool(mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying))


def _sound(weight, n):
    """Weights that Mitsuba gives (Color3f [n]), 0 instead of what is no number."""
    weight = mi.Color3f(weight) + dr.zeros(mi.Float, n)
    return dr.select(dr.all(dr.isfinite(weight)), dr.maximum(weight, 0), 0)


def _normals(shape):
    """Normals at some points of a shape (Vector3f [16])."""
    k = dr.arange(mi.UInt32, 16)
    points = mi.Point2f((mi.Float(k) + 0.5) / 16, (mi.Float(k * 5 % 16) + 0.5) / 16)
    return mi.Vector3f(shape.sample_position(0.0, points).n) + dr.zeros(mi.Vector3f, 16)
