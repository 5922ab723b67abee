"""Facets: what a matrix of view factors has rows for, and what rays from them meet."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, lower_bound, opaque_index, owned
from ..core.errors import RadiosityError
from ..core.extras import optional
from ..core.points import Stream, paired_nets, stream_seed, triangle
from ..mesh import Elements
from ..mesh.exposure import is_covered
from ..mesh.subdivision import NODES
from ..scene import Model
from ..scene.hit import Hit
from .emit import launches

LEVELS = ("shape", "face", "leaf")
OUTSIDE = ("sky", "ground", "backs")  # where rays end that meet no facet
STRAY = NONE - 1  # where rays end that start next to an edge, behind the neighbour
CRACK = 2.0**-6  # of the way to the middle, from where a neighbour hides no point that lies before it
NUDGE = 2.0**-16  # by which a neighbouring ray differs in direction
COPLANAR = 1 - 1e-6  # cosine between normals from which on two facets cannot see each other
AT_ONCE = 1 << 22  # rays in one launch: bounds memory, and the time until an interrupt is heard


class Facets:
    """The cells of a mesh, its leaves or its patches, and the row of the matrix that each belongs to.

    level: "shape", all of a side of a shape; "face", a side of a face; "leaf", a leaf of the mesh. ``cells``: elements
    (UInt32 [cells]); ``number_of``: the cell of an element (UInt32 [elements]); ``row``, ``area`` (m²) and ``corners``
    [cells, 3, 3] of the cells as NumPy arrays, row after row; ``names`` of the rows, "SHAPE[/FACE][/back][/LEAF]", in
    an order that only names and geometry decide.
    """

    def __init__(self, model: Model, elements: Elements, level: str):
        if level not in LEVELS:
            raise RadiosityError(f"unknown level '{level}': choose one of {', '.join(LEVELS)}")
        self.model, self.elements = model, elements
        self._to_leaf = level == "leaf"
        cells = elements.leaves if self._to_leaf else dr.arange(mi.UInt32, model.patches.count)
        self.names, row = self._rows(level, np.array(dr.gather(mi.UInt32, elements.patch, cells)))
        order = np.argsort(row, kind="stable")
        self.row, self.cells = row[order], dr.gather(mi.UInt32, cells, owned(mi.UInt32, order))
        self._patch = np.array(dr.gather(mi.UInt32, elements.patch, self.cells))
        self.area = np.array(dr.gather(mi.Float, elements.area, self.cells), dtype=np.float64)
        self.number_of = dr.full(mi.UInt32, NONE, len(elements))
        dr.scatter(self.number_of, dr.arange(mi.UInt32, len(self)), self.cells)

    def __len__(self) -> int:
        return dr.width(self.cells)

    def cell_at(self, hit: Hit, active: "mi.Bool | bool" = True) -> "mi.UInt32":
        """The element that is the cell at hits (UInt32 [n])."""
        return self.elements.leaf_at(hit.patch, hit.u, hit.v, active) if self._to_leaf else hit.patch

    def _rows(self, level, patch):
        """Names of the rows, and the row of every cell, whose patches are given, neighbours together (int [cells])."""
        faces, patches = self.model.faces, self.model.patches
        face, back = np.array(patches.face)[patch], np.array(patches.back)[patch].astype(np.int64)
        shape, number = faces.shape[face], face - np.searchsorted(faces.shape, faces.shape[face])
        ids = [_identity(faces.scene, part) for part in faces.parts]
        first = np.full(len(ids), len(faces))
        np.minimum.at(first, faces.shape, faces.rank)
        order = sorted(range(len(ids)), key=lambda k: (ids[k], first[k]))
        place = np.argsort(order)
        called = [ids[k] or f"shape-{p}" for p, k in enumerate(order)]
        keys = {"shape": [place[shape], back], "face": [place[shape], number, back]}
        keys["leaf"] = [*keys["face"], np.arange(len(patch)) - np.searchsorted(patch, patch)]
        rows, row = np.unique(np.column_stack(keys[level]), axis=0, return_inverse=True)
        return [_name(called[shape], *rest) for shape, *rest in rows], row.ravel()

    @property
    def corners(self) -> np.ndarray:
        """Corners of the cells, counter-clockwise as seen from their side, relative to the centre of the scene, m."""
        e, faces, patches = self.elements, self.model.faces, self.model.patches
        face = np.array(patches.face)[self._patch]
        u0, v0, scale = (np.array(dr.gather(mi.Float, x, self.cells), dtype=float) for x in (e.u0, e.v0, e.scale))

        def point(a, b):
            u, v = (u0 + scale * a)[:, None], (v0 + scale * b)[:, None]
            return faces.corners[face, 0] - faces.centre + u * faces.e1[face] + v * faces.e2[face]

        corners = np.stack([point(a, b) for a, b in NODES[:3]], axis=1)
        turned = faces.flipped[face] != np.array(patches.back)[self._patch].astype(bool)
        corners[turned] = corners[turned, ::-1]
        return corners


def _identity(scene, part):
    """The id of a shape, behind that of the instance that places it, if there is one."""
    own = part.shape.id()
    return own if part.to_world is None else f"{scene.shapes()[part.number].id() or part.number}.{own}"


def _name(shape, *rest):
    """A row in words: numbers of the face and the leaf, and the side between them."""
    if len(rest) == 1:
        return shape + "/back" * int(rest[0])
    return "/".join([f"{shape}/{rest[0]}", *["back"] * int(rest[1]), *(str(k) for k in rest[2:])])


@dataclass(frozen=True)
class Counts:
    """What the rays of every cell met, in whole numbers."""

    cast: np.ndarray  # rays of the cells, without strays [cells]
    kept: np.ndarray  # ... without those that start under other faces or inside solids [cells]
    met: Any  # how many rays of i met j (SciPy CSR [cells, cells])
    outside: np.ndarray  # how many went elsewhere [cells, OUTSIDE]


def count_rays(
    facets: Facets, rays: int, seed: int, up: tuple[float, float, float], progress: Callable[[int, int], None]
) -> Counts:
    """Cast ``rays`` cosine-distributed rays from every row, shared out to its cells by area and rounded up.

    Low-discrepancy within every cell, in position and in direction. Counts do not depend on threads or batches.
    """
    sparse = optional("scipy.sparse", "a matrix of view factors", "factors")
    n, size = len(facets), np.bincount(facets.row, weights=facets.area)
    cast = np.ceil(rays * facets.area / size[facets.row] * (1 - 1e-9)).astype(np.int64)
    if cast.sum() >= NONE:
        raise RadiosityError(f"{cast.sum():,} rays are too many: ask for fewer per facet")
    runs = [_added_up(keys) for keys in _casts(facets, cast, seed, up, progress)]
    keys, count = _added_up(*(np.concatenate(x) for x in zip(*runs)))
    cell, met = (keys >> np.uint64(32)).astype(np.int32), keys.astype(np.uint32)
    on = met < n

    def ended(where):
        return np.bincount(cell[met == where], weights=count[met == where], minlength=n).astype(np.int64)

    outside = np.column_stack([ended(n + k) for k in range(len(OUTSIDE))])
    starts = np.searchsorted(cell[on], np.arange(n + 1)).astype(np.int32)
    matrix = sparse.csr_array((count[on], met[on].astype(np.int32), starts), (n, n))
    cast = cast - ended(STRAY)
    return Counts(cast, cast - ended(NONE), matrix, outside)


def _added_up(keys, count=None):
    """Keys in order and without repetitions, and their counts, by default how often each is there (int32)."""
    if count is None:
        keys = np.sort(keys)
    elif (keys[1:] <= keys[:-1]).any():
        order = np.argsort(keys, kind="stable")
        keys, count = keys[order], count[order]
    first = np.flatnonzero(np.append(True, keys[1:] != keys[:-1]))
    number = np.diff(np.append(first, len(keys))) if count is None else np.add.reduceat(count, first)
    return keys[first], number.astype(np.int32)


def _casts(facets, cast, seed, up, progress):
    """Cell · 2³² + the cell met, or cells + a number of OUTSIDE, or NONE for rays that go nowhere (uint64 [rays])."""
    ends, total = np.cumsum(cast), int(cast.sum())
    last, first, count = (owned(mi.UInt32, x) for x in (ends, ends - cast, cast))
    keys, stream = facets.elements.key(facets.cells), opaque_index(stream_seed(seed, Stream.FACTORS))
    up = mi.Vector3f(*(dr.opaque(mi.Float, x) for x in up))
    done = 0
    for ray in launches(total, AT_ONCE):
        cell = lower_bound(last, ray + 1)
        start, of = (dr.gather(mi.UInt32, x, cell) for x in (first, count))
        met = _ends(facets, cell, paired_nets(ray - start, of, keys, stream, cell), up)
        dr.eval(cell, met)
        yield (np.array(cell).astype(np.uint64) << np.uint64(32)) | np.array(met)
        done += dr.width(ray)
        progress(done, total)


def _ends(facets, cell, numbers, up):
    """Where rays from cells end (UInt32 [rays])."""
    elements, rays, (x, y, s, t) = facets.elements, facets.model.rays, numbers
    element = dr.gather(mi.UInt32, facets.cells, cell)
    patch, (u, v) = dr.gather(mi.UInt32, elements.patch, element), elements.patch_point(element, *triangle(x, y))
    normal = dr.gather(mi.Vector3f, elements.patches.normal, patch)
    met = _met(facets, normal, *rays.leave(patch, u, v, s, t), up)
    met = dr.select(rays.on_top(patch, u, v), met, NONE)
    dr.eval(met, u, v, s, t)
    n = len(facets)
    doubtful = dr.compress((met >= opaque_index(n)) & (met < opaque_index(n + len(OUTSIDE))))
    if dr.width(doubtful):
        element, patch = (dr.gather(mi.UInt32, a, doubtful) for a in (element, patch))
        normal = dr.gather(mi.Vector3f, normal, doubtful)
        u, v, s, t = (dr.gather(mi.Float, a, doubtful) for a in (u, v, s, t))
        origin, direction = rays.leave(patch, u, v, s, t)
        # Between two faces a ray may slip through: its neighbour does not.
        end = _met(facets, normal, origin, dr.normalize(direction + NUDGE * (mi.Vector3f(s, t, u) - 0.5)), up)
        end = dr.select(_in_a_crack(elements, rays, element, patch, u, v), STRAY, end)
        # Inside a solid: rays that start there go nowhere.
        backs = dr.compress(end == opaque_index(n + OUTSIDE.index("backs")))
        if dr.width(backs):
            inside = [dr.gather(type(a), a, backs) for a in (element, u, v, s, t)]
            dr.scatter(end, mi.UInt32(NONE), backs, is_covered(elements, rays, *inside, gaps=False))
        dr.scatter(met, end, doubtful)
    return met


def _met(facets, normal, origin, direction, up):
    """The cells that rays meet, or cells + a number of OUTSIDE (UInt32 [rays]).

    Rays that graze their own plane may hit it by rounding: they count as strays.
    """
    hit = facets.model.rays.trace(origin, direction)
    on = hit.patch != NONE
    met = dr.gather(mi.UInt32, facets.number_of, facets.cell_at(hit, on), on)
    own = dr.dot(dr.gather(mi.Vector3f, facets.model.patches.normal, hit.patch, on), normal) > COPLANAR
    met = dr.select(own, mi.UInt32(STRAY), met)
    sky, ground, backs = (opaque_index(len(facets) + k) for k in range(len(OUTSIDE)))
    return dr.select(on, met, dr.select(hit.valid, backs, dr.select(dr.dot(direction, up) >= 0, sky, ground)))


def _in_a_crack(elements, rays, element, patch, u, v):
    """Do points, lifted off their elements, lie behind a neighbour (Bool [n])? Seen from a little nearer the middle."""
    middle = elements.patch_point(element, mi.Float(1 / 3), mi.Float(1 / 3))
    near = (x + CRACK * (y - x) for x, y in zip((u, v), middle))
    return rays.blocked(elements.patches.above(patch, *near), elements.patches.above(patch, u, v))
