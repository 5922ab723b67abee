"""The pair tree: which elements exchange power, and what the oracle said of them."""

import drjit as dr
import mitsuba as mi

from ..oracles import KernelSamples, Pair
from ..scene.model import NONE
from ..core.points import hash_pair, kronecker, triangle
from ..core.arrays import concat, lower_bound, lower_bound_within, opaque_index, unique
from .elements import MAX_LEVEL

UNKNOWN = -1.0  # σ of a pair nobody has evaluated
BATCH = 1 << 18  # pairs sampled in one launch: bounds memory


class Pairs:
    """Pairs (receiver i, source j) of elements, born of rays.

    Roots are pairs of patches that a ray connects, found by binary search in the row of i of sorted keys i·2³² + j.
    A pair whose larger element is split has four children. Arrays over pairs: ``receiver``,
    ``source``, ``child`` (first of four, 0 for none), ``halved`` (2 · the element that was split, + 1 if
    it is the receiver; UInt32), ``sigma`` (Float, UNKNOWN before the
    one evaluation a pair ever gets), ``partial`` (Bool: a line between the two was blocked, or below
    a horizon, so that light does not spread over all of the receiver).
    """

    def __init__(self, elements, oracle, lines, seed):
        self.elements, self.oracle, self.lines = elements, oracle, lines
        self.seed = dr.opaque(mi.UInt32, seed)
        self.root_keys = mi.UInt64(0xFFFFFFFFFFFFFFFF)  # a sentinel, so that the table is never empty
        self.roots = mi.UInt32(NONE)
        self._index_rows()
        # Pair 0 is never used, so that child == 0 means none.
        self.receiver, self.source, self.child, self.halved = (mi.UInt32(0) for _ in range(4))
        self.sigma, self.partial = mi.Float(0), mi.Bool(False)
        self.evaluated = 0

    def __len__(self):
        return dr.width(self.receiver)

    def _append(self, receiver, source):
        self.receiver = concat(self.receiver, receiver)
        self.source = concat(self.source, source)
        n = dr.width(receiver)
        self.child = concat(self.child, dr.zeros(mi.UInt32, n))
        self.halved = concat(self.halved, dr.zeros(mi.UInt32, n))
        self.sigma = concat(self.sigma, dr.full(mi.Float, UNKNOWN, n))
        self.partial = concat(self.partial, dr.zeros(mi.Bool, n))

    # ---- Finding pairs -------------------------------------------------------------------------

    def find_roots(self, i, j, active):
        """Numbers of the root pairs of patches (i, j), NONE where there is none yet (UInt32 [n])."""
        first, last = dr.gather(mi.UInt32, self._row, i, active), dr.gather(mi.UInt32, self._row, i + 1, active)
        at = lower_bound_within(self._sources, j, first, last, active)
        found = active & (at < last) & (dr.gather(mi.UInt32, self._sources, at, active) == j)
        return dr.select(found, dr.gather(mi.UInt32, self.roots, at, found), NONE)

    def add_roots(self, i, j):
        """Make root pairs of patches (i, j) that have none (UInt32 [n], repetitions allowed)."""
        if dr.width(i) == 0:
            return
        keys = unique((mi.UInt64(i) << 32) | mi.UInt64(j))
        fresh = opaque_index(len(self)) + dr.arange(mi.UInt32, dr.width(keys))
        self._append(mi.UInt32(keys >> 32), mi.UInt32(keys))
        keys, roots = concat(self.root_keys, keys), concat(self.roots, fresh)
        order = dr.argsort(keys)
        self.root_keys, self.roots = dr.gather(mi.UInt64, keys, order), dr.gather(mi.UInt32, roots, order)
        dr.eval(self.root_keys, self.roots)
        self._index_rows()

    def _index_rows(self):
        """Note where the keys of each receiving patch begin, which makes searches short."""
        self._sources = mi.UInt32(self.root_keys)
        self._row = lower_bound(self.root_keys, mi.UInt64(dr.arange(mi.UInt32, self.elements.model.count + 1)) << 32)
        dr.eval(self._sources, self._row)

    @dr.syntax
    def descend(self, pair, ui, vi, uj, vj, active=True):
        """Follow points (ui, vi) of receivers and (uj, vj) of sources down to pairs without children."""
        pair = mi.UInt32(pair)
        e = self.elements
        child = dr.gather(mi.UInt32, self.child, pair, active)
        while child != 0:
            split = dr.gather(mi.UInt32, self.halved, pair)
            of_receiver = (split & 1) == 1
            pair = child + e.locate(split >> 1, dr.select(of_receiver, ui, uj), dr.select(of_receiver, vi, vj))
            child = dr.gather(mi.UInt32, self.child, pair)
        return pair

    # ---- Asking the oracle ---------------------------------------------------------------------

    def evaluate(self, pairs):
        """Ask the oracle for σ of ``pairs`` (UInt32 [n], none evaluated before)."""
        n = dr.width(pairs)
        for start in range(0, n, BATCH):
            batch = (
                dr.gather(mi.UInt32, pairs, opaque_index(start) + dr.arange(mi.UInt32, min(BATCH, n - start)))
                if n > BATCH
                else pairs
            )
            self._evaluate(batch)
        self.evaluated += n

    def _evaluate(self, pairs):
        e = self.elements
        samples = None
        if self.oracle.uses_lines:
            values = self.kernel_samples(pairs)
            dr.eval(values)
            samples = KernelSamples(values, self.lines)
            dr.scatter(self.partial, samples.min() <= 0, pairs)
        receiver, source = dr.gather(mi.UInt32, self.receiver, pairs), dr.gather(mi.UInt32, self.source, pairs)
        pair = Pair(
            mi.Float64(dr.gather(mi.Float, e.area, receiver)),
            mi.Float64(dr.gather(mi.Float, e.area, source)),
            e.model.total_area,
            dr.gather(mi.UInt32, e.place, receiver) & 15,
            dr.gather(mi.UInt32, e.place, source) & 15,
        )
        sigma = self.oracle.sigma(samples, pair)
        dr.scatter(self.sigma, dr.maximum(mi.Float(sigma), 0), pairs)
        dr.eval(self.sigma, self.partial)

    def kernel_samples(self, pairs):
        """F along S lines of each pair, stratified in all four dimensions (Float [pairs · lines])."""
        e, lines = self.elements, dr.opaque(mi.UInt32, self.lines)
        k = dr.arange(mi.UInt32, dr.width(pairs) * self.lines)
        of = k // lines
        i, j = dr.gather(mi.UInt32, self.receiver, pairs), dr.gather(mi.UInt32, self.source, pairs)
        key = hash_pair(e.key(i), e.key(j))
        x0, x1, y0, y1 = kronecker(k % lines, key, self.seed, of)
        pair = dr.gather(mi.UInt32, pairs, of)
        i, j = dr.gather(mi.UInt32, self.receiver, pair), dr.gather(mi.UInt32, self.source, pair)
        ui, vi = e.patch_point(i, *triangle(x0, x1))
        uj, vj = e.patch_point(j, *triangle(y0, y1))
        return e.model.kernel(dr.gather(mi.UInt32, e.patch, i), ui, vi, dr.gather(mi.UInt32, e.patch, j), uj, vj)

    # ---- Splitting -----------------------------------------------------------------------------

    def larger(self, pairs):
        """The element that splits when a pair is rejected: the larger of two (UInt32 [n], NONE if it cannot)."""
        e = self.elements
        i, j = dr.gather(mi.UInt32, self.receiver, pairs), dr.gather(mi.UInt32, self.source, pairs)
        finest = 2.0**-MAX_LEVEL
        free_i, free_j = (dr.abs(dr.gather(mi.Float, e.scale, k)) > finest for k in (i, j))
        larger_i = dr.gather(mi.Float, e.area, i) >= dr.gather(mi.Float, e.area, j)
        return dr.select(free_i & (larger_i | ~free_j), i, dr.select(free_j, j, NONE))

    def split(self, chosen, element):
        """Give the pairs ``chosen`` (UInt32 [n]) the four children of their ``element`` (UInt32 [n])."""
        count = dr.width(chosen)
        if count == 0:
            return
        first = opaque_index(len(self)) + 4 * dr.arange(mi.UInt32, count)
        dr.scatter(self.child, first, chosen)
        k = dr.arange(mi.UInt32, 4 * count)
        parent, split = dr.gather(mi.UInt32, chosen, k // 4), dr.gather(mi.UInt32, element, k // 4)
        half = dr.gather(mi.UInt32, self.elements.child, split) + k % 4
        receiver, source = dr.gather(mi.UInt32, self.receiver, parent), dr.gather(mi.UInt32, self.source, parent)
        of_receiver = receiver == split
        dr.scatter(
            self.halved,
            2 * element + dr.select(element == dr.gather(mi.UInt32, self.receiver, chosen), mi.UInt32(1), 0),
            chosen,
        )
        self._append(dr.select(of_receiver, half, receiver), dr.select(of_receiver, source, half))
        dr.eval(self.receiver, self.source, self.child, self.halved, self.sigma, self.partial)
