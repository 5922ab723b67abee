"""Light gathered where it is asked for: lines to the lamps, and rays into the solved room."""

import copy
from dataclasses import dataclass
from functools import partial

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, opaque_index
from ..core.points import Stream, kronecker, stream_seed, triangle, uniform
from ..mesh import Elements, Exposure
from ..scene import Model
from .lamps import LampChoice
from .landings import Landings
from .paths import PathEnd, Paths

LOOKS = 32  # points of a crossed leaf
AFAR = 4.0  # sizes of an element, from which it is looked at as a whole


@dataclass
class Found:
    """What rays into the room have found, [n]: H of area emitters and of the sky, seen directly; H of light that came
    past other surfaces, and of delta direct light where paths end; and that end, whose ρ H times ``end.weight`` is the
    light that it adds, as far as it is in sight there."""

    lamps: "mi.Color3f"
    sky: "mi.Color3f"
    glow: "mi.Color3f"
    end: PathEnd


@dataclass
class Places:
    """Points that look for light, [n]; relative to the patches' origin. ``leaf``: elements they lie on, if known."""

    x: "mi.Point3f"
    normal: "mi.Vector3f"
    leaf: "mi.UInt32 | None" = None


class Gatherer:
    """Irradiance at points of a scene whose radiosity is known.

    reflected: ρ H of the elements (Color3f [elements], W/m²); exposure, landings: on which side of a wall that crosses
    a leaf that light is. looks: sharp light of lamps that are no surfaces is not in it, so rays look for it from where
    they end: no oracle refines its shadows, and sun that comes in through a window is not to spread over whole
    leaves. Where ``sharp``, the part of it that elements receive (Color3f [elements], W/m²), is known, only those look
    that are nearer to where they end than a random share of its element's size, AFAR times that: from afar nobody sees
    how light is spread over an element. Each sample is one line to the lamps, or one cosine-distributed ray, and its
    value an unbiased estimate. Where both are drawn, lamps are found by both; the balance heuristic (Veach 1997) weighs
    them, so that no estimate exceeds their exitance however near they are.
    """

    def __init__(
        self,
        model: Model,
        elements: Elements,
        exposure: Exposure,
        landings: Landings,
        reflected: "mi.Color3f",
        looks: bool = False,
        sharp: "mi.Color3f | None" = None,
    ) -> None:
        self._model, self._elements, self._reflected = model, elements, reflected
        self._exposure, self._looks = exposure, looks
        self._sharp = None if sharp is None else elements.reflectance * sharp
        if sharp is not None:
            self._reach = _reach(elements)
            dr.eval(self._sharp, self._reach)
        self._place(landings)
        self._lamps = LampChoice.of(elements)
        self._free = model.lights.free
        self.paths = self.paths_with(None)

    def paths_with(self, caustic: "mi.Color3f | None") -> Paths:
        """Paths that end on elements; those that do not read the cache at a vertex add ``caustic`` there (Color3f
        [elements])."""
        model, elements = self._model, self._elements
        return Paths(model, elements, partial(_of_elements, elements), partial(_is_sun, model, self._looks), caustic)

    def seeing(self, reflected: "mi.Color3f", landings: Landings) -> "Gatherer":
        """The same for other values of ρ H, and where that light is."""
        dr.eval(reflected)
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
        count = dr.block_sum(dr.select(seen, mi.Float(1), 0), LOOKS)
        self._bright = dr.zeros(mi.Float, landings.slots)
        # Of n points k in sight: the mean of (n + 1) / (k + 1) is one over the share, that of n / k is more.
        more = self._exposure.open_share(e, leaves) * (LOOKS + 1) / (count + 1)
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
        found = self.lines_to_surfaces(places, lot, s, t, rays_per_line, active)
        return tuple(a + b for a, b in zip(found, self.lines_to_free(places, s, t, rays_per_line, active)[:2]))

    def lines_to_surfaces(
        self,
        places: Places,
        lot: "mi.Float",
        s: "mi.Float",
        t: "mi.Float",
        rays_per_line: float = 0.0,
        active: "mi.Bool | bool" = True,
    ) -> "tuple[mi.Color3f, mi.Color3f]":
        """What `lines` find of lamps that are surfaces: one line looks at one of them."""
        if self._lamps.count == 0:
            return mi.Color3f(0), mi.Color3f(0)
        lamp, density = self._lamps.draw(lot, places.leaf)
        u, v = triangle(s, t)
        F = self._model.rays.kernel_at(places.x, places.normal, lamp, u, v, active)
        lit = self._model.lights.at(self._model.patches, lamp, u, v, F > 0) * F
        return lit / (density + rays_per_line * F), lit / density

    def lines_to_free(
        self, places: Places, s: "mi.Float", t: "mi.Float", rays_per_line: float = 0.0, active: "mi.Bool | bool" = True
    ) -> "tuple[mi.Color3f, mi.Color3f, mi.Color3f]":
        """What `lines` find of lamps that are no surfaces, each of which a line looks at; and what of the first is
        sharp light (three Color3f [n])."""
        total = [mi.Color3f(0)] * 3
        for light in self._free:
            shared, alone, sharp = light.lights_up(
                self._model.rays, places.x, places.normal, s, t, active, rays_per_line
            )
            total = [a + b for a, b in zip(total, (shared, alone, dr.select(sharp, shared, 0)))]
        return tuple(total)

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
        found = self.follow(places, direction, number, seed, rays_per_line, active)
        return found.glow + self.reflected_by(found.end), found.lamps + found.sky

    @property
    def glows(self) -> bool:
        """May rays find light that is neither of lamps nor of leaves?"""
        return self._model.rays.lobes is not None or self._looks

    def reflected_by(self, end: PathEnd) -> "mi.Color3f":
        """ρ H of the leaves that paths end on, times their weights (Color3f [n])."""
        on_leaf = end.leaf != NONE
        weight = end.weight * self.share_in_sight(end.leaf, end.patch, end.u, end.v, on_leaf)
        return dr.select(on_leaf, weight * dr.gather(mi.Color3f, self._reflected, end.leaf, on_leaf), 0)

    def follow(
        self,
        places: Places,
        direction: "mi.Vector3f",
        number: "mi.UInt32",
        seed: "mi.UInt32",
        rays_per_line: float | None = None,
        active: "mi.Bool | bool" = True,
    ) -> Found:
        """What `rays` find, the light of leaves as links to them."""
        model, patches = self._model, self._model.patches
        ray = mi.Ray3f(places.x + patches.origin + places.normal * patches.lift, direction)
        met = model.rays.meet(ray.o, ray.d, active)
        hit = model.rays.locate(met, ray.d)
        lit = active & (hit.patch != NONE)
        share = self._share_of_rays(places, hit, lit, rays_per_line)
        lamps = model.lights.at(patches, hit.patch, hit.u, hit.v, lit) * share
        sky = self._sky(places, direction, active & ~hit.valid, rays_per_line)
        end = self.paths.follow(met, hit, ray, number, seed, active, reads=True, scattered=True)
        glow = end.light + end.weight * self.by_sharp_light(places.x, end, number, seed)
        return Found(lamps, sky, dr.select(active, glow, 0), end)

    def is_sharp_sky(self, direction: "mi.Vector3f") -> "mi.Bool":
        """Is light of the sky sharp there, and left out of the leaves' (Bool [n])?"""
        return _is_sun(self._model, self._looks, direction)

    def by_sharp_light(self, start: "mi.Point3f", end: PathEnd, number: "mi.UInt32", seed: "mi.UInt32") -> "mi.Color3f":
        """ρ H of delta direct light where paths that come from ``start`` end on leaves (Color3f [n])."""
        H, met, patches, leaf = mi.Color3f(0), end.leaf != NONE, self._model.patches, end.leaf
        if not self._looks:
            return H
        patch = dr.select(met, end.patch, 0)
        x, normal = patches.point(patch, end.u, end.v), dr.gather(mi.Vector3f, patches.normal, patch)
        s, t = (uniform(number, seed ^ salt) for salt in (0x51AB1E, 0x0DDB411))
        looks, known = met, mi.Color3f(0)
        if self._sharp is not None:
            reach = dr.gather(mi.Float, self._reach, leaf, met) * uniform(number, seed ^ 0xAFA4)
            crossed = dr.gather(mi.UInt32, self._exposure.slot, leaf, met) != NONE
            looks = met & (crossed | (dr.squared_norm(x - start) < dr.square(reach)))
            known = dr.gather(mi.Color3f, self._sharp, leaf, met & ~looks)
        for light in self._free:
            if light.may_be_sharp:
                H += light.lights_up(self._model.rays, x, normal, s, t, looks, only_sharp=True)[1]
        return dr.select(looks, H * dr.gather(mi.Color3f, self._elements.reflectance, leaf, looks), known)

    def _sky(self, places, direction, escaped, rays_per_line):
        """H from the sky that rays meet which go straight there, as far as lines do not find it (Color3f [n])."""
        lights = self._model.lights
        if lights.sky_light is None:
            return mi.Color3f(0)
        share = lights.sky_light.share_of_rays(direction, dr.dot(places.normal, direction), rays_per_line)
        return lights.sky(direction, escaped) * share

    def share_in_sight(
        self, leaf: "mi.UInt32", patch: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool"
    ) -> "mi.Float":
        """What points of leaves show of the leaf's light: of those that walls cross, all of it is on the side it came
        down on (Float [n])."""
        if self._landings.slots == 0:
            return mi.Float(1)
        e = self._elements
        slot = dr.gather(mi.UInt32, self._exposure.slot, leaf, active)
        crossed = active & (slot != NONE)
        landed = self._landings.any_on(slot, crossed)
        x = e.patches.above(dr.select(active, patch, 0), u, v)
        seen = self._landings.in_sight(e, self._model.rays, leaf, slot, x, landed)
        return dr.select(landed, dr.select(seen, dr.gather(mi.Float, self._bright, slot, landed), 0), 1)

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
        found = met & (density > 0)
        return dr.select(found, F / (density * (dr.pi * r2 * r2) + F), 0)


def _of_elements(elements, leaf, patch, u, v, active):
    """ρ of leaves (Color3f [n])."""
    return dr.gather(mi.Color3f, elements.reflectance, leaf, active)


def _is_sun(model, looks, direction):
    """Is light of the sky from directions sharp, and left out of the cache, if anything of that is (Bool [n])?"""
    sky = model.lights.sky_light
    if not looks or sky is None or not sky.may_be_sharp:
        return mi.Bool(False)
    return sky.is_sharp(direction)


def _reach(elements):
    """How far from elements rays may look at their spread of light (Float [elements], m); leaves that share light are
    as large as their cluster."""
    area = mi.Float(elements.area)
    if elements.crown:
        patch = dr.arange(mi.UInt32, elements.patches.count)
        dr.scatter(area, dr.gather(mi.Float, elements.area, elements.top(patch)), patch)
    return AFAR * dr.sqrt(area)
