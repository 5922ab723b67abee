"""The last step: every leaf gathers the light that is shown, saved and exported."""

import dataclasses
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, ColorSums, lower_bound, opaque_index, owned, totals
from ..core.points import Stream, cosine_direction, kronecker, lamp_lot, stream_seed, triangle
from ..mesh.hierarchy import pull
from .emit import launches
from .gather import Gatherer, Places
from .landings import Landings
from .problem import Flow, Problem

SHARE = 0.8  # of the rays are gathered with; the others find the radiosity that is gathered
RAYS_PER_LINE = 2  # rays into the room per line to the lamps
LEAST = 16  # lines per leaf, or half of the mean


class Gathering:
    """Leaves look for light: along lines to the lamps, and along cosine-distributed rays into the room that power rays
    have lit.

    A gathered ray serves the leaf it is meant for, and where its power is seen; a ray that is shot lands where chance
    has it. Large leaves get more, by the fourth root of their area, which was found best. ``rays`` is what the pass
    costs; 0 where the budget has none to spare: then what was shot is shown.

    What is shot keeps all power to the letter: what is gathered is scaled to its total, as far as that is known better.
    """

    def __init__(self, problem: Problem, budget: int, seed: int) -> None:
        self._problem, self._seed = problem, stream_seed(seed, Stream.GATHER)
        leaves = problem.elements.leaves
        area = np.array(dr.gather(mi.Float, problem.exposure.open_area, leaves), dtype=np.float64)
        lines = _share_out(area**0.25, int(SHARE * budget / (1 + RAYS_PER_LINE)))
        self._lines, self._count = lines, int(lines.sum())
        self.rays = (1 + RAYS_PER_LINE) * self._count

    def feed(self, flow: Flow, progress: Callable[[int], None] = lambda done: None) -> Flow:
        """``flow`` with its irradiance replaced by what the leaves gather."""
        if self.rays == 0:
            return flow
        e, exposure = self._problem.elements, self._problem.exposure
        reflected = e.reflectance * (flow.direct + flow.indirect)
        self._gatherer = Gatherer(self._problem.model, e, exposure, flow.landings, reflected)
        self._landings = Landings(exposure.slots)
        bound = 3 * [self._bound(flow)]
        direct, indirect, alone = (ColorSums(dr.width(e.leaves), bound) for _ in range(3))
        done = 0
        for line in (True, False):
            each = 1 if line else RAYS_PER_LINE
            if not line:  # which meet the lamps' light as lines have found it
                reflected = e.reflectance * (pull(e, self._means(alone), exposure.open_area) + flow.indirect)
                self._gatherer = self._gatherer.seeing(reflected, self._landings.settled().filled_by(flow.landings))
            start = owned(mi.UInt32, np.concatenate([[0], np.cumsum(self._lines) * each]))
            for sample in launches(self._count * each):
                self._sample(sample, start, line, direct, alone if line else indirect)
                done += dr.width(sample)
                progress(done)
        fields = {}
        for name, sums in (("direct", direct), ("indirect", indirect)):
            fields[name] = pull(e, self._scaled(self._means(sums), flow, name), exposure.open_area)
        return dataclasses.replace(flow, rays=flow.rays + self.rays, landings=self._landings.settled(), **fields)

    def _means(self, sums):
        """Irradiance of the open part of the leaves from sums of their samples (3 Float64 [leaves])."""
        e, lines = self._problem.elements, mi.Float64(owned(mi.Float, self._lines))
        whole = mi.Float64(1 / self._problem.exposure.open_share(e, e.leaves))
        return [c / lines * whole for c in sums.gather(dr.arange(mi.UInt32, dr.width(e.leaves)))]

    def _scaled(self, gathered, flow, name):
        """Gathered irradiance (3 Float64 [leaves]) that is absorbed in all as what was shot is, as far as that can be
        trusted: in closed rooms, where no ray is lost, its total is exact."""
        e = self._problem.elements
        area = mi.Float64(dr.gather(mi.Float, self._problem.exposure.open_area, e.leaves))
        kept = [area * (1 - mi.Float64(r)) for r in dr.gather(mi.Color3f, e.reflectance, e.leaves)]
        shot = dr.gather(mi.Color3f, getattr(flow, name), e.leaves)
        have = totals([h * k for h, k in zip(gathered, kept)])
        want = totals([mi.Float64(h) * k for h, k in zip(shot, kept)])
        lost = min(sum(flow.escaped) / sum(flow.emitted), 1 - 1e-6)
        # Relative variances of both totals, as if samples were independent: those that are lost are the shot's noise.
        noise = lost / (1 - lost) / max(flow.rays * flow.first_share, 1)
        trust = 1 / (1 + noise * self._count)
        factors = [1 + trust * (w / t - 1) if t > 0 else 1.0 for w, t in zip(want, have)]
        return [h * dr.opaque(mi.Float64, f) for h, f in zip(gathered, factors)]

    def _bound(self, flow):
        """More than the samples of all leaves can add up to."""
        most = sum(
            dr.max(light, axis=None)[0] for light in (self._problem.model.patches.emission, flow.direct + flow.indirect)
        )
        return 1e3 * most * self._count

    def _sample(self, sample, start, line, direct, other):
        """Add up samples (UInt32 [n]): lines to lamps if ``line``, else rays into the room. ``other`` sums what lines
        find by themselves, and what rays find in the room."""
        problem = self._problem
        e, rays, patches = problem.elements, problem.model.rays, problem.model.patches
        row = lower_bound(start, sample + 1) - 1
        number = sample - dr.gather(mi.UInt32, start, row)
        leaf = dr.gather(mi.UInt32, e.leaves, row)
        seed = opaque_index(self._seed + (not line))
        keys = e.key(e.leaves)
        x0, x1, s, t = kronecker(number, keys, seed, row)
        patch = dr.gather(mi.UInt32, e.patch, leaf)
        u, v = e.patch_point(leaf, *triangle(x0, x1))
        on_top = rays.on_top(patch, u, v)
        places = Places(patches.point(patch, u, v), dr.gather(mi.Vector3f, patches.normal, patch), leaf)
        if line:
            lot = lamp_lot(number, keys, seed, row)
            lamps, found = self._gatherer.lines(places, lot, s, t, RAYS_PER_LINE, on_top)
        else:
            direction = cosine_direction(places.normal, s, t)
            found, lamps = self._gatherer.rays(places, direction, sample, seed, RAYS_PER_LINE, on_top)
            lamps, found = lamps / RAYS_PER_LINE, found / RAYS_PER_LINE
        other.add(found, row, on_top)
        direct.add(lamps, row, on_top)
        lit = on_top & (dr.max(lamps + found) > 0)
        slot = dr.gather(mi.UInt32, problem.exposure.slot, leaf)
        self._landings.offer(slot, u, v, sample ^ (0 if line else 0x80000000), lit & (slot != NONE))


def _share_out(weight, total):
    """Whole numbers, none much smaller than the others, in proportion to weights, which add up to ``total`` at most
    (int [n]); all 0 if there are too few."""
    n = len(weight)
    if total < n:
        return np.zeros(n, dtype=np.int64)
    least = max(1, min(LEAST, total // (2 * n)))
    low, high = 0.0, total / max(weight.min(), 1e-300)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if np.maximum(least, np.floor(middle * weight)).sum() <= total else (low, middle)
    return np.maximum(least, np.floor(low * weight)).astype(np.int64)
