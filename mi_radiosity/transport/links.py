"""Gathered rays kept as what they are: entries of a random matrix of form factors, solved as often as asked."""

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, opaque_index
from ..mesh import Exposure
from .gather import Gatherer
from .paths import PathEnd

LANES = 8  # sums per row, side by side


class Links:
    """Rays of rows (leaves, or clusters), row after row, and the leaf that each ends on.

    With n_i rays of row i that end on leaves l(k), Ĝ_i = 1/n_i Σ_k w_k (ρ H)_l(k) is an unbiased estimate of
    Σ_j F_ij ρ_j H_j. Iterating it follows the light from leaf to leaf without another ray, and what rays found once is
    found again by all that look there.

    start: where the rays of rows begin (UInt32 [rows + 1]); exposure: which leaves walls cross, whose light is on one
    side of these, perhaps; weighs: some rays have weights other than 1 for other reasons.
    """

    def __init__(self, start: "mi.UInt32", count: int, exposure: Exposure, weighs: bool) -> None:
        self.start, self._leaf = start, dr.full(mi.UInt32, NONE, count)
        self._exposure = exposure
        self._at_walls: list[list] = []  # numbers and ends of rays, launch by launch
        self._weight = dr.zeros(mi.Color3f, count) if weighs or exposure.slots else None

    def keep(self, number: "mi.UInt32", end: PathEnd, active: "mi.Bool") -> None:
        """Keep rays of a number each (UInt32 [n])."""
        dr.scatter(self._leaf, end.leaf, number, active)
        if self._weight is not None:
            dr.scatter(self._weight, end.weight, number, active)
        if self._exposure.slots:
            active = active & (end.leaf != NONE)
            crossed = active & (dr.gather(mi.UInt32, self._exposure.slot, end.leaf, active) != NONE)
            chosen = dr.compress(crossed)
            if dr.width(chosen):
                self._at_walls.append(
                    [dr.gather(type(x), x, chosen) for x in (number, end.leaf, end.patch, end.u, end.v)]
                )
                dr.eval(self._at_walls[-1])

    def look(self, gatherer: Gatherer) -> None:
        """Weigh links to leaves that walls cross, now that it is known where their light came down."""
        for number, leaf, patch, u, v in self._at_walls:
            share = gatherer.share_in_sight(leaf, patch, u, v, dr.full(mi.Bool, True, dr.width(number)))
            weight = dr.gather(mi.Color3f, self._weight, number)
            dr.scatter(self._weight, weight * share, number)
        self._at_walls = []

    def sums(self, reflected: "mi.Color3f") -> "list[mi.Float64]":
        """Σ_k w_k (ρ H)_l(k) of every row, from ρ H of the elements (Color3f [elements] ─► 3 Float64 [rows])."""
        rows, lanes = dr.width(self.start) - 1, opaque_index(LANES)
        lane = dr.arange(mi.UInt32, LANES * rows)
        first, end = (dr.gather(mi.UInt32, self.start, lane // lanes + k) for k in (0, 1))

        def add(k, total):
            leaf = dr.gather(mi.UInt32, self._leaf, k)
            color = dr.gather(mi.Color3f, reflected, leaf, leaf != NONE)
            if self._weight is not None:
                color *= dr.gather(mi.Color3f, self._weight, k)
            return k + lanes, total + color

        state = first + lane % lanes, dr.zeros(mi.Color3f, LANES * rows)
        total = dr.while_loop(state, lambda k, total: k < end, add)[1]
        dr.eval(total)  # block_sum would run the loop once for each channel
        return [mi.Float64(dr.block_sum(c, LANES)) for c in total]
