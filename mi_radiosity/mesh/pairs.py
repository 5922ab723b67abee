"""The pair tree: which elements exchange power, and what the oracle said of them."""

import dataclasses

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, concat, lower_bound, lower_bound_within, opaque_index, unique
from ..core.points import Stream, hash_pair, kronecker, stream_seed
from ..oracles import KernelSamples, Oracle, Pair
from ..scene.rays import Rays
from .elements import MAX_LEVEL, Elements

BATCH = 1 << 18  # pairs sampled in one launch: bounds memory
ARRAYS = ("receiver", "source", "child", "halved", "asked", "occluded")


class Pairs:
    """Pairs (receiver i, source j) of elements, born of rays.

    Roots are pairs of patches that a ray connects, found by binary search in the row of i of sorted keys i·2³² + j.
    A pair whose larger element is split has four children. Arrays over pairs: ``receiver``, ``source``, ``child``
    (first of four, 0 for none), ``halved`` (2 · the element that was split, + 1 if it is the receiver; UInt32),
    ``asked`` (Bool: the oracle has evaluated it, which happens once), ``occluded`` (Bool: a line between the two was
    blocked, or below a horizon, so that light does not spread over all of the receiver) and ``sigma``, what the
    oracle said (a list of Float, one for each of its numbers).

    ``evaluated`` counts the pairs the oracle has seen.
    """

    def __init__(self, elements: Elements, rays: Rays, oracle: Oracle, lines: int, seed: int) -> None:
        self.elements, self.rays, self.oracle, self.lines = elements, rays, oracle, lines
        self._seed = opaque_index(stream_seed(seed, Stream.PAIRS))
        self._root_keys = mi.UInt64(0xFFFFFFFFFFFFFFFF)  # a sentinel, so that the table is never empty
        self._roots = mi.UInt32(NONE)
        self._index_rows()
        # Pair 0 is never used, so that child == 0 means none.
        self.receiver, self.source, self.child, self.halved = (mi.UInt32(0) for _ in range(4))
        self.asked, self.occluded = mi.Bool(True), mi.Bool(False)
        self.sigma: list = []
        self.evaluated = 0

    def __len__(self) -> int:
        return dr.width(self.receiver)

    def freeze(self, elements: Elements) -> "Pairs":
        """The pairs as they are now, between frozen elements."""
        frozen = object.__new__(Pairs)
        frozen.__dict__.update(self.__dict__)
        frozen.elements = elements
        for name in ARRAYS:
            value = getattr(self, name)
            setattr(frozen, name, type(value)(value))
        frozen.sigma = [type(s)(s) for s in self.sigma]
        return frozen

    def _append(self, receiver, source):
        n = dr.width(receiver)
        self.receiver, self.source = concat(self.receiver, receiver), concat(self.source, source)
        self.child = concat(self.child, dr.zeros(mi.UInt32, n))
        self.halved = concat(self.halved, dr.zeros(mi.UInt32, n))
        self.asked = concat(self.asked, dr.zeros(mi.Bool, n))
        self.occluded = concat(self.occluded, dr.zeros(mi.Bool, n))
        self.sigma = [concat(s, dr.zeros(mi.Float, n)) for s in self.sigma]
        self._eval()

    def _eval(self):
        dr.eval(*(getattr(self, name) for name in ARRAYS), self.sigma)

    # ---- Finding pairs -------------------------------------------------------------------------

    def find_roots(self, i: "mi.UInt32", j: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.UInt32":
        """Numbers of the root pairs of patches (i, j), NONE where there is none yet (UInt32 [n])."""
        i, j = self.elements.root(i, active), self.elements.root(j, active)
        first, last = dr.gather(mi.UInt32, self._row, i, active), dr.gather(mi.UInt32, self._row, i + 1, active)
        at = lower_bound_within(self._sources, j, first, last, active)
        found = active & (at < last) & (dr.gather(mi.UInt32, self._sources, at, active) == j)
        return dr.select(found, dr.gather(mi.UInt32, self._roots, at, found), NONE)

    def add_roots(self, i: "mi.UInt32", j: "mi.UInt32") -> None:
        """Make root pairs of patches (i, j) that have none (UInt32 [n], repetitions allowed)."""
        if dr.width(i) == 0:
            return
        i, j = self.elements.root(i), self.elements.root(j)
        keys = unique((mi.UInt64(i) << 32) | mi.UInt64(j))
        fresh = opaque_index(len(self)) + dr.arange(mi.UInt32, dr.width(keys))
        self._append(*(self.elements.root_element(mi.UInt32(k)) for k in (keys >> 32, keys)))
        keys, roots = concat(self._root_keys, keys), concat(self._roots, fresh)
        order = dr.argsort(keys)
        self._root_keys, self._roots = dr.gather(mi.UInt64, keys, order), dr.gather(mi.UInt32, roots, order)
        dr.eval(self._root_keys, self._roots)
        self._index_rows()

    def _index_rows(self):
        """Note where the keys of each receiving root begin, which makes searches short."""
        self._sources = mi.UInt32(self._root_keys)
        rows = dr.arange(mi.UInt32, self.elements.roots + 1)
        self._row = lower_bound(self._root_keys, mi.UInt64(rows) << 32)
        dr.eval(self._sources, self._row)

    @dr.syntax
    def descend(
        self,
        pair: "mi.UInt32",
        i: "mi.UInt32",
        ui: "mi.Float",
        vi: "mi.Float",
        j: "mi.UInt32",
        uj: "mi.Float",
        vj: "mi.Float",
        active: "mi.Bool | bool" = True,
    ) -> "mi.UInt32":
        """Follow points (ui, vi) of receiving patches i and (uj, vj) of sources j down to pairs without children."""
        pair = mi.UInt32(pair)
        child = dr.gather(mi.UInt32, self.child, pair, active)
        while child != 0:
            split = dr.gather(mi.UInt32, self.halved, pair)
            of_receiver = (split & 1) == 1
            patch = dr.select(of_receiver, i, j)
            u, v = dr.select(of_receiver, ui, uj), dr.select(of_receiver, vi, vj)
            pair = child + self.elements.part_at(split >> 1, patch, u, v)
            child = dr.gather(mi.UInt32, self.child, pair)
        return pair

    # ---- Asking the oracle ---------------------------------------------------------------------

    def evaluate(self, pairs: "mi.UInt32") -> None:
        """Ask the oracle for σ of ``pairs`` (UInt32 [n], none evaluated before)."""
        n = dr.width(pairs)
        for start in range(0, n, BATCH):
            index = opaque_index(start) + dr.arange(mi.UInt32, min(BATCH, n - start))
            self._evaluate(dr.gather(mi.UInt32, pairs, index) if n > BATCH else pairs)
        self.evaluated += n

    def _evaluate(self, pairs):
        samples = None
        if self.oracle.uses_lines:
            values = self.kernel_samples(pairs)
            dr.eval(values)
            samples = KernelSamples(values, self.lines)
            dr.scatter(self.occluded, samples.min() <= 0, pairs)
        sigma = self.oracle.sigma(samples, self.describe(pairs))
        numbers = sigma if isinstance(sigma, tuple) else (sigma,)
        if not self.sigma:
            self.sigma = [dr.zeros(mi.Float, len(self)) for _ in numbers]
        for kept, number in zip(self.sigma, numbers):
            dr.scatter(kept, mi.Float(number), pairs)
        dr.scatter(self.asked, True, pairs)
        dr.eval(self.sigma, self.occluded, self.asked)

    def kernel_samples(self, pairs: "mi.UInt32") -> "mi.Float":
        """F along S lines of each pair, stratified in all four dimensions (Float [pairs · lines])."""
        e, lines = self.elements, dr.opaque(mi.UInt32, self.lines)
        k = dr.arange(mi.UInt32, dr.width(pairs) * self.lines)
        of = k // lines
        i, j = dr.gather(mi.UInt32, self.receiver, pairs), dr.gather(mi.UInt32, self.source, pairs)
        x0, x1, y0, y1 = kronecker(k % lines, hash_pair(e.key(i), e.key(j)), self._seed, of)
        i, j = dr.gather(mi.UInt32, i, of), dr.gather(mi.UInt32, j, of)
        return self.rays.kernel(*e.points(i, x0, x1), *e.points(j, y0, y1))

    def describe(self, pairs: "mi.UInt32", radiosity: "mi.Color3f | None" = None) -> Pair:
        """Pairs as the oracle sees them; with ``radiosity`` B (Color3f [elements]) as its rule of acceptance does."""
        e = self.elements
        i, j = dr.gather(mi.UInt32, self.receiver, pairs), dr.gather(mi.UInt32, self.source, pairs)
        area_i, area_j = (mi.Float64(dr.gather(mi.Float, e.area, k)) for k in (i, j))
        pair = Pair(area_i, area_j, e.patches.total_area, e.level(i), e.level(j))
        if radiosity is None:
            return pair
        return dataclasses.replace(pair, rho=e.albedo(i), B=dr.gather(mi.Color3f, radiosity, j))

    def value(self, pairs: "mi.UInt32", radiosity: "mi.Color3f") -> "mi.Float":
        """What the oracle compares with ε, for pairs it has evaluated (Float [n], ≥ 0)."""
        sigma = [dr.gather(mi.Float, s, pairs) for s in self.sigma]
        value = self.oracle.value(sigma[0] if len(sigma) == 1 else tuple(sigma), self.describe(pairs, radiosity))
        return dr.maximum(mi.Float(value), 0)

    # ---- Splitting -----------------------------------------------------------------------------

    def larger(self, pairs: "mi.UInt32") -> "mi.UInt32":
        """The element that splits when a pair is rejected: the larger of two (UInt32 [n], NONE if it cannot)."""
        e = self.elements
        i, j = dr.gather(mi.UInt32, self.receiver, pairs), dr.gather(mi.UInt32, self.source, pairs)
        free_i, free_j = (e.level(k) < MAX_LEVEL for k in (i, j))
        larger_i = dr.gather(mi.Float, e.area, i) >= dr.gather(mi.Float, e.area, j)
        return dr.select(free_i & (larger_i | ~free_j), i, dr.select(free_j, j, NONE))

    def split(self, chosen: "mi.UInt32", element: "mi.UInt32") -> None:
        """Give the pairs ``chosen`` (UInt32 [n]) the children of their ``element`` (UInt32 [n])."""
        count = dr.width(chosen)
        if count == 0:
            return
        of_receiver = element == dr.gather(mi.UInt32, self.receiver, chosen)
        parts = self.elements.parts(element)
        end = dr.cumsum(parts)
        start = end - parts
        dr.scatter(self.child, opaque_index(len(self)) + start, chosen)
        dr.scatter(self.halved, 2 * element + dr.select(of_receiver, mi.UInt32(1), 0), chosen)
        above = self.elements.crown is not None
        k = dr.arange(mi.UInt32, end[count - 1] if above else 4 * count)
        row = lower_bound(end, k + 1) if above else k // 4
        parent, split = dr.gather(mi.UInt32, chosen, row), dr.gather(mi.UInt32, element, row)
        half = self.elements.part(split, k - dr.gather(mi.UInt32, start, row))
        receiver, source = dr.gather(mi.UInt32, self.receiver, parent), dr.gather(mi.UInt32, self.source, parent)
        of_receiver = receiver == split
        self._append(dr.select(of_receiver, half, receiver), dr.select(of_receiver, source, half))
