"""Patches too small for the rays to find gather their light instead."""

import dataclasses

import drjit as dr
import mitsuba as mi

from ..core.arrays import opaque_index
from ..core.points import Stream, kronecker, stream_seed, triangle, uniform
from ..mesh.hierarchy import pull
from .gather import Gatherer
from .problem import Flow, Problem

ENOUGH = 16  # rays a patch should expect
SAMPLES = 32  # lines to lamps, and as many rays into the room, per starved leaf;
MOST_SAMPLES = 1024  # more of them while that takes no more than
CHEAP = 0.02  # of the ray budget,
SHARE = 0.2  # and fewer so that it never takes more than this


class Starved:
    """Leaves of patches that would meet fewer than ENOUGH of ``budget`` rays spread over the scene.

    Shooting leaves such patches black or spotted: a door handle is hit by no ray of a million. They
    look for light instead: along lines to the lamps for H_direct, and along cosine-distributed rays
    into the room, where the solution is known, for the rest. ``rays`` is what that costs.
    """

    def __init__(self, problem: Problem, budget: int, seed: int) -> None:
        self._problem, self._seed = problem, opaque_index(stream_seed(seed, Stream.STARVED))
        elements, patches = problem.elements, problem.model.patches
        patch_area = dr.gather(mi.Float, patches.area, elements.patch)
        small = patch_area < dr.opaque(mi.Float, ENOUGH * patches.total_area / budget)
        self.leaves = dr.compress((elements.child == 0) & small)
        self.samples = self._affordable(dr.width(self.leaves), budget)
        if self.samples == 0:
            self.leaves = mi.UInt32()
        self.rays = 2 * self.samples * dr.width(self.leaves)

    @staticmethod
    def _affordable(count: int, budget: int) -> int:
        """Samples per leaf, 0 if even one is too dear."""
        if count == 0:
            return 0
        samples = SAMPLES
        while samples < MOST_SAMPLES and 4 * samples * count <= CHEAP * budget:
            samples *= 2
        while samples > 1 and 2 * samples * count > SHARE * budget:
            samples //= 2
        return samples if 2 * samples * count <= SHARE * budget else 0

    def feed(self, flow: Flow) -> Flow:
        """``flow`` with the irradiance of the starved leaves replaced by what they gather."""
        if self.rays == 0:
            return flow
        e, exposure = self._problem.elements, self._problem.exposure
        whole = dr.gather(mi.Float, e.area, self.leaves) / dr.gather(mi.Float, exposure.open_area, self.leaves)
        each, fields = opaque_index(self.samples), {}
        for name, gathered in self._gather(flow).items():
            field = mi.Color3f(getattr(flow, name))
            mean = mi.Color3f(*(dr.block_sum(c, self.samples) / mi.Float(each) for c in gathered)) * whole
            dr.scatter(field, mean, self.leaves)
            values = [mi.Float64(dr.gather(mi.Float, c, e.leaves)) for c in field]
            fields[name] = pull(e, values, exposure.open_area)
        return dataclasses.replace(flow, rays=flow.rays + self.rays, **fields)

    def _gather(self, flow):
        """Samples of direct and indirect irradiance, those of one leaf side by side (Color3f [leaves · samples])."""
        e, model = self._problem.elements, self._problem.model
        k, each = dr.arange(mi.UInt32, self.rays // 2), opaque_index(self.samples)
        keys, line = e.key(self.leaves), k % each
        x0, x1, s, t = kronecker(line, keys, self._seed, k // each)
        leaf = dr.gather(mi.UInt32, self.leaves, k // each)
        patch = dr.gather(mi.UInt32, e.patch, leaf)
        u, v = e.patch_point(leaf, *triangle(x0, x1))
        x, normal = model.patches.point(patch, u, v), dr.gather(mi.Vector3f, model.patches.normal, patch)
        on_top = model.rays.on_top(patch, u, v)
        # Stratified over the lamps' power.
        lot = (mi.Float(line) + dr.gather(mi.Float, uniform(keys ^ 0xA511E9B3, self._seed), k // each)) / mi.Float(each)
        gatherer = Gatherer(model, e, e.reflectance * (flow.direct + flow.indirect))
        return {
            "direct": gatherer.direct(x, normal, lot, s, t, on_top),
            "indirect": gatherer.indirect(*model.rays.leave(patch, u, v, s, t), k, self._seed, on_top),
        }
