"""Faces that lie in one another: which of them a ray meets is decided here, not by rounding."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import components, owned, owned_vectors
from ..core.points import coordinates
from .faces import Faces

CHUNK = 1 << 21  # candidate pairs tested at a time: bounds memory
EDGE = 1e-5  # how far outside of a face, in barycentric coordinates, a point still counts as on it
LATTICE = 8  # points along a side that show whether a face is covered


@dataclass(frozen=True)
class Overlaps:
    """Coplanar faces that share area, and who owns what they share.

    Where faces lie in one plane to within rounding, rounding decides which of them a ray
    meets, so each would get a part of the light and pictures would be speckled. A point belongs to
    one side instead: to one with a material before one without, to a lamp, then to the smaller
    surface, which is read as lying on the larger. Surfaces are faces that share edges in a plane.

    Numbers of sides are 2 · face + (1 for the back). Row k says that ``over``[k] lies on ``under``[k]; rows are
    sorted by ``under``, the uppermost first. ``covered`` (bool [faces, 2]): sides no point of which is their own.
    """

    corners: np.ndarray  # [faces, 3, 3]
    present: np.ndarray  # bool [2 · faces]: sides that have a material
    under: np.ndarray
    over: np.ndarray
    covered: np.ndarray

    def among(self, sides: np.ndarray) -> "tuple[Overlaps, np.ndarray]":
        """These overlaps without what hides behind sides other than ``sides`` (int), and the faces that really lie in
        one another (int)."""
        there = np.zeros(self.covered.size, dtype=bool)
        there[sides] = True
        kept = there[self.over]
        under, over = self.under[kept], self.over[kept]
        doubled = self.present[under] & (there | self.covered.ravel())[under]
        faces = np.unique(np.concatenate([under[doubled], over[doubled]]) // 2)
        return Overlaps(self.corners, self.present, under, over, self.covered), faces

    def lookup(self, centre: np.ndarray) -> "Lookup | None":
        """The same on the device, for points relative to ``centre``; None if nothing overlaps."""
        return Lookup(self, centre) if len(self.under) else None


class Lookup:
    """Overlaps as tables on the device; ``under`` and ``over`` as there."""

    def __init__(self, overlaps: Overlaps, centre: np.ndarray) -> None:
        corner = overlaps.corners - centre
        edges = [corner[:, k] - corner[:, 0] for k in (1, 2)]
        self._triangles = [owned_vectors(mi.Point3f, corner[:, 0]), *(owned_vectors(mi.Vector3f, e) for e in edges)]
        self._starts = owned(mi.UInt32, np.searchsorted(overlaps.under, np.arange(overlaps.covered.size + 1)))
        self.under, self.over = overlaps.under, overlaps.over
        self._over = owned(mi.UInt32, overlaps.over)

    @dr.syntax
    def owner(
        self, face: "mi.UInt32", back: "mi.Bool", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool"
    ) -> "tuple[mi.UInt32, mi.Bool, mi.Float, mi.Float]":
        """The face, side and coordinates that points (u, v) of sides belong to (UInt32, Bool, Float, Float)."""
        side = 2 * face + dr.select(back, mi.UInt32(1), mi.UInt32(0))
        p0, e1, e2 = (dr.gather(type(t), t, face, active) for t in self._triangles)
        x = p0 + e1 * u + e2 * v
        at = dr.gather(mi.UInt32, self._starts, side, active)
        end = dr.gather(mi.UInt32, self._starts, side + 1, active)
        u, v = mi.Float(u), mi.Float(v)
        while active & (at < end):
            other = dr.gather(mi.UInt32, self._over, at)
            q0, q1, q2 = (dr.gather(type(t), t, other >> 1) for t in self._triangles)
            a, b = coordinates(x - q0, q1, q2)
            inside = (a >= -EDGE) & (b >= -EDGE) & (a + b <= 1 + EDGE)
            side = dr.select(inside, other, side)
            u = dr.select(inside, dr.clip(a, 0, 1), u)
            v = dr.select(inside, dr.clip(b, 0, 1), v)
            at = dr.select(inside, end, at + 1)
        return side >> 1, (side & 1) == 1, u, v


def find_overlaps(
    faces: Faces, present: np.ndarray, exitance: np.ndarray, reflectance: np.ndarray, tolerance: float
) -> Overlaps:
    """Look for coplanar faces that share area.

    Per side, front and back: ``present`` (bool [faces, 2]), ``exitance``, ``reflectance`` [faces, 2];
    ``tolerance``: how far from a plane still counts as in it, m.
    """
    f, g = coplanar_pairs(faces.corners, faces.normal, faces.area, ~faces.degenerate, tolerance)
    order = _precedence(faces, present, exitance, reflectance)
    opposite = (faces.normal[f] * faces.normal[g]).sum(axis=1) < 0
    under = np.concatenate([2 * f, 2 * f + 1])
    over = np.concatenate([2 * g + opposite, 2 * g + 1 - opposite])
    before = (order[over] < order[under]) & present.ravel()[over]
    under, over = under[before], over[before]
    by = np.lexsort([order[over], under])
    under, over = under[by], over[by]
    return Overlaps(faces.corners, present.ravel(), under, over, _covered(faces.corners, under, over, present.shape))


def _precedence(faces, present, exitance, reflectance):
    """Place of every side in the order in which points belong to sides (int [2 · faces])."""
    surface = surfaces(faces.vertex, faces.normal)
    size = np.bincount(surface, weights=np.where(faces.degenerate, 0, faces.area))[surface]
    first = np.full(surface.max() + 1, len(faces))
    np.minimum.at(first, surface, faces.rank)
    size = np.round(np.log(size + 1e-300), 4)
    keys = (faces.rank[:, None], first[surface][:, None], reflectance, size[:, None], -exitance, ~present)
    order = np.empty(present.size, dtype=np.int64)
    order[np.lexsort([np.broadcast_to(k, present.shape).ravel() for k in keys])] = np.arange(present.size)
    return order


def coplanar_pairs(
    corners: np.ndarray, normal: np.ndarray, area: np.ndarray, sound: np.ndarray, tolerance: float
) -> np.ndarray:
    """Ordered pairs (f, g) of ``sound`` faces in one plane whose interiors meet (two int [pairs])."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    faces, found = _Triangles(corners, normal, area, tolerance), [np.zeros((0, 2), dtype=np.int64)]
    for f, g in _boxes_that_meet(low, high, np.flatnonzero(sound), tolerance, faces.near_plane):
        meet = faces.meet(f, g)
        found.append(np.column_stack([f[meet], g[meet]]))
    pairs = np.concatenate(found)
    return np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0).T


