"""Faces that lie in one another: which of them a ray meets is decided here, not by rounding."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import components, opaque_index, owned, runs
from .faces import Faces
from .lookup import EDGE, Lookup, barycentric

CHUNK = 1 << 21  # candidate pairs tested at a time: bounds memory
GUESS = 12  # pairs of faces that are near each other, per face
FINEST = 30  # a grid has up to 2^30 cells along an axis
LOOKERS, FINER = 2, 4  # a cell is halved up to 4 times, where 8, 32, 128, 512 faces look for one that is there
ABOUT = 0.999  # of the area of another face: as large, to float32
FLAT = 1 - 1e-6  # cosine between normals of faces in one plane
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

    def lookup(self, centre: np.ndarray) -> Lookup | None:
        """The same on the device, for points relative to ``centre``; None if nothing overlaps."""
        return Lookup(self.corners - centre, self.under, self.over) if len(self.under) else None


def find_overlaps(
    faces: Faces, present: np.ndarray, exitance: np.ndarray, reflectance: np.ndarray, tolerance: float
) -> Overlaps:
    """Look for coplanar faces that share area.

    Per side, front and back: ``present`` (bool [faces, 2]), ``exitance``, ``reflectance`` [faces, 2];
    ``tolerance``: how far from a plane still counts as in it, m.
    """
    f, g = coplanar_pairs(faces.corners, faces.normal, faces.area, ~faces.degenerate, tolerance)
    order = _precedence(faces, np.unique(f), present, exitance, reflectance)
    opposite = (faces.normal[f] * faces.normal[g]).sum(axis=1) < 0
    under = np.concatenate([2 * f, 2 * f + 1])
    over = np.concatenate([2 * g + opposite, 2 * g + 1 - opposite])
    before = (order[over] < order[under]) & present.ravel()[over]
    under, over = under[before], over[before]
    by = np.lexsort([order[over], under])
    under, over = under[by], over[by]
    return Overlaps(faces.corners, present.ravel(), under, over, _covered(faces.corners, under, over, present.shape))


def _precedence(faces, chosen, present, exitance, reflectance):
    """Place of every side in the order in which points belong to sides, of the ``chosen`` faces (int [2 · faces])."""
    order = np.zeros(present.size, dtype=np.int64)
    if len(chosen) == 0:
        return order
    surface = surfaces(faces.vertex, faces.normal)
    size = np.bincount(surface, weights=np.where(faces.degenerate, 0, faces.area))[surface[chosen]]
    first = np.full(surface.max() + 1, len(faces))
    np.minimum.at(first, surface, faces.rank)
    size = np.round(np.log(size + 1e-300), 4)
    rank, first = faces.rank[chosen, None], first[surface[chosen], None]
    keys = (rank, first, reflectance[chosen], size[:, None], -exitance[chosen], ~present[chosen])
    sides = (2 * chosen[:, None] + [0, 1]).ravel()
    places = np.lexsort([np.broadcast_to(k, (len(chosen), 2)).ravel() for k in keys])
    order[sides[places]] = np.arange(len(sides))
    return order


def coplanar_pairs(
    corners: np.ndarray, normal: np.ndarray, area: np.ndarray, sound: np.ndarray, tolerance: float
) -> np.ndarray:
    """Ordered pairs (f, g) of ``sound`` faces in one plane whose interiors meet (two int [pairs])."""
    chosen = np.flatnonzero(sound)
    if len(chosen) == 0:
        return np.zeros((2, 0), dtype=np.int64)
    faces, found = _Triangles(corners[chosen], normal[chosen], area[chosen], tolerance), [np.zeros((0, 2), np.int64)]
    f, g = _Grid(faces).pairs()
    for start in range(0, dr.width(f), CHUNK):
        part = opaque_index(start) + dr.arange(mi.UInt32, min(CHUNK, dr.width(f) - start))
        ends = [dr.gather(mi.UInt32, x, part) for x in (f, g)]
        meet = dr.compress(faces.meet(*ends))
        found.append(np.column_stack([chosen[np.array(dr.gather(mi.UInt32, x, meet))] for x in ends]))
    f, g = np.concatenate(found).T
    rows = np.unique(np.concatenate([f << 32 | g, g << 32 | f]))
    return np.array([rows >> 32, rows & 0xFFFFFFFF])


class _Triangles:
    """Faces on the device: many pairs are looked at, and few are left. The larger of two knows its plane best.

    ``low``, ``high``: their boxes, the tolerance larger, from the origin on (three Float64 [faces] each); ``level``:
    they are no larger than 2^level m (int [faces]).
    """

    def __init__(self, corners: np.ndarray, normal: np.ndarray, area: np.ndarray, tolerance: float) -> None:
        low, high = (which(which(corners[:, 0], corners[:, 1]), corners[:, 2]) for which in (np.minimum, np.maximum))
        origin = low.min(axis=0) - tolerance
        size = np.maximum(np.maximum(*(high - low).T[:2]), (high - low)[:, 2]) + 2 * tolerance
        self.level = np.frexp(size)[1]
        self.level = np.maximum(self.level, np.frexp((high.max(axis=0) - origin).max())[1] - FINEST)
        self.low = [owned(mi.Float64, low[:, axis] - origin[axis] - tolerance) for axis in range(3)]
        self.high = [owned(mi.Float64, high[:, axis] - origin[axis] + tolerance) for axis in range(3)]
        self._corners = [[owned(mi.Float64, corners[:, k, axis] - origin[axis]) for axis in range(3)] for k in range(3)]
        self._normal = [owned(mi.Float64, normal[:, axis]) for axis in range(3)]
        self._area, self._tolerance = owned(mi.Float64, area), dr.opaque(mi.Float64, tolerance)
        self._twice = dr.opaque(mi.Float, 2 * tolerance)  # within which nothing is lost in float32
        first = corners[:, 0] - origin
        self._first = owned(mi.Float, np.column_stack([first, area]).ravel())
        self._plane = owned(mi.Float, np.column_stack([normal, -(normal * first).sum(axis=1)]).ravel())

    def look(self, face: "mi.UInt32", active: "mi.Bool | bool" = True) -> "tuple[mi.Vector4f, mi.Vector4f]":
        """A corner and the area of faces, and their planes."""
        return tuple(dr.gather(mi.Vector4f, x, face, active) for x in (self._first, self._plane))

    def near_plane(self, one: "tuple[mi.Vector4f, mi.Vector4f]", other: "tuple[mi.Vector4f, mi.Vector4f]") -> "mi.Bool":
        """May a corner of the smaller face be near the plane of the larger one (Bool [n])? Most pairs end here."""
        near = mi.Bool(False)
        for (p, _), (large, n) in ((other, one), (one, other)):
            height = n.x * p.x + n.y * p.y + n.z * p.z + n.w
            near |= (dr.abs(height) <= self._twice) & (large.w >= ABOUT * p.w)
        return near

    def boxes_meet(self, f: "mi.UInt32", g: "mi.UInt32", active: "mi.Bool") -> "mi.Bool":
        """Do the boxes of faces meet, not only at an edge (Bool [n])?"""
        wide = mi.UInt32(0)
        for low, high in zip(self.low, self.high):
            ends = dr.minimum(*(dr.gather(mi.Float64, high, x, active) for x in (f, g)))
            shared = ends - dr.maximum(*(dr.gather(mi.Float64, low, x, active) for x in (f, g))) - 2 * self._tolerance
            active &= shared > -self._tolerance
            wide += dr.select(shared > 0.5 * self._tolerance, mi.UInt32(1), 0)
        return active & (wide > 1)

    def meet(self, f: "mi.UInt32", g: "mi.UInt32") -> "mi.Bool":
        """Do faces lie in one plane, and share more than the tolerance in it (Bool [n])? By separating lines."""
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
        return meet

    def _larger_first(self, f, g):
        larger = dr.gather(mi.Float64, self._area, f) >= dr.gather(mi.Float64, self._area, g)
        return dr.select(larger, f, g), dr.select(larger, g, f)

    def _height(self, f, g, k):
        """How far corners k of faces g are above the planes of faces f, m (Float64 [n])."""
        return sum(
            (dr.gather(mi.Float64, x, g) - dr.gather(mi.Float64, x0, f)) * dr.gather(mi.Float64, n, f)
            for x, x0, n in zip(self._corners[k], self._corners[0], self._normal)
        )


class _Grid:
    """Finds faces near each other. Each lies in those cells that its box meets, of a grid for faces of its size, and
    looks there, and in the grids of all larger ones. A grid is as fine as its faces are large, or finer if they are few
    beside those that look for them. Cells of one key only cost time."""

    def __init__(self, triangles: _Triangles) -> None:
        self._triangles = triangles
        levels, own, there = np.unique(triangles.level, return_inverse=True, return_counts=True)
        looking = np.cumsum(there)
        finer = np.clip(np.log2(looking / (LOOKERS * there)) // 2, 0, FINER)
        usual = levels[np.searchsorted(looking, looking // 2)]  # half of those that look are larger, or as large
        self._first = owned(mi.UInt32, own)  # grid of a face
        self._grids = opaque_index(len(levels))
        self._scale = owned(mi.Float64, 2.0 ** -np.maximum(levels - finer, np.minimum(levels, usual)))
        bits = len(own).bit_length() + 1
        self._shift = opaque_index(32 - bits)
        low, high = (np.array(x, dtype=np.int64) for x in self._cells(dr.arange(mi.UInt32, len(own)), self._first))
        width = high - low + 1
        face, part = runs(width.prod(axis=0))
        x, y = part % width[0, face], part // width[0, face]
        cell = [owned(mi.UInt32, low[k, face] + c) for k, c in enumerate((x, y % width[1, face], y // width[1, face]))]
        keys = np.array(self._key(cell, owned(mi.UInt32, own[face])), dtype=np.int64)
        self._there = owned(mi.UInt32, np.sort(keys << 32 | face) & 0xFFFFFFFF)
        self._start = owned(mi.UInt32, np.concatenate([[0], np.cumsum(np.bincount(keys, minlength=2**bits))]))

    def pairs(self) -> "tuple[mi.UInt32, mi.UInt32]":
        """Pairs of faces that are near each other, hardly one of them twice, in any order (two UInt32 [pairs])."""
        room = GUESS * dr.width(self._first)
        while True:
            f, g = (dr.zeros(mi.UInt32, room) for _ in range(2))
            count = dr.zeros(mi.UInt32, 1)
            dr.eval(self._look(count, f, g), count, f, g)
            if count[0] <= room:
                return tuple(dr.gather(mi.UInt32, x, dr.arange(mi.UInt32, count[0])) for x in (f, g))
            room = count[0]

    @dr.syntax
    def _look(self, count: "mi.UInt32", f: "mi.UInt32", g: "mi.UInt32") -> "mi.UInt32":
        """Write the pairs of all faces to f and g, as far as they are large enough, and ``count`` them."""
        face, first, room = (
            dr.arange(mi.UInt32, dr.width(self._first)),
            mi.UInt32(self._first),
            opaque_index(dr.width(f)),
        )
        grid, own = mi.UInt32(self._first), self._triangles.look(face)
        x, y, z = self._cells(face, grid)[0]  # where to look next
        here, i, j, k, place, end = (mi.UInt32(0) for _ in range(6))
        # No loop in the loop: faces with little in their cells would wait for those with much.
        while (place < end) | (grid < self._grids):
            if place >= end:
                here, i, j, k = mi.UInt32(grid), mi.UInt32(x), mi.UInt32(y), mi.UInt32(z)
                key = self._key((i, j, k), here)
                place, end = (dr.gather(mi.UInt32, self._start, n) for n in (key, key + 1))
                (x0, y0, _), (x1, y1, z1) = self._cells(face, here)
                x += 1
                y = dr.select(x > x1, y + 1, y)
                z = dr.select(y > y1, z + 1, z)
                x, y = dr.select(x > x1, x0, x), dr.select(y > y1, y0, y)
                if z > z1:
                    grid += 1
                    x, y, z = self._cells(face, dr.minimum(grid, self._grids - 1))[0]
            if place < end:
                other = dr.gather(mi.UInt32, self._there, place)
                # Of two in one grid one looks at the other.
                wanted = (dr.gather(mi.UInt32, self._first, other) == here) & ((here > first) | (other < face))
                wanted &= self._triangles.near_plane(own, self._triangles.look(other, wanted))
                if wanted:
                    near = self._triangles.boxes_meet(face, other, self._counts_here(face, other, here, (i, j, k)))
                    at = dr.scatter_inc(count, mi.UInt32(0), near)
                    near &= at < room
                    dr.scatter(f, face, at, near)
                    dr.scatter(g, other, at, near)
                place += 1
        return grid

    def _counts_here(self, face, other, grid, cell):
        """Does the box that two faces share begin in this cell of several that both are in (Bool [n])?"""
        scale, here = dr.gather(mi.Float64, self._scale, grid), mi.Bool(True)
        for low, c in zip(self._triangles.low, cell):
            begin = dr.maximum(*(dr.gather(mi.Float64, low, x) for x in (face, other)))
            here &= mi.UInt32(mi.Int32(begin * scale)) == c
        return here

    def _cells(self, face, grid):
        """The first and the last of the cells of a grid that the boxes of faces meet (three UInt32 [n] each)."""
        scale = dr.gather(mi.Float64, self._scale, grid)
        ends = self._triangles.low, self._triangles.high
        return [[mi.UInt32(mi.Int32(dr.gather(mi.Float64, x, face) * scale)) for x in end] for end in ends]

    def _key(self, cell, grid):
        """A number below that of keys, from the cell of a grid (UInt32 [n])."""
        x, y, z = cell
        mixed = x * 0x9E3779B1 + y * 0x85EBCA6B + z * 0xC2B2AE35 + grid * 0x27D4EB2F
        return ((mixed ^ (mixed >> 15)) * mi.UInt32(0x2C1B3C6D)) >> self._shift


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


def surfaces(vertex: np.ndarray, normal: np.ndarray, min_cosine: float = FLAT) -> np.ndarray:
    """A number per face, the same for faces that share edges, run along them in opposite directions, and whose normals
    have at least that cosine, by default only those of one plane; from the numbers of their corners [faces, 3] (int
    [faces])."""
    tail, head = vertex.ravel(), np.roll(vertex, -1, axis=1).ravel()
    edge = np.minimum(tail, head) << 32 | np.maximum(tail, head) << 1 | (tail > head)
    order = np.argsort(edge)
    order = order[(tail != head)[order]]
    edge, face, links = edge[order], order // 3, []
    one, step = np.arange(len(order)), 0
    while len(one):  # two faces share an edge, as a rule: after the first step few are left
        step += 1
        one = one[: np.searchsorted(one, len(order) - step)]
        one = one[edge[one] >> 1 == edge[one + step] >> 1]
        f, g = face[one], face[one + step]
        level = np.einsum("ij,ij->i", normal[f], normal[g]) > min_cosine
        links.append(np.array([f, g])[:, level & (edge[one] != edge[one + step])])
    return components(len(vertex), *np.hstack(links)) if links else np.arange(len(vertex))


def _inside(points, triangles):
    """Do ``points`` [n, m, 3] lie in the triangles [n, 3, 3] of their planes (bool [n, m])?"""
    a, b = barycentric(points, triangles)
    return (a >= -EDGE) & (b >= -EDGE) & (a + b <= 1 + EDGE)
