"""Small array tools: searching, drawing, and sums that come out the same on any number of threads."""

import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

NONE = 0xFFFFFFFF  # "no patch", "no element", "no pair"
DTYPES = {"Float": np.float32, "Float64": np.float64}
WEIGHTS = 2.0**46  # resolution of a Distribution


def owned(kind: type, array: ArrayLike) -> "dr.ArrayBase":
    """A Dr.Jit array (mi.Float, mi.Float64 or mi.UInt32) with a copy of a NumPy array of one dimension.

    Without the copy Dr.Jit reads NumPy's memory, and has its alignment in the kernels.
    """
    kept = np.array(array, dtype=DTYPES.get(kind.__name__, np.uint32), order="C")  # the copy is made later
    copy = dr.empty(kind, len(kept))
    if len(kept):
        dr.scatter(copy, kind(kept), dr.arange(mi.UInt32, len(kept)))
        dr.eval(copy)
    return copy


def owned_vectors(kind: type, array: ArrayLike) -> "dr.ArrayBase":
    """A Dr.Jit array of three-vectors (mi.Point3f, mi.Vector3f, mi.Color3f) from NumPy [n, 3]."""
    return kind(*(owned(mi.Float, column) for column in np.asarray(array).T))


def opaque_index(value: int) -> "mi.UInt32":
    """A UInt32 the compiler cannot see, so that another value does not mean another kernel."""
    return dr.opaque(mi.UInt32, value)


def concat(*arrays: "dr.ArrayBase") -> "dr.ArrayBase":
    """The arrays (of one type, Color3f too) end to end."""
    # dr.concat has the offsets in its kernels, and so compiles anew for every length.
    widths = [dr.width(a) for a in arrays]
    result, start = dr.empty(type(arrays[0]), sum(widths)), 0
    for array, width in zip(arrays, widths):
        if width:
            dr.scatter(result, array, opaque_index(start) + dr.arange(mi.UInt32, width))
        start += width
    return result


def unique(keys: "mi.UInt64") -> "mi.UInt64":
    """Sorted keys without repetitions (UInt64)."""
    if dr.width(keys) == 0:
        return keys
    keys = dr.sort(keys)
    k = dr.arange(mi.UInt32, dr.width(keys))
    keys = dr.gather(
        mi.UInt64, keys, dr.compress((k == 0) | (keys != dr.gather(mi.UInt64, keys, dr.maximum(k, 1) - 1)))
    )
    dr.eval(keys)
    return keys


def lower_bound(values: "dr.ArrayBase", key: "dr.ArrayBase", active: "mi.Bool | bool" = True) -> "mi.UInt32":
    """First position k of sorted ``values`` with values[k] >= key, at most the last one (UInt32 [n])."""
    low = dr.zeros(mi.UInt32, dr.width(key))
    if dr.width(key) == 0:
        return low
    return lower_bound_within(values, key, low, low + opaque_index(dr.width(values) - 1), active)


@dr.syntax
def lower_bound_within(
    values: "dr.ArrayBase",
    key: "dr.ArrayBase",
    low: "mi.UInt32",
    high: "mi.UInt32",
    active: "mi.Bool | bool" = True,
) -> "mi.UInt32":
    """`lower_bound` for entries whose position is known to be in [low, high] (UInt32 [n])."""
    # dr.binary_search unrolls, and so compiles anew whenever the table has doubled.
    low, high = mi.UInt32(low), mi.UInt32(high)
    while low < high:
        middle = (low + high) >> 1
        below = dr.gather(type(values), values, middle, active) < key
        low = dr.select(below, middle + 1, low)
        high = dr.select(below, high, middle)
    return low


class ColorSums:
    """Sums of colours in bins, in 64-bit fixed point: exact, so their order does not matter.

    No sum may exceed ``bound`` (three floats, one per channel).
    """

    def __init__(self, bins: int, bound: Sequence[float]):
        self.bins = bins
        # Powers of two: a bound that differs in the last bit gives the same fixed point.
        self.unit = [power_of_two(b) * 2.0**-60 for b in bound]
        self._to_fixed = [dr.opaque(mi.Float64, 1 / u) for u in self.unit]
        self._to_float = [dr.opaque(mi.Float64, u) for u in self.unit]
        self._sums = [dr.zeros(mi.Int64, bins) for _ in range(3)]

    def add(
        self,
        color: "Sequence[dr.ArrayBase]",
        index: "mi.UInt32",
        active: "mi.Bool | bool" = True,
        runs: bool = False,
    ) -> None:
        """Add ``color`` (three Float or Float64 [n]) to bins ``index`` (UInt32 [n]); where these come in
        ``runs`` of the same bin, neighbours are added up before they meet memory."""
        # Dr.Jit's own choice, Expand, has the number of bins in the kernel.
        mode = dr.ReduceMode.Local if runs else dr.ReduceMode.Direct
        for sums, scale, value in zip(self._sums, self._to_fixed, color):
            dr.scatter_add(sums, mi.Int64(mi.Float64(value) * scale), index, active, mode=mode)

    def gather(self, index: "mi.UInt32") -> "list[mi.Float64]":
        """The sums of bins ``index`` as three Float64 [n]."""
        return [mi.Float64(dr.gather(mi.Int64, sums, index)) * scale for sums, scale in zip(self._sums, self._to_float)]

    def totals(self) -> list[float]:
        """Sums over all bins, three Python floats."""
        return [t * u for t, u in zip(totals(self._sums), self.unit)]