class _Triangles:
    """Faces on the device: many pairs are looked at, and few are left. The larger of two knows its plane best."""

    def __init__(self, corners: np.ndarray, normal: np.ndarray, area: np.ndarray, tolerance: float) -> None:
        corners = corners - (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
        self._corners = [[owned(mi.Float64, corners[:, k, axis]) for axis in range(3)] for k in range(3)]
        self._normal = [owned(mi.Float64, normal[:, axis]) for axis in range(3)]
        self._area, self._tolerance = owned(mi.Float64, area), dr.opaque(mi.Float64, tolerance)

    def near_plane(self, f: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Is a corner of the smaller face near the plane of the larger one (bool [n])? Most pairs end here."""
        if len(f) == 0:
            return np.zeros(0, dtype=bool)
        f, g = self._larger_first(f, g)
        return self._read(dr.abs(self._height(f, g, 0)) <= self._tolerance)

    def meet(self, f: np.ndarray, g: np.ndarray) -> np.ndarray:
        """Do faces lie in one plane, and share more than the tolerance in it (bool [n])? By separating lines."""
        if len(f) == 0:
            return np.zeros(0, dtype=bool)
        f, g = self._larger_first(f, g)
        meet = mi.Bool(True)
        for k in range(3):
            meet &= dr.abs(self._height(f, g, k)) <= self._tolerance
        # Seen along the axis that the plane faces most.
        x, y, z = (dr.abs(dr.gather(mi.Float64, n, f)) for n in self._normal)
        first, second = (x >= y) & (x >= z), y >= z

        def flat(face):
            """Two coordinates of the three corners."""
            rows = ([dr.gather(mi.Float64, c, face) for c in corner] for corner in self._corners)
            return [
                (dr.select(first, b, dr.select(second, c, a)), dr.select(first, c, dr.select(second, a, b)))
                for a, b, c in rows
            ]

        p, q = flat(f), flat(g)
        for t in (p, q):
            for k in range(3):
                ex, ey = (t[(k + 1) % 3][axis] - t[k][axis] for axis in range(2))
                margin = self._tolerance * dr.sqrt(ex * ex + ey * ey)
                ends = []
                for triangle in (p, q):
                    a, b, c = (v * ex - u * ey for u, v in triangle)
                    ends.append((dr.minimum(a, dr.minimum(b, c)), dr.maximum(a, dr.maximum(b, c))))
                (low_p, high_p), (low_q, high_q) = ends
                meet &= (low_p < high_q - margin) & (low_q < high_p - margin)
        return self._read(meet)

    def _larger_first(self, f, g):
        f, g = mi.UInt32(f), mi.UInt32(g)
        larger = dr.gather(mi.Float64, self._area, f) >= dr.gather(mi.Float64, self._area, g)
        return dr.select(larger, f, g), dr.select(larger, g, f)

    def _height(self, f, g, k):
        """How far corners k of faces g are above the planes of faces f, m (Float64 [n])."""
        return sum(
            (dr.gather(mi.Float64, x, g) - dr.gather(mi.Float64, x0, f)) * dr.gather(mi.Float64, n, f)
            for x, x0, n in zip(self._corners[k], self._corners[0], self._normal)
        )

    def _read(self, which):
        return np.array(which).astype(bool)


def _covered(corners, under, over, shape):
    """Which sides belong to others everywhere, judged by a lattice of points (bool [faces, 2])."""
    a, b = (x.ravel() for x in np.indices((LATTICE, LATTICE)))
    a, b = a[a + b < LATTICE], b[a + b < LATTICE]
    u, v = (a[:, None] + 1 / 3) / LATTICE, (b[:, None] + 1 / 3) / LATTICE
    sides, row = np.unique(under, return_inverse=True)
    taken = np.zeros((len(sides), len(u)), dtype=bool)
    for start in range(0, len(row), CHUNK >> 6):
        part = slice(start, start + (CHUNK >> 6))
        corner = corners[under[part] // 2][:, :, None]
        points = corner[:, 0] + u * (corner[:, 1] - corner[:, 0]) + v * (corner[:, 2] - corner[:, 0])
        np.logical_or.at(taken, row[part], _inside(points, corners[over[part] // 2]))
    covered = np.zeros(shape, dtype=bool)
    covered.reshape(-1)[sides] = taken.all(axis=1)
    return covered


def _boxes_that_meet(low, high, faces, tolerance, likely):
    """Yield ``likely`` pairs of ``faces`` whose boxes low…high [n, 3] meet, not only at an edge.

    The first is of the size of the second at least.
    """
    low, high = low - low.min(axis=0) - tolerance, high - low.min(axis=0) + tolerance
    level, faces = np.frexp((high - low).max(axis=1))[1], faces.astype(np.uint32)
    for size in np.unique(level[faces]):
        # Faces no larger than a cell are in eight cells at most.
        small = faces[level[faces] <= size]
        ends = np.floor(np.stack([low[small], high[small]]) / 2.0**size).astype(np.int64)
        wide = ends[0] != ends[1]
        keys, there = [], []
        for corner in np.ndindex(2, 2, 2):
            new = (wide | (np.array(corner) == 0)).all(axis=1)
            x, y, z = (ends[corner[k], new, k] for k in range(3))
            keys.append(
                x * 0x9E3779B97F4A7C1 + y * 0x2545F4914F6CDD1D + z * 0x27D4EB2F165667C5
            )  # two cells of one key only cost time
            there.append(small[new])
        keys, there = np.concatenate(keys), np.concatenate(there)
        largest = np.flatnonzero(level[there] == size)
        largest = largest[np.argsort(keys[largest])]
        start, end = (np.searchsorted(keys[largest], keys, side) for side in ("left", "right"))
        start[largest] = np.arange(len(largest)) + 1  # of two as large, one looks at the other
        count, ordered = end - start, there[largest]
        for part in np.split(np.arange(len(count)), np.flatnonzero(np.diff(np.cumsum(count) // CHUNK)) + 1):
            each = count[part]
            g = np.repeat(there[part], each)
            f = ordered[np.repeat(start[part] - np.cumsum(each) + each, each) + np.arange(len(g))]
            near = likely(f, g) & (f != g)  # first, as few pass
            f, g = f[near], g[near]
            shared = np.minimum(high[f], high[g]) - np.maximum(low[f], low[g]) - 2 * tolerance
            near = (shared > -tolerance).all(axis=1) & ((shared > tolerance / 2).sum(axis=1) > 1)
            yield f[near], g[near]


def surfaces(vertex: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """A number per face, the same for faces of one plane that share edges and run along them in opposite directions;
    from the numbers of their corners [faces, 3] (int [faces])."""
    n = len(vertex)
    tail, head, face = vertex.ravel(), np.roll(vertex, -1, axis=1).ravel(), np.repeat(np.arange(n), 3)
    along, against = tail << 32 | head, head << 32 | tail
    order = np.argsort(along, kind="stable")
    at = np.minimum(np.searchsorted(along[order], against), 3 * n - 1)
    joined = along[order][at] == against
    f, g = face[joined], face[order[at[joined]]]
    level = (normal[f] * normal[g]).sum(axis=1) > 1 - 1e-6
    f, g = f[level], g[level]
    return components(n, f, g)


def _inside(points, triangles):
    """Do ``points`` [n, m, 3] lie in the triangles [n, 3, 3] of their planes (bool [n, m])?"""
    e1, e2 = (triangles[:, k, None] - triangles[:, :1] for k in (1, 2))
    x, normal = points - triangles[:, :1], np.cross(e1, e2)
    n2 = (normal**2).sum(axis=2)
    a, b = (np.cross(x, e2) * normal).sum(axis=2) / n2, (np.cross(e1, x) * normal).sum(axis=2) / n2
    return (a >= -EDGE) & (b >= -EDGE) & (a + b <= 1 + EDGE)
