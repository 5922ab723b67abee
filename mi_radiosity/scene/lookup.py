"""Whose a point is where faces lie in one another: tables on the device."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned, owned_vectors, runs
from ..core.points import coordinates

EDGE = 1e-5  # how far outside of a face, in barycentric coordinates, a point still counts as on it
FINEST = 64  # cells along the edge of a side, at most
PAD = 1e-4  # by which boxes are larger than what they hold, lest rounding decide between cells


class Lookup:
    """What lies on what, row by row: ``over``[k] on ``under``[k], sorted by ``under``, the uppermost first.

    Each side that something lies on has a grid over its barycentric coordinates, the finer the more there is; a
    cell names what reaches into it, so that a point on the floor of a hall asks few of a thousand feet of chairs.

    corners: of all faces, relative to the origin of points [faces, 3, 3]; under, over: 2 · face + (1 for the back).
    """

    def __init__(self, corners: np.ndarray, under: np.ndarray, over: np.ndarray) -> None:
        self.under, self.over = under, over
        edges = [corners[:, k] - corners[:, 0] for k in (1, 2)]
        self._triangles = [owned_vectors(mi.Point3f, corners[:, 0]), *(owned_vectors(mi.Vector3f, e) for e in edges)]
        sides, row, count = np.unique(under, return_inverse=True, return_counts=True)
        low, high = _boxes(corners[under // 2], corners[over // 2])
        extent = np.bincount(row, weights=(high - low).max(axis=1)) / count
        finest = np.clip(np.minimum(np.sqrt(count), 1 / extent), 1, FINEST).astype(np.int64)
        first = np.cumsum(finest**2) - finest**2
        cell, pair = _in_cells(low, high, finest[row])
        cell += first[row[pair]]
        self._over = owned(mi.UInt32, over[pair[np.argsort(cell, kind="stable")]])
        ends = np.cumsum(np.bincount(cell, minlength=first[-1] + finest[-1] ** 2))
        self._starts = owned(mi.UInt32, np.concatenate([[0], ends]))
        self._first, self._finest = (_table(sides, x, 2 * len(corners)) for x in (first, finest))

    def arrays(self) -> list[Any]:
        """All that `owner` reads."""
        return [*self._triangles, self._over, self._starts, self._first, self._finest]

    @dr.syntax
    def owner(
        self, face: "mi.UInt32", back: "mi.Bool", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool"
    ) -> "tuple[mi.UInt32, mi.Bool, mi.Float, mi.Float]":
        """The face, side and coordinates that points (u, v) of sides belong to (UInt32, Bool, Float, Float)."""
        side = 2 * face + dr.select(back, mi.UInt32(1), mi.UInt32(0))
        finest = dr.gather(mi.UInt32, self._finest, side, active)
        under = active & (finest > 0)
        p0, e1, e2 = (dr.gather(type(t), t, face, under) for t in self._triangles)
        x = p0 + e1 * u + e2 * v
        across, down = (dr.minimum(mi.UInt32(dr.maximum(c, 0) * mi.Float(finest)), finest - 1) for c in (u, v))
        cell = dr.gather(mi.UInt32, self._first, side, under) + down * finest + across
        at, end = (dr.gather(mi.UInt32, self._starts, c, under) for c in (cell, cell + 1))
        u, v = mi.Float(u), mi.Float(v)
        while at < end:
            other = dr.gather(mi.UInt32, self._over, at)
            q0, q1, q2 = (dr.gather(type(t), t, other >> 1) for t in self._triangles)
            a, b = coordinates(x - q0, q1, q2)
            inside = (a >= -EDGE) & (b >= -EDGE) & (a + b <= 1 + EDGE)
            side = dr.select(inside, other, side)
            u = dr.select(inside, dr.clip(a, 0, 1), u)
            v = dr.select(inside, dr.clip(b, 0, 1), v)
            at = dr.select(inside, end, at + 1)
        return side >> 1, (side & 1) == 1, u, v


def _table(sides, values, n):
    """Values of all ``n`` sides, 0 but for those given (UInt32 [n])."""
    table = np.zeros(n, dtype=np.uint32)
    table[sides] = values
    return owned(mi.UInt32, table)


def _boxes(under, over):
    """Boxes around triangles ``over``, in the barycentric coordinates of triangles ``under`` (both [n, 3, 3]): two
    corners [n, 2]."""
    u, v = barycentric(over, under)
    low, high = (np.column_stack([which(u, axis=1), which(v, axis=1)]) for which in (np.min, np.max))
    return low - PAD * (1 + high - low), high + PAD * (1 + high - low)


def barycentric(points: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (u, v) of ``points`` [n, m, 3] in the planes of triangles [n, 3, 3] (two [n, m])."""
    e1, e2 = (triangles[:, k, None] - triangles[:, :1] for k in (1, 2))
    x, normal = points - triangles[:, :1], np.cross(e1, e2)
    n2 = (normal**2).sum(axis=2)
    return (np.cross(x, e2) * normal).sum(axis=2) / n2, (np.cross(e1, x) * normal).sum(axis=2) / n2


def _in_cells(low, high, finest):
    """The cells of grids that boxes reach into: cell y · finest + x, and the number of its box (two int [m])."""
    a, b = (np.clip(np.floor(c * finest[:, None]).astype(np.int64), 0, finest[:, None] - 1) for c in (low, high))
    width, height = (b - a + 1).T
    box, k = runs(width * height)
    return (a[box, 1] + k // width[box]) * finest[box] + a[box, 0] + k % width[box], box
