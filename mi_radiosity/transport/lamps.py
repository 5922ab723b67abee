"""Which lamp to look at: chosen by what each could give here."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, Distribution, concat, lower_bound_within, opaque_index, totals
from ..mesh import MAX_LEVEL, Elements

MOST = 1 << 24  # entries of the table of elements and lamps; with more lamps than that, they are chosen by power
BY_POWER = 0.1  # share of lines that are drawn by power whatever the place


class LampChoice:
    """Draws points on lamps (patches that emit), for places on the leaves of a mesh.

    A row per leaf, or per element above them if there are too many lamps for all, holds what every lamp would give its
    middle were nothing between: a line is worth the more, the more light it may bring. ``count``: how many lamp
    patches there are.
    """

    @staticmethod
    def of(elements: Elements) -> "LampChoice":
        """That of a mesh, made once for all who gather on it."""
        kept = vars(elements)
        if "lamp_choice" not in kept:
            kept["lamp_choice"] = LampChoice(elements)
        return kept["lamp_choice"]

    def __init__(self, elements: Elements) -> None:
        self._patches = elements.patches
        self.lamps = dr.compress(dr.max(self._patches.emission) > 0)
        self.count = dr.width(self.lamps)
        self._rows = None
        if self.count == 0:
            return
        emission = dr.gather(mi.Color3f, self._patches.emission, self.lamps)
        power = mi.Float64(dr.sum(emission) * dr.gather(mi.Float, self._patches.area, self.lamps))
        whole = totals([power])[0]
        self._by_power = Distribution(power, whole)
        self._number = dr.full(mi.UInt32, NONE, self._patches.count)
        dr.scatter(self._number, dr.arange(mi.UInt32, self.count), self.lamps)
        level = self._finest_level(elements)
        if 1 < self.count and level is not None:
            self._build_rows(elements, mi.Float(power / dr.opaque(mi.Float64, whole)), opaque_index(level))

    def _finest_level(self, e):
        """The finest level that the table may have rows for, or for leaves above it; None if it may for none."""
        every, leaf = (np.bincount(np.array(e.level(x)), minlength=MAX_LEVEL + 1) for x in (_all(e), e.leaves))
        rows = every + np.cumsum(leaf) - leaf  # elements of each level, and leaves above
        fits = np.flatnonzero(self.count * rows <= MOST)
        return int(fits[-1]) if len(fits) else None

    def _build_rows(self, e, share, level):
        """Cumulative shares of all lamps, element by element (Float [elements · lamps])."""
        p, at = self._patches, _all(e)
        on_level, is_leaf = e.level(at) == level, dr.gather(mi.UInt32, e.child, at) == 0
        places = dr.gather(mi.UInt32, at, dr.compress(on_level | (is_leaf & (e.level(at) < level))))
        k = dr.arange(mi.UInt32, self.count * dr.width(places))
        row, lamp = k // opaque_index(self.count), k % opaque_index(self.count)
        place, j = dr.gather(mi.UInt32, places, row), dr.gather(mi.UInt32, self.lamps, lamp)
        i, third = dr.gather(mi.UInt32, e.patch, place), mi.Float(1 / 3)
        d = p.point(j, third, third) - p.point(i, *e.patch_point(place, third, third))
        spread = dr.gather(mi.Float, e.area, place) + dr.gather(mi.Float, p.area, j)
        r2 = dr.squared_norm(d)
        # Cosines of the middle, and what the sizes of both may add to them.
        slack = dr.sqrt(dr.minimum(spread / dr.maximum(r2, 1e-30), 1))
        length = dr.sqrt(dr.maximum(r2, 1e-30))
        here = dr.maximum(dr.dot(dr.gather(mi.Vector3f, p.normal, i), d) / length + slack, 0)
        there = dr.maximum(-dr.dot(dr.gather(mi.Vector3f, p.normal, j), d) / length + slack, 0)
        share = dr.gather(mi.Float, share, lamp)
        guess = share * here * there / (r2 + spread)
        total = dr.repeat(dr.block_sum(guess, self.count), self.count)
        chance = dr.select(total > 0, (1 - BY_POWER) * guess / total, (1 - BY_POWER) * share) + BY_POWER * share
        rows = dr.block_prefix_reduce(dr.ReduceOp.Add, chance, self.count, exclusive=False)
        # One more row, for points that lie on no element: by power alone.
        self._rows, self._row_of_others = (
            concat(rows, mi.Float(self._by_power.shares())),
            opaque_index(dr.width(places)),
        )
        self._row = dr.full(mi.UInt32, NONE, len(e))
        dr.scatter(self._row, dr.arange(mi.UInt32, dr.width(places)), places)
        above = _above(e, level)
        below = dr.compress(above != e.leaves)
        dr.eval(self._row)
        rows = dr.gather(mi.UInt32, self._row, dr.gather(mi.UInt32, above, below))
        dr.scatter(self._row, rows, dr.gather(mi.UInt32, e.leaves, below))
        dr.eval(self._rows, self._row)

    def draw(self, lot: "mi.Float", leaf: "mi.UInt32 | None" = None) -> "tuple[mi.UInt32, mi.Float]":
        """A lamp drawn with ``lot`` in [0, 1) for places on leaves: its patch, and the density of points on it, 1/m²
        (UInt32, Float [n]). Without leaves, and where they are NONE, by power."""
        if leaf is None or self._rows is None:
            number = self._by_power.at(mi.Float64(lot) * dr.opaque(mi.Float64, self._by_power.whole))
        else:
            first = self._first(leaf)
            last = first + opaque_index(self.count - 1)
            top = dr.gather(mi.Float, self._rows, last)
            number = lower_bound_within(self._rows, lot * top, first, last) - first
        return dr.gather(mi.UInt32, self.lamps, number), self._density(number, leaf)

    def density(
        self, patch: "mi.UInt32", leaf: "mi.UInt32 | None" = None, active: "mi.Bool | bool" = True
    ) -> "mi.Float":
        """Density of the points that `draw` puts on patches, 1/m²; 0 for those that are no lamps (Float [n])."""
        number = dr.gather(mi.UInt32, self._number, patch, active)
        is_lamp = active & (number != NONE)
        return dr.select(is_lamp, self._density(dr.select(is_lamp, number, 0), leaf), 0)

    def _first(self, leaf):
        """Where the rows of leaves begin; the last row serves NONE, and elements that have no row (UInt32 [n])."""
        row = dr.select(leaf != NONE, dr.gather(mi.UInt32, self._row, leaf, leaf != NONE), NONE)
        return dr.select(row == NONE, self._row_of_others, row) * opaque_index(self.count)

    def _density(self, number, leaf):
        if leaf is None or self._rows is None:
            probability = mi.Float(self._by_power.probability(number))
        else:
            first = self._first(leaf)
            at = first + number
            before = dr.gather(mi.Float, self._rows, at - 1, number > 0)
            top = dr.gather(mi.Float, self._rows, first + opaque_index(self.count - 1))
            probability = (dr.gather(mi.Float, self._rows, at) - dr.select(number > 0, before, 0)) / top
        return probability / dr.gather(mi.Float, self._patches.area, dr.gather(mi.UInt32, self.lamps, number))


def _all(elements):
    """All elements of patches (UInt32 [n])."""
    every = dr.arange(mi.UInt32, len(elements))
    if elements.crown is None:
        return every
    return dr.compress(~elements.crown.holds(every))


@dr.syntax
def _above(elements, level):
    """The elements of a level above leaves, or the leaves themselves (UInt32 [leaves])."""
    element = mi.UInt32(elements.leaves)
    while elements.level(element) > level:
        element = dr.gather(mi.UInt32, elements.parent, element)
    return element
