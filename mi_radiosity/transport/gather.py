"""Light gathered where it is asked for: lines to the lamps, and rays into the solved room."""

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, Distribution, totals
from ..core.points import triangle
from ..mesh import Elements
from ..scene import Model


class Gatherer:
    """Irradiance at points of a scene whose radiosity is known.

    reflected: ρ H of the elements (Color3f [elements], W/m²). Points are relative to the patches' origin; each sample
    is one line to the lamps, or one cosine-distributed ray, and its value an unbiased estimate.
    """

    def __init__(self, model: Model, elements: Elements, reflected: "mi.Color3f") -> None:
        self._model, self._elements, self._reflected = model, elements, reflected
        patches = model.patches
        self._lamps = dr.compress(dr.max(patches.emission) > 0)
        self._free = model.lights.free
        if dr.width(self._lamps) == 0:
            return
        emission = dr.gather(mi.Color3f, patches.emission, self._lamps)
        power = mi.Float64(dr.sum(emission) * dr.gather(mi.Float, patches.area, self._lamps))
        self._choice = Distribution(power, totals([power])[0])

    def direct(
        self,
        x: "mi.Point3f",
        normal: "mi.Vector3f",
        lot: "mi.Float",
        s: "mi.Float",
        t: "mi.Float",
        active: "mi.Bool | bool" = True,
    ) -> "mi.Color3f":
        """H from the lamps: E F / p along a line to a point of a lamp that ``lot`` draws by power (Color3f [n])."""
        total = mi.Color3f(0)
        if dr.width(self._lamps):
            total += self._from_surfaces(x, normal, lot, s, t, active)
        for light in self._free:
            direction, distance, irradiance = light.sample(x + self._model.patches.origin, s, t)
            cosine = dr.dot(direction, normal)
            lit = active & (cosine > 0)
            start = x + normal * self._model.patches.lift
            hidden = self._model.rays.blocked(start, start + direction * distance, lit)
            total += dr.select(lit & ~hidden, irradiance * cosine, 0)
        return total

    def _from_surfaces(self, x, normal, lot, s, t, active):
        patches = self._model.patches
        number = self._choice.at(mi.Float64(lot) * dr.opaque(mi.Float64, self._choice.whole))
        lamp = dr.gather(mi.UInt32, self._lamps, number)
        F = self._model.rays.kernel_at(x, normal, lamp, *triangle(s, t), active)
        weight = F * dr.gather(mi.Float, patches.area, lamp) / mi.Float(self._choice.probability(number))
        return dr.gather(mi.Color3f, patches.emission, lamp) * weight

    def indirect(
        self,
        origin: "mi.Point3f",
        direction: "mi.Vector3f",
        number: "mi.UInt32",
        seed: "mi.UInt32",
        active: "mi.Bool | bool" = True,
    ) -> "mi.Color3f":
        """H from the room: the reflected radiosity that a cosine-distributed ray meets (Color3f [n]).

        number: UInt32 [n], seed: UInt32, what rays draw lobes by; what they meet behind lobes shines by itself, too.
        """
        model, elements = self._model, self._elements
        hit = model.rays.follow(origin, direction, number, seed, active=active)
        met = active & (hit.patch != NONE)
        leaf = elements.leaf_at(hit.patch, hit.u, hit.v, met)
        H = dr.gather(mi.Color3f, self._reflected, leaf, met)
        if model.rays.lobes is None:
            return H
        seen = dr.gather(mi.Color3f, model.patches.emission, hit.patch, met & hit.bounced & ~hit.coated)
        return dr.select(active, hit.glow + hit.weight * (H + seen), 0)
