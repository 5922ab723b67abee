"""Light gathered where it is asked for: lines to the lamps, and rays into the solved room."""

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, Distribution, totals
from ..core.points import cosine_direction, triangle


class Gatherer:
    """Irradiance at points of a scene whose radiosity is known.

    reflected: ρ H of the elements (Color3f [elements], W/m²). Points are relative to the patches' origin; each sample
    is one line to the lamps, or one cosine-distributed ray, and its value an unbiased estimate.
    """

    def __init__(self, model, elements, reflected):
        self._model, self._elements, self._reflected = model, elements, reflected
        patches = model.patches
        self._lamps = dr.compress(dr.max(patches.emission) > 0)
        self._free = model.lights.free
        if dr.width(self._lamps) == 0:
            return
        emission = dr.gather(mi.Color3f, patches.emission, self._lamps)
        power = mi.Float64(dr.sum(emission) * dr.gather(mi.Float, patches.area, self._lamps))
        self._choice = Distribution(power, totals([power])[0])
        self._density = dr.zeros(mi.Float, patches.count)  # of points drawn on lamps, 1/m²
        probability = self._choice.probability(dr.arange(mi.UInt32, dr.width(self._lamps)))
        dr.scatter(self._density, mi.Float(probability / dr.gather(mi.Float, patches.area, self._lamps)), self._lamps)
        dr.eval(self._density)

    def irradiance(self, x, normal, a, b, s, t, lot, number, seed):
        """H from one line to the lamps (numbers ``a``, ``b``, ``lot`` in [0, 1)) and one cosine-distributed ray
        (``s``, ``t``) (Color3f [n]). number, seed: as in `indirect`.

        Lamps are found by both; the balance heuristic (Veach 1997) weighs them, so that no estimate exceeds their
        exitance however near they are.
        """
        rays, patches = self._model.rays, self._model.patches
        ray = x + patches.origin + normal * patches.lift, cosine_direction(normal, s, t)
        met = rays.trace(*ray)
        end = met if rays.lobes is None else rays.follow(*ray, number, seed)
        return self.direct(x, normal, lot, a, b, met=met) + self._reflected_at(end)

    def direct(self, x, normal, lot, s, t, active=True, met=None):
        """H from the lamps: E F / p along a line to a point of a lamp that ``lot`` draws by power (Color3f [n]).

        With ``met``, where cosine-distributed rays from there end (Hit [n]): E F / (p + F) along both.
        """
        total = mi.Color3f(0)
        if dr.width(self._lamps):
            total += self._from_surfaces(x, normal, lot, s, t, active, met is not None)
            if met is not None:
                total += self._met(x, normal, met)
        for light in self._free:
            direction, distance, irradiance = light.sample(x + self._model.patches.origin, s, t)
            cosine = dr.dot(direction, normal)
            lit = active & (cosine > 0)
            start = x + normal * self._model.patches.lift
            hidden = self._model.rays.blocked(start, start + direction * distance, lit)
            total += dr.select(lit & ~hidden, irradiance * cosine, 0)
        return total

    def _from_surfaces(self, x, normal, lot, s, t, active, shared):
        patches = self._model.patches
        number = self._choice.at(mi.Float64(lot) * dr.opaque(mi.Float64, self._choice.whole))
        lamp = dr.gather(mi.UInt32, self._lamps, number)
        F = self._model.rays.kernel_at(x, normal, lamp, *triangle(s, t), active)
        density = dr.gather(mi.Float, self._density, lamp)
        return dr.gather(mi.Color3f, patches.emission, lamp) * (F / (density + F if shared else density))

    def _met(self, x, normal, hit):
        """E F / (p + F) of the lamps that cosine-distributed rays meet: their density over the lamp is F."""
        patches, met = self._model.patches, hit.patch != NONE
        density = dr.gather(mi.Float, self._density, hit.patch, met)
        n = dr.gather(mi.Vector3f, patches.normal, hit.patch, met)
        d = patches.point(dr.select(met, hit.patch, 0), hit.u, hit.v) - x
        r2 = dr.squared_norm(d)
        # Times π r⁴, so that nothing is divided by a small distance.
        cosines = dr.maximum(dr.dot(normal, d), 0) * dr.maximum(-dr.dot(n, d), 0)
        weight = dr.select(met & (density > 0), cosines / (density * (dr.pi * r2 * r2) + cosines), 0)
        return dr.gather(mi.Color3f, patches.emission, hit.patch, met) * weight

    def indirect(self, origin, direction, number, seed, active=True):
        """H from the room: the reflected radiosity that a cosine-distributed ray meets (Color3f [n]).

        number: UInt32 [n], seed: UInt32, what rays draw lobes by; what they meet behind lobes shines by itself, too.
        """
        return self._reflected_at(self._model.rays.follow(origin, direction, number, seed, active=active), active)

    def _reflected_at(self, hit, active=True):
        model, elements = self._model, self._elements
        met = active & (hit.patch != NONE)
        leaf = elements.leaf_at(hit.patch, hit.u, hit.v, met)
        H = dr.gather(mi.Color3f, self._reflected, leaf, met)
        if model.rays.lobes is None:
            return H
        seen = dr.gather(mi.Color3f, model.patches.emission, hit.patch, met & hit.bounced & ~hit.coated)
        return dr.select(active, hit.glow + hit.weight * (H + seen), 0)
