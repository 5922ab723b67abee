"""Irradiance of patches too small for the rays to find."""

import drjit as dr
import mitsuba as mi

from ..scene.model import NONE
from ..core.points import ROUNDS, kronecker, triangle
from ..core.arrays import lower_bound, opaque_index, totals
from .series import WEIGHTS, pull

ENOUGH = 16  # rays a patch should expect
SAMPLES = 32  # lines to lamps, and as many rays into the room, per starved leaf;
MOST_SAMPLES = 1024  # more of them while that takes no more than
CHEAP = 0.02  # of the ray budget,
SHARE = 0.2  # and fewer so that it never takes more than this


class Starved:
    """Leaves of patches that would meet fewer than ENOUGH of ``rays`` rays spread over the scene.

    Shooting leaves such patches black or spotted: a door handle is hit by no ray of a million. They
    look for light instead: along lines to the lamps for H_direct, and along cosine-distributed rays
    into the room, where the solution is known, for the rest. ``rays`` is what that costs.
    """

    def __init__(self, elements, rays, seed):
        self.elements, self.seed = elements, opaque_index(seed)
        model = elements.model
        patch_area = dr.gather(mi.Float, model.area, elements.patch)
        small = patch_area < dr.opaque(mi.Float, ENOUGH * model.total_area / rays)
        self.leaves = dr.compress((elements.child == 0) & small)
        count = dr.width(self.leaves)
        self.samples = SAMPLES
        while count and self.samples < MOST_SAMPLES and 4 * self.samples * count <= CHEAP * rays:
            self.samples *= 2
        while count and self.samples > 1 and 2 * self.samples * count > SHARE * rays:
            self.samples //= 2
        if 2 * self.samples * count > SHARE * rays:
            self.leaves, count = mi.UInt32(), 0
        self.rays = 2 * self.samples * count

    def feed(self, flow):
        """Replace the irradiance of the starved leaves in ``flow`` (Flow)."""
        if self.rays == 0:
            return
        e, k = self.elements, dr.arange(mi.UInt32, self.rays // 2)
        each = opaque_index(self.samples)
        leaf, line = dr.gather(mi.UInt32, self.leaves, k // each), k % each
        keys = e.key(self.leaves)
        key = dr.gather(mi.UInt32, keys, k // each)
        x0, x1, s, t = kronecker(line, keys, self.seed, k // each)
        patch = dr.gather(mi.UInt32, e.patch, leaf)
        u, v = e.patch_point(leaf, *triangle(x0, x1))
        direct = self._from_lamps(patch, u, v, line, key, s, t)
        indirect = self._from_room(patch, u, v, s, t, flow)

        dr.scatter(e.across, mi.UInt32(0), self.leaves)
        leaves = e.leaf_indices()
        area = mi.Float64(dr.gather(mi.Float, e.open_area, leaves))
        whole = dr.gather(mi.Float, e.area, self.leaves) / dr.gather(mi.Float, e.open_area, self.leaves)
        for name, gathered in (("direct", direct), ("indirect", indirect)):
            field = mi.Color3f(getattr(flow, name))
            mean = mi.Color3f(*(dr.block_sum(c, self.samples) / mi.Float(each) for c in gathered)) * whole
            dr.scatter(field, mean, self.leaves)
            setattr(flow, name, pull(e, leaves, area, [mi.Float64(dr.gather(mi.Float, c, leaves)) for c in field]))

    def _from_lamps(self, patch, u, v, line, key, s, t):
        """E F / p along lines to points of the lamps, drawn by power (Color3f [lines])."""
        model = self.elements.model
        lamps = dr.compress(dr.max(model.emission) > 0)
        emission, area = dr.gather(mi.Color3f, model.emission, lamps), dr.gather(mi.Float, model.area, lamps)
        power = mi.Float64(dr.sum(emission) * area)
        whole = totals([power])[0]
        cumulative = dr.cumsum(mi.UInt64(dr.ceil(power * dr.opaque(mi.Float64, WEIGHTS / whole))))
        dr.eval(cumulative)
        # Stratified over the lamps' power.
        draw = (mi.Float64(line) + mi.sample_tea_float32(key ^ 0xA511E9B3, self.seed, ROUNDS)) / mi.Float64(
            opaque_index(self.samples)
        )
        j = lower_bound(cumulative, mi.UInt64(draw * dr.opaque(mi.Float64, WEIGHTS)) + 1)
        E = dr.gather(mi.Color3f, emission, j)
        F = model.kernel(patch, u, v, dr.gather(mi.UInt32, lamps, j), *triangle(s, t))
        return E * (F * dr.opaque(mi.Float, whole) / dr.sum(E))

    def _from_room(self, patch, u, v, s, t, flow):
        """Reflected radiosity ρ H that cosine-distributed rays meet (Color3f [rays])."""
        e, model = self.elements, self.elements.model
        hit = model.trace(*model.leave(patch, u, v, s, t))
        met = (hit.patch != NONE) & model.owns(patch, u, v)
        leaf = e.leaf_at(hit.patch, hit.u, hit.v, met)
        H = dr.gather(mi.Color3f, flow.direct + flow.indirect, leaf, met)
        return dr.gather(mi.Color3f, e.reflectance, leaf, met) * H
