"""Light gathered where it is asked for: lines to the lamps, and rays into the solved room."""

import copy
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, opaque_index
from ..core.points import Stream, kronecker, stream_seed, triangle
from ..mesh import Elements, Exposure
from ..scene import Model
from .highlights import Highlights
from .lamps import LampChoice
from .landings import Landings

LOOKS = 32  # points of a crossed leaf


@dataclass
class Places:
    """Points that look for light, [n]; relative to the patches' origin. ``leaf``: elements they lie on, if known."""

    x: "mi.Point3f"
    normal: "mi.Vector3f"
    leaf: "mi.UInt32 | None" = None


class Gatherer:
    """Irradiance at points of a scene whose radiosity is known.

    reflected: ρ H of the elements (Color3f [elements], W/m²); exposure, landings: on which side of a wall that crosses
    a leaf that light is. Each sample is one line to the lamps, or one cosine-distributed ray, and its value
    an unbiased estimate. Where both are drawn, lamps are found by both; the balance heuristic (Veach 1997) weighs them,
    so that no estimate exceeds their exitance however near they are.
    """

    def __init__(
        self, model: Model, elements: Elements, exposure: Exposure, landings: Landings, reflected: "mi.Color3f"
    ) -> None:
        self._model, self._elements, self._reflected = model, elements, reflected
        self._exposure = exposure
        self._place(landings)
        self._lamps = LampChoice(model, elements)
        self._free = model.lights.free
        self.highlights = Highlights(model, self._lamps) if model.rays.glossy else None

    def seeing(self, reflected: "mi.Color3f", landings: Landings) -> "Gatherer":
        """The same for other values of ρ H, and where that light is."""
        other = copy.copy(self)
        other._reflected = reflected
        other._place(landings)
        return other

    def _place(self, landings):
        """Look how much of each crossed leaf is in sight of where its light came down: all of its light is there."""
        self._landings = landings
        if landings.slots == 0:
            return
        e, rays = self._elements, self._model.rays
        leaves = dr.gather(
            mi.UInt32, e.leaves, dr.compress(dr.gather(mi.UInt32, self._exposure.slot, e.leaves) != NONE)
        )
        k = dr.arange(mi.UInt32, dr.width(leaves) * LOOKS)
        leaf, number = dr.gather(mi.UInt32, leaves, k // LOOKS), k % LOOKS
        slot, patch = dr.gather(mi.UInt32, self._exposure.slot, leaf), dr.gather(mi.UInt32, e.patch, leaf)
        x0, x1, _, _ = kronecker(number, e.key(leaves), opaque_index(stream_seed(0, Stream.SIGHT)), k // LOOKS)
        u, v = e.patch_point(leaf, *triangle(x0, x1))
        asked = landings.any_on(slot, True) & rays.on_top(patch, u, v)
        seen = landings.in_sight(e, rays, leaf, slot, e.patches.above(patch, u, v), asked)
        share = dr.block_sum(dr.select(seen, mi.Float(1 / LOOKS), 0), LOOKS)
        self._bright = dr.zeros(mi.Float, landings.slots)
        more = self._exposure.open_share(e, leaves) / dr.maximum(share, 2 / LOOKS)
        dr.scatter(self._bright, more, dr.gather(mi.UInt32, self._exposure.slot, leaves))
        dr.eval(self._bright)

    def lines(
        self,
        places: Places,
        lot: "mi.Float",
        s: "mi.Float",
        t: "mi.Float",
        rays_per_line: float = 0.0,
        active: "mi.Bool | bool" = True,
    ) -> "tuple[mi.Color3f, mi.Color3f]":
        """H from the lamps along lines to points of them: E F / (p + c F), p the density of the point, and E F / p,
        which is all of it without `rays` (two Color3f [n]).

        lot, s, t: uniform numbers that draw a lamp and a point of it; rays_per_line: c, how many `rays` there are per
        line, which find lamps as well.
        """
        x, normal, rays = places.x, places.normal, self._model.rays
        shared, alone = mi.Color3f(0), mi.Color3f(0)
        if self._lamps.count:
            lamp, density = self._lamps.draw(lot, places.leaf)
            u, v = triangle(s, t)
            F = rays.kernel_at(x, normal, lamp, u, v, active)
            by_rays = dr.select(self._is_met_by_rays(lamp), rays_per_line * F, 0)
            lit = self._model.lights.at(self._model.patches, lamp, u, v, F > 0) * F
            shared, alone = lit / (density + by_rays), lit / density
        for light in self._free:
            found = light.lights_up(rays, x, normal, s, t, active, rays_per_line)
            shared, alone = shared + found[0], alone + found[1]
        return shared, alone

    def rays(
        self,
        places: Places,
        direction: "mi.Vector3f",
        number: "mi.UInt32",
        seed: "mi.UInt32",
        rays_per_line: float | None = None,
        active: "mi.Bool | bool" = True,
    ) -> "tuple[mi.Color3f, mi.Color3f]":
        """H from the room, and H from the lamps, that cosine-distributed rays meet (two Color3f [n]).

        number: UInt32 [n], seed: UInt32, what rays draw lobes by. rays_per_line: see `lines`; without lines, None.
        What rays meet behind lobes that are traced shines by itself, too.
        """
        model, patches = self._model, self._model.patches
        origin = places.x + patches.origin + places.normal * patches.lift
        hit = model.rays.follow(origin, direction, number, seed, active=active, highlights=self.highlights)
        met = active & (hit.patch != NONE)
        H = self._looked_up(hit, met)
        emission = model.lights.at(patches, hit.patch, hit.u, hit.v, met)
        if model.rays.lobes is None:
            sky = self._sky(places, direction, active & ~hit.valid, rays_per_line)
            return H, emission * self._share_of_rays(places, hit, met, rays_per_line) + sky
        straight = met & ~hit.bounced
        lamp = emission * dr.select(straight, self._share_of_rays(places, hit, straight, rays_per_line), 0)
        lamp += self._sky(places, direction, active & ~hit.valid & ~hit.bounced, rays_per_line)
        seen = dr.select(met & hit.bounced & ~hit.coated, emission, 0)
        seen += model.lights.sky(hit.direction, active & ~hit.valid & hit.bounced)
        return dr.select(active, hit.glow + hit.weight * (H + seen * hit.share), 0), lamp

    def _sky(self, places, direction, escaped, rays_per_line):
        """H from the sky that rays meet which go straight there, as far as lines do not find it (Color3f [n])."""
        lights = self._model.lights
        if lights.sky_light is None:
            return mi.Color3f(0)
        share = lights.sky_light.share_of_rays(direction, dr.dot(places.normal, direction), rays_per_line)
        return lights.sky(direction, escaped) * share

    def _looked_up(self, hit, met):
        """ρ H where rays end; of leaves that walls cross, all of it on the side their light is on (Color3f [n])."""
        e = self._elements
        leaf = e.leaf_at(hit.patch, hit.u, hit.v, met)
        H = dr.gather(mi.Color3f, self._reflected, leaf, met)
        if self._landings.slots == 0:
            return H
        slot = dr.gather(mi.UInt32, self._exposure.slot, leaf, met)
        crossed = met & (slot != NONE)
        landed = self._landings.any_on(slot, crossed)
        x = e.patches.above(dr.select(met, hit.patch, 0), hit.u, hit.v)
        seen = self._landings.in_sight(e, self._model.rays, leaf, slot, x, landed)
        return H * dr.select(landed, dr.select(seen, dr.gather(mi.Float, self._bright, slot, landed), 0), 1)

    def _share_of_rays(self, places, hit, met, rays_per_line):
        """The balance heuristic's weight of rays that meet lamps, c F / (p + c F) (Float [n])."""
        if rays_per_line is None:
            return mi.Float(1)
        if self._lamps.count == 0:
            return mi.Float(0)
        patches = self._model.patches
        density = self._lamps.density(hit.patch, places.leaf, met)
        patch = dr.select(met, hit.patch, 0)
        d = patches.point(patch, hit.u, hit.v) - places.x
        r2 = dr.squared_norm(d)
        # F times π r⁴, so that nothing is divided by a small distance.
        n = dr.gather(mi.Vector3f, patches.normal, patch)
        F = rays_per_line * dr.maximum(dr.dot(places.normal, d), 0) * dr.maximum(-dr.dot(n, d), 0)
        found = met & (density > 0) & self._is_met_by_rays(patch)
        return dr.select(found, F / (density * (dr.pi * r2 * r2) + F), 0)

    def _is_met_by_rays(self, patch):
        """Do rays end on these lamps, and not go on through them (Bool [n])?"""
        materials = self._model.materials
        if not materials.traced.any():
            return mi.Bool(True)
        return ~materials.is_traced(dr.gather(mi.UInt32, self._model.patches.face, patch))
