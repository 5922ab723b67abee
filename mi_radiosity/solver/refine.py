"""Refinement: from patches to a mesh, worst pairs first."""

import math

import drjit as dr
import mitsuba as mi

from ..core.errors import RadiosityError
from ..scene.model import NONE
from ..core.arrays import concat
from ..transport.series import RayRecord, distribute

GROWTH = 0.1  # of the leaves may split in one wave,
LEAST_SPLITS = 64  # or so many
STEP = 1 / 4  # by which the level comes down, above which pairs split
RENEW = 4  # pilot rays are cast anew when the mesh has grown by this factor
PILOT_RAYS = 24  # per leaf, at least
LEAST_PILOT = 1 << 16
MOST_PILOT = 1 << 20
PILOT_TAIL = 0.1


class Refinement:
    """Splits elements and pairs until none is left to split.

    Every wave follows the pilot rays down the pair tree, has the oracle look at the pairs they
    stopped at, and splits the worst. Pilot rays discover pairs and estimate the radiosity the
    oracle weighs them with; none of them carries power into the solution.

    elements: leaves wanted, or None; epsilon: ε, or None; just one of them is given. A mesh the
    oracle finds too little to refine in is an error if ``exact``.
    Afterwards ``epsilon`` is the ε reached, ``rays`` the pilot rays cast, ``first_share`` what
    `distribute` wants to know.
    """

    def __init__(self, pairs, elements, epsilon, seed, progress=lambda done: None, exact=True):
        self.pairs, self.elements, self.oracle = pairs, pairs.elements, pairs.oracle
        self.wanted, self.floor, self.exact = elements, epsilon, exact
        self.seed, self.progress = seed, progress
        self.epsilon, self.level = epsilon or 0.0, math.inf
        self.rays, self.pilots, self.first_share = 0, 0, 0.5

    def run(self):
        """Refine until the mesh has the wanted size, or no pair is worse than ε."""
        self._pilot()
        while True:
            fresh = self._ask()
            pairs, value, element = self._candidates()
            room = min(self._room(), self._until_pilot()) if dr.width(pairs) else 0
            split = self._split_elements(value, element, room) if room else 0
            if dr.width(pairs):
                split += self._split_pairs(pairs, value, element)
            self.progress(self.elements.leaves)
            if not fresh and not split:
                break
            if not self._until_pilot() and self._room():
                self._pilot()
        if self.wanted is not None and self._room() and self.exact:
            raise RadiosityError(
                f"the oracle '{self.oracle}' finds nothing left to refine at {self.elements.leaves} elements: "
                f"ask for fewer than {self.wanted} --elements, or give --epsilon instead"
            )

    def _room(self):
        """How many more elements may split."""
        return 1 << 30 if self.wanted is None else (self.wanted - self.elements.leaves) // 3

    def _until_pilot(self):
        """How many more elements may split before pilot rays are cast anew, at the same size of every mesh."""
        return (RENEW * self.piloted - self.elements.leaves) // 3

    # ---- Rays ----------------------------------------------------------------------------------

    def _pilot(self):
        """Cast new pilot rays; they replace the old ones, and so does the radiosity they carry."""
        self.piloted = self.elements.leaves
        rays = min(max(PILOT_RAYS * self.elements.leaves, LEAST_PILOT), MOST_PILOT)
        record = []
        # Each pilot draws from a stream of its own, and none from the final one's.
        self.pilots += 1
        flow = distribute(
            self.pairs,
            rays,
            (self.seed + 0x9E3779B9 * self.pilots) & 0xFFFFFFFF,
            first_share=self.first_share,
            tail=PILOT_TAIL,
            record=record,
        )
        self.rays += flow.rays
        self.first_share = flow.first_share
        self.hits = _concat_hits(record)
        emission = dr.gather(mi.Color3f, self.elements.model.emission, self.elements.patch)
        self.radiosity = emission + self.elements.reflectance * (flow.direct + flow.indirect)
        dr.eval(self.radiosity)
        hits = self.hits
        if dr.width(hits.i) == 0:
            return
        unknown = dr.compress(hits.pair == NONE)
        self.pairs.add_roots(dr.gather(mi.UInt32, hits.i, unknown), dr.gather(mi.UInt32, hits.j, unknown))
        roots = self.pairs.find_roots(hits.i, hits.j, hits.pair == NONE)
        hits.pair = dr.select(hits.pair == NONE, roots, hits.pair)
        dr.eval(hits.pair)

    def _ask(self):
        """Evaluate the pairs the rays stand at; returns how many were new."""
        hits = self.hits
        if dr.width(hits.i) == 0:
            return 0
        hits.pair = self.pairs.descend(hits.pair, hits.ui, hits.vi, hits.uj, hits.vj)
        dr.eval(hits.pair)
        visited = dr.zeros(mi.Bool, len(self.pairs))
        dr.scatter(visited, True, hits.pair)
        fresh = dr.compress(visited & (self.pairs.sigma < 0))
        if dr.width(fresh):
            self.pairs.evaluate(fresh)
        return dr.width(fresh)

    # ---- Splitting -----------------------------------------------------------------------------

    def _candidates(self):
        """Pairs that could be split: their numbers, the value ρ_i σ_ij B_j, and which element would split."""
        p = self.pairs
        open_pairs = dr.compress((p.child == 0) & (p.sigma > 0))
        if dr.width(open_pairs) == 0:
            return open_pairs, mi.Float(), mi.UInt32()
        value = dr.gather(mi.Float, p.sigma, open_pairs)
        if self.oracle.name != "uniform":
            reflectance = dr.gather(mi.Color3f, self.elements.reflectance, dr.gather(mi.UInt32, p.receiver, open_pairs))
            value *= dr.max(
                reflectance * dr.gather(mi.Color3f, self.radiosity, dr.gather(mi.UInt32, p.source, open_pairs))
            )
        element = p.larger(open_pairs)
        value = dr.select(element == NONE, 0, value)
        dr.eval(value, element)
        return open_pairs, value, element

    def _split_elements(self, value, element, room):
        """Split the leaves of the worst pairs, ``room`` at most; sets ε; returns how many."""
        e = self.elements
        worst = dr.zeros(mi.UInt32, len(e))
        # Floats ≥ 0 sort like their bits, and a maximum does not depend on the order.
        dr.scatter_reduce(
            dr.ReduceOp.Max,
            worst,
            dr.reinterpret_array(mi.UInt32, value),
            element,
            element != NONE,
            mode=dr.ReduceMode.Local,
        )
        worst = dr.reinterpret_array(mi.Float, worst)
        # The level only comes down, and only when all above it are split: one freak pair must not
        # decide how far the others get.
        peak = dr.max(value)[0]
        if peak < self.level:
            self.level = max(self.floor or 0.0, STEP * peak)
        leaves = dr.compress((e.child == 0) & (worst > 0) & (worst >= dr.opaque(mi.Float, self.level)))
        count = min(dr.width(leaves), max(LEAST_SPLITS, round(GROWTH * e.leaves)), room)
        self.epsilon = self.level
        if count == 0:
            return 0
        worst = dr.gather(mi.Float, worst, leaves)
        order = dr.argsort(worst, descending=True)
        chosen = dr.gather(mi.UInt32, order, dr.arange(mi.UInt32, count))
        if count < dr.width(leaves):
            self.epsilon = dr.gather(mi.Float, worst, chosen)[count - 1]
        before = len(e)
        e.split(dr.gather(mi.UInt32, leaves, chosen))
        self._inherit(before)
        return count

    def _inherit(self, before):
        """New elements start with the radiosity of their parents."""
        k = dr.gather(
            mi.UInt32,
            self.elements.parent,
            dr.arange(mi.UInt32, len(self.elements) - before) + dr.opaque(mi.UInt32, before),
        )
        self.radiosity = concat(self.radiosity, dr.gather(mi.Color3f, self.radiosity, k))
        dr.eval(self.radiosity)

    def _split_pairs(self, pairs, value, element):
        """Split the rejected pairs whose element is split by now; returns how many."""
        is_split = dr.gather(mi.UInt32, self.elements.child, element, element != NONE) != 0
        rejected = dr.compress(is_split & (value > 0) & (value >= dr.opaque(mi.Float, self.epsilon)))
        self.pairs.split(dr.gather(mi.UInt32, pairs, rejected), dr.gather(mi.UInt32, element, rejected))
        return dr.width(rejected)


def _concat_hits(record):
    """One RayRecord of all rays that met a patch."""
    kept = [dr.compress(r.i != NONE) for r in record]

    def join(kind, name):
        return concat(*(dr.gather(kind, getattr(r, name), k) for r, k in zip(record, kept)))

    return RayRecord(
        join(mi.UInt32, "i"),
        join(mi.Float, "ui"),
        join(mi.Float, "vi"),
        join(mi.UInt32, "j"),
        join(mi.Float, "uj"),
        join(mi.Float, "vj"),
        join(mi.UInt32, "pair"),
    )