def replaced(tree: Any, rows: "mi.UInt32", others: Any) -> Any:
    """A dataclass of arrays [n] whose entries ``rows`` (UInt32 [m], no two the same) are those of ``others`` [m]."""
    names = [f.name for f in fields(tree)]
    row = dr.full(mi.UInt32, NONE, max(dr.width(getattr(tree, name)) for name in names))
    dr.scatter(row, dr.arange(mi.UInt32, dr.width(rows)), rows)
    dr.eval(row, others)
    there = row != NONE
    gathered = (dr.gather(type(x), x, row, there) for x in (getattr(others, name) for name in names))
    return select(there, type(tree)(*gathered), tree)


def select(active: "mi.Bool", one: Any, other: Any) -> Any:
    """`dr.select` for dataclasses of arrays, column by column."""
    return type(one)(*(dr.select(active, getattr(one, f.name), getattr(other, f.name)) for f in fields(one)))


def totals(arrays: "Sequence[dr.ArrayBase]") -> list[float]:
    """Sums of several arrays, as Python floats, read in one go."""
    sums = [dr.sum(a) for a in arrays]
    dr.eval(sums)
    return [s[0] for s in sums]


def apportion(total: int, weights: Sequence[float], least: int = 0) -> list[int]:
    """Whole numbers that add up to ``total``, in proportion to weights beyond ``least`` each."""
    least = min(least, total // len(weights))
    ends = np.round(np.cumsum(weights) / np.sum(weights) * (total - least * len(weights))).astype(np.int64)
    return (np.diff(ends, prepend=0) + least).tolist()


def power_of_two(value: float) -> float:
    """The smallest power of two > ``value`` (1 for 0): scales by it round nothing."""
    return 2.0 ** (math.frexp(value)[1] if value > 0 else 0)


class Distribution:
    """Draws numbers 0…n−1 in proportion to weights (Float64 [n], ≥ 0, some > 0).

    In integers, so that it is the same on any number of threads. ``whole`` is their sum (Python int).
    """

    def __init__(self, weights: "mi.Float64", total: float) -> None:
        scale = dr.opaque(mi.Float64, WEIGHTS / power_of_two(total))
        self.weight = mi.UInt64(dr.ceil(weights * scale))
        self.cumulative = dr.cumsum(self.weight)
        dr.eval(self.cumulative, self.weight)
        self.whole = dr.gather(mi.UInt64, self.cumulative, dr.width(self.cumulative) - 1)[0]

    def at(self, position: "mi.Float64") -> "mi.UInt32":
        """The number whose weight covers a position in [0, whole) (Float64 [m] ─► UInt32 [m])."""
        return lower_bound(self.cumulative, mi.UInt64(position) + 1)

    def start(self, number: "mi.UInt32") -> "mi.Float64":
        """Where the weight of a number begins (Float64 [m])."""
        end, weight = dr.gather(mi.UInt64, self.cumulative, number), dr.gather(mi.UInt64, self.weight, number)
        return mi.Float64(end - weight)

    def shares(self) -> "mi.Float64":
        """Cumulative probabilities Σ_(k ≤ i) p(k) (Float64 [n])."""
        return mi.Float64(self.cumulative) / dr.opaque(mi.Float64, self.whole)

    def probability(self, number: "mi.UInt32") -> "mi.Float64":
        """p(number) (Float64 [m])."""
        return mi.Float64(dr.gather(mi.UInt64, self.weight, number)) / dr.opaque(mi.Float64, self.whole)


def row_keys(columns: np.ndarray) -> np.ndarray:
    """One integer for each row of integers [n, m], the same for rows that are the same (int64 [n])."""
    mixed = np.zeros(len(columns), dtype=np.uint64)
    for column in columns.T:
        mixed = (mixed ^ column.astype(np.int64).astype(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return (mixed >> np.uint64(1)).astype(np.int64)


def runs(lengths: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The run that every entry of runs of these lengths is in, and its place there (two int [sum])."""
    run = np.repeat(np.arange(len(lengths)), lengths)
    return run, np.arange(len(run)) - np.repeat(np.cumsum(lengths) - lengths, lengths)


def components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Labels of ``count`` things, the same for those that links a[k], b[k] connect (int [count])."""
    a, b, label = owned(mi.UInt32, a), owned(mi.UInt32, b), dr.arange(mi.UInt32, count)
    while dr.width(a):
        ends = dr.gather(mi.UInt32, label, a), dr.gather(mi.UInt32, label, b)
        apart = ends[0] != ends[1]
        a, b = (dr.gather(mi.UInt32, x, dr.compress(apart)) for x in (a, b))
        # Roots are joined to the least that they are linked to; others, to their roots.
        dr.scatter_reduce(dr.ReduceOp.Min, label, dr.minimum(*ends), dr.maximum(*ends), apart)
        label = _roots(label)
        dr.eval(a, b, label)
    return np.array(label).astype(np.int64)


@dr.syntax
def _roots(label: "mi.UInt32") -> "mi.UInt32":
    """Where chains of labels end (UInt32 [n])."""
    root = mi.UInt32(label)
    above = dr.gather(mi.UInt32, label, root)
    while above != root:
        root = mi.UInt32(above)
        above = dr.gather(mi.UInt32, label, root)
    return root
