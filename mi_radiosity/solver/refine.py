"""Refinement: from patches to a mesh, worst pairs first."""

import math
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, concat, opaque_index
from ..core.points import Stream, stream_seed
from ..mesh import MAX_LEVEL, Clusters, Exposure, Pairs, Tree
from ..scene import Model
from ..transport import Problem, Transport
from ..transport.problem import Record

GROWTH = 0.2  # of the leaves may split in one wave,
LEAST_SPLITS = 64  # or so many
STEP = 1 / 4  # by which the level comes down, above which pairs split
RENEW = 4  # pilot rays are cast anew when the mesh has grown by this factor
PILOT_RAYS = 24  # per leaf, at least
LEAST_PILOT = 1 << 16
MOST_PILOT = 1 << 20
MAX_ADDED = 1 << 20  # elements that an ε may add to the patches: bounds memory, of which an element takes some 4 kB


class Refinement:
    """Splits elements and pairs until none is left to split.

    Every wave follows the pilot rays down the pair tree, has the oracle look at the pairs they
    stopped at, and splits the worst. Pilot rays discover pairs and estimate the radiosity the
    oracle weighs them with; none of them carries power into the solution.

    tree, pairs: what grows. pilot: the Transport that casts pilot rays. elements: leaves wanted, or None; epsilon: ε,
    or None; just one of them is given. Afterwards ``epsilon`` is the ε reached, ``rays`` the pilot rays cast,
    ``first_share`` the lamps' part of the power, and ``shortfall`` the reason why the mesh has fewer elements than
    wanted, or why pairs worse than ε are left; None if neither is so.
    """

    def __init__(
        self,
        model: Model,
        tree: Tree,
        pairs: Pairs,
        pilot: Transport,
        elements: int | None,
        epsilon: float | None,
        seed: int,
        progress: Callable[[int], None] = lambda done: None,
    ) -> None:
        self._model, self._tree, self._pairs, self._pilot = model, tree, pairs, pilot
        self._least = epsilon or 0.0
        self._most = tree.leaf_count + MAX_ADDED if elements is None else elements
        self.shortfall: str | None = None
        self._seed, self._progress = seed, progress
        self.epsilon, self._level = epsilon or 0.0, math.inf
        self.rays, self._pilots, self.first_share = 0, 0, 0.5

    def run(self) -> None:
        """Refine until the mesh has the wanted size, or no pair is worse than ε."""
        self._cast_pilot()
        while True:
            fresh, split = self._ask(), self._split()
            self._progress(self._tree.leaf_count)
            if not fresh and not split:
                break
            if not self._until_pilot() and self._room():
                self._cast_pilot()
        self.shortfall = self._find_shortfall()

    def _find_shortfall(self):
        """See ``shortfall``."""
        pairs, value, element = self._candidates()
        worse = mi.UInt32()
        if dr.width(pairs):
            worse = dr.compress((value > 0) & (value >= dr.opaque(mi.Float, self._least)))
        too_deep = dr.width(worse) and dr.any(dr.gather(mi.UInt32, element, worse) == NONE)
        if self._room() and self._least and not too_deep:
            return None  # all pairs are better than ε
        if self._room() and too_deep:
            return f"elements are split {MAX_LEVEL} times at most"
        if self._room() and dr.width(worse):
            return "the clusters that are left to split have more parts than the mesh has room for"
        if self._room():
            return f"the oracle '{self._pairs.oracle}' finds nothing left to refine"
        if self._least and dr.width(worse):
            return f"an epsilon adds {MAX_ADDED:,} elements at most"
        return None

    def _room(self):
        """How many more elements may split."""
        return max((self._most - self._tree.leaf_count) // 3, 0)

    def _until_pilot(self):
        """How many more elements may split before pilot rays are cast anew, at the same size of every mesh."""
        return (RENEW * self._piloted - self._tree.leaf_count) // 3

    # ---- Rays ----------------------------------------------------------------------------------

    def _cast_pilot(self):
        """Cast new pilot rays; they replace the old ones, and so does the radiosity they carry."""
        self._piloted = self._tree.leaf_count
        rays = min(max(PILOT_RAYS * self._tree.leaf_count, LEAST_PILOT), MOST_PILOT)
        elements = self._tree.freeze()
        clusters = Clusters.of_leaves(elements) if elements.crown else None
        exposure = Exposure.unseen(elements)
        problem = Problem(self._model, elements, self._pairs.freeze(elements), exposure, clusters=clusters)
        # Each pilot draws from a stream of its own, and none from the final one's.
        flow = self._pilot(problem, rays, stream_seed(self._seed, Stream.PILOT, self._pilots), self.first_share)
        self._pilots += 1
        self.rays += flow.rays
        self.first_share = flow.first_share
        every = dr.arange(mi.UInt32, len(elements))
        scattered = problem.scattering.of_elements(flow.direct + flow.indirect)
        self._radiosity = elements.averaged_over_clusters(elements.emission(every) + scattered)
        dr.eval(self._radiosity)
        self._hits = _with_roots(_joined(flow.records), self._pairs)

    def _ask(self):
        """Evaluate the pairs the rays stand at; returns how many were new."""
        hits, pairs = self._hits, self._pairs
        if dr.width(hits.i) == 0:
            return 0
        pair = pairs.descend(hits.pair, hits.i, hits.ui, hits.vi, hits.j, hits.uj, hits.vj)
        dr.eval(pair)
        self._hits = replace(hits, pair=pair)
        visited = dr.zeros(mi.Bool, len(pairs))
        dr.scatter(visited, True, pair)
        fresh = dr.compress(visited & ~pairs.asked)
        if dr.width(fresh):
            pairs.evaluate(fresh)
        return dr.width(fresh)

    # ---- Splitting -----------------------------------------------------------------------------

    def _split(self):
        """Split the worst elements, and all rejected pairs whose element is split by now; returns how many."""
        pairs, value, element = self._candidates()
        if dr.width(pairs) == 0:
            return 0
        value = dr.select(element == NONE, 0, value)
        dr.eval(value)
        room = min(self._room(), self._until_pilot())
        split = self._split_elements(value, element, room) if room else 0
        return split + self._split_pairs(pairs, value, element)

    def _candidates(self):
        """Pairs without children: their numbers, the oracle's value, and which element would split (NONE: none can)."""
        pairs = self._pairs
        chosen = dr.compress((pairs.child == 0) & pairs.asked)
        if dr.width(chosen) == 0 or not pairs.sigma:
            return mi.UInt32(), mi.Float(), mi.UInt32()
        value = pairs.value(chosen, self._radiosity)
        element = pairs.larger(chosen)
        dr.eval(value, element)
        return chosen, value, element

    def _split_elements(self, value, element, room):
        """Split the leaves of the worst pairs, ``room`` at most; sets ε; returns how many."""
        tree, worst = self._tree, self._worst(value, element)
        # The level only comes down, and only when all above it are split: one freak pair must not
        # decide how far the others get.
        peak = dr.max(value)[0]
        if peak < self._level:
            self._level = max(self._least, STEP * peak)
        leaves = dr.compress((tree.child == 0) & (worst > 0) & (worst >= dr.opaque(mi.Float, self._level)))
        count = min(dr.width(leaves), max(LEAST_SPLITS, round(GROWTH * tree.leaf_count)), room)
        self.epsilon = self._level
        if count == 0:
            return 0
        worst = dr.gather(mi.Float, worst, leaves)
        chosen = dr.gather(mi.UInt32, dr.argsort(worst, descending=True), dr.arange(mi.UInt32, count))
        if tree.crown:  # whose parts are not four
            more = dr.cumsum(tree.parts(dr.gather(mi.UInt32, leaves, chosen)) - 1)
            chosen = dr.gather(mi.UInt32, chosen, dr.compress(more <= opaque_index(3 * room)))
            count = dr.width(chosen)
            if count == 0:
                return 0
        if count < dr.width(leaves):
            self.epsilon = dr.gather(mi.Float, worst, chosen)[count - 1]
        before = len(tree)
        tree.split(dr.gather(mi.UInt32, leaves, chosen))
        self._inherit(before)
        return count

    def _worst(self, value, element):
        """The largest value of each element's pairs (Float [elements])."""
        worst = dr.zeros(mi.UInt32, len(self._tree))
        # Floats ≥ 0 sort like their bits, and a maximum does not depend on the order.
        bits = dr.reinterpret_array(mi.UInt32, value)
        dr.scatter_reduce(dr.ReduceOp.Max, worst, bits, element, element != NONE, mode=dr.ReduceMode.Local)
        return dr.reinterpret_array(mi.Float, worst)

    def _inherit(self, before):
        """New elements start with the radiosity of their parents."""
        if len(self._tree) == before:
            return
        new = dr.arange(mi.UInt32, len(self._tree) - before) + dr.opaque(mi.UInt32, before)
        parent = dr.gather(mi.UInt32, self._tree.parent, new)
        self._radiosity = concat(self._radiosity, dr.gather(mi.Color3f, self._radiosity, parent))
        dr.eval(self._radiosity)

    def _split_pairs(self, pairs, value, element):
        """Split the rejected pairs whose element is split by now; returns how many."""
        is_split = dr.gather(mi.UInt32, self._tree.child, element, element != NONE) != 0
        rejected = dr.compress(is_split & (value > 0) & (value >= dr.opaque(mi.Float, self.epsilon)))
        self._pairs.split(dr.gather(mi.UInt32, pairs, rejected), dr.gather(mi.UInt32, element, rejected))
        return dr.width(rejected)


def _joined(records):
    """One Record of all rays that left a patch and met one."""
    if not records:  # no emitter has any power
        return Record(*(kind() for kind in (mi.UInt32, mi.Float, mi.Float) * 2), mi.UInt32())
    kept = [dr.compress((r.i != NONE) & (r.j != NONE)) for r in records]

    def join(name):
        arrays = [getattr(r, name) for r in records]
        return concat(*(dr.gather(type(a), a, k) for a, k in zip(arrays, kept)))

    return Record(*(join(name) for name in ("i", "ui", "vi", "j", "uj", "vj", "pair")))


def _with_roots(hits, pairs):
    """``hits`` with root pairs where they had none."""
    if dr.width(hits.i) == 0:
        return hits
    unknown = dr.compress(hits.pair == NONE)
    pairs.add_roots(dr.gather(mi.UInt32, hits.i, unknown), dr.gather(mi.UInt32, hits.j, unknown))
    pair = dr.select(hits.pair == NONE, pairs.find_roots(hits.i, hits.j, hits.pair == NONE), hits.pair)
    dr.eval(pair)
    return replace(hits, pair=pair)
