"""Lamps as rough lobes see them: by lines to them, and by the lobes' own rays, weighed by the balance heuristic."""

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE
from ..core.points import triangle
from ..scene import Model
from ..scene.gloss import Gloss
from ..scene.hit import Hit
from .lamps import LampChoice

CANDIDATES = 4  # points of lamps that a line is chosen from


class Highlights:
    """What rays that follow lobes ask for at surfaces that have rough ones.

    One line to a lamp that is a surface, drawn by power and then by distance and slant from some (Talbot, Cline,
    Egbert 2005: resampled importance), and one to each of the others (Veach 1997, eq. 9.8).
    """

    def __init__(self, model: Model, lamps: LampChoice) -> None:
        self._model, self._lamps = model, lamps

    def light(
        self,
        gloss: Gloss,
        share: "mi.Float",
        bsdf: "mi.BSDFPtr",
        si: "mi.SurfaceInteraction3f",
        random: "mi.PCG32",
        active: "mi.Bool",
    ) -> "mi.Color3f":
        """π L that rough lobes of a ``share`` (see `Gloss`) send on of the lamps, as lines find it, W/m² (Color3f
        [n])."""
        rays, patches, lights = self._model.rays, self._model.patches, self._model.lights
        total = mi.Color3f(0)

        def add(direction, distance, light, density, on):
            """What becomes of light π L, over its density, from so far along a direction."""
            value, pdf = gloss.light(bsdf, si, si.to_local(direction), share, on)
            on = on & (dr.max(value) > 0)
            near, far = si.spawn_ray_to(si.p + direction * distance), si.spawn_ray(direction)
            on &= ~rays.scene.ray_test(dr.select(dr.isfinite(distance), near, far), active=on)
            weight = dr.select(density > 0, density / (density + pdf), 1)
            return dr.select(on, value * light * weight, 0)

        if self._lamps.count:
            lamp, u, v, density, worth = self._drawn(si, random, active)
            d = patches.point(lamp, u, v) + patches.origin - si.p
            distance = dr.norm(d)
            cosine = -dr.dot(dr.gather(mi.Vector3f, patches.normal, lamp), d) / distance
            on = active & (worth > 0) & rays.on_top(lamp, u, v)
            density = dr.select(on, density * dr.square(distance) / cosine, 1)
            light = lights.at(patches, lamp, u, v, on) * worth
            total += add(d / distance, distance, light / density, density, on)
        for lamp in lights.free:
            direction, distance, irradiance = lamp.sample(si.p, random.next_float32(), random.next_float32())
            on = active & (dr.max(irradiance) > 0)
            total += add(direction, distance, dr.pi * irradiance, lamp.density(direction), on)
        return total

    def _drawn(self, si, random, active):
        """A point of a lamp: of some drawn by power one, in proportion to what it gives here if nothing is between; its
        patch, u, v, density, 1/m², and by how much more than that says it stands for the others (UInt32, four Float
        [n])."""
        patches, n = self._model.patches, dr.width(si.p)
        kept = dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n), dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
        whole, own = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
        candidates = min(CANDIDATES, self._lamps.count)
        for _ in range(candidates):
            u, v = triangle(random.next_float32(), random.next_float32())
            lamp, density = self._lamps.draw(random.next_float32())
            d = patches.point(lamp, u, v) + patches.origin - si.p
            r2 = dr.squared_norm(d)
            cosine = dr.maximum(-dr.dot(dr.gather(mi.Vector3f, patches.normal, lamp, active), d), 0)
            power = dr.max(dr.gather(mi.Color3f, patches.emission, lamp, active))
            weight = dr.select(r2 > 0, power * cosine / (density * r2 * dr.sqrt(r2)), 0)
            whole += weight
            takes = random.next_float32() * whole < weight
            kept = tuple(dr.select(takes, new, old) for new, old in zip((lamp, u, v, density), kept))
            own = dr.select(takes, weight, own)
        return *kept, whole / (candidates * own)

    def density(self, x: "mi.Point3f", direction: "mi.Vector3f", hit: Hit) -> "mi.Float":
        """Density over directions, 1/sr, of the lines that find what rays from x have met: lamps, or the sky."""
        patches, sky = self._model.patches, self._model.lights.sky_light
        density = mi.Float(0)
        if self._lamps.count:
            met = hit.valid & (hit.patch != NONE)
            patch = dr.select(met, hit.patch, 0)
            d = patches.point(patch, hit.u, hit.v) + patches.origin - x
            cosine = -dr.dot(dr.gather(mi.Vector3f, patches.normal, patch), direction)
            found = met & (cosine > 0)
            of_area = self._lamps.density(patch, None, found)
            density = dr.select(found, of_area * dr.squared_norm(d) / cosine, 0)
        if sky is not None:
            density = dr.select(hit.valid, density, sky.density(direction))
        return density
