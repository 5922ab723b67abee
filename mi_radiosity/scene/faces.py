"""Faces of a Mitsuba scene, as NumPy arrays."""

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import owned, row_keys, runs
from ..core.errors import RadiosityError
from .meshes import unit
from .tessellate import tracing_scene

RAY_OFFSET = 2.0**-18  # of the largest coordinate: some 30 roundings of float32
SPREAD = (  # of bits to every third: shifts, and the bits that are right after them
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
BENT = 0.866  # cosine between shading and geometric normal, below which a face counts as bent
FLATNESS = 1e-12  # area / longest edge² below which a face is degenerate


class Faces:
    """Geometry of every face of a scene, in Mitsuba's order, which a ray's hit names it by.

    ``tracing``: the scene itself, or one in which every shape is a mesh; ``parts``: what its shapes stand for. Arrays
    over faces: ``corners`` [faces, 3, 3] m, ``e1``, ``e2``, ``normal`` (unit, towards the shading side), ``area`` m²,
    ``shape`` (its number in ``tracing``), ``degenerate``, ``flipped`` (the shading side is not that of the order of
    corners), ``rank`` (its place in an order that only geometry decides) and ``order`` (the faces in it); ``vertex``
    [faces, 3]: numbers of their corners, the same where positions are the same to the bit. ``low``, ``high``,
    ``centre`` [3] of the box around them; ``lift``: by how much rays must start off a surface, and what lies in one
    plane, m; ``smooth``: some shapes have vertex normals; ``bent`` [faces]: those whose vertex
    normals are far from the geometric one.

    Raises RadiosityError for what cannot be read, naming the shape.
    """

    def __init__(self, scene: "mi.Scene") -> None:
        self.scene = scene
        self.warnings: list[str] = []
        if not scene.shapes():
            raise RadiosityError("the scene has no shapes: nothing can be lit")
        self.tracing, self.parts, mended = tracing_scene(scene)
        if mended:
            where = ", ".join(mended[:3]) + (f" and {len(mended) - 3} more" if len(mended) > 3 else "")
            self.warnings.append(f"{where}: vertex normals that are zero or no numbers are replaced by face normals")
        self.smooth = any(mesh.has_vertex_normals() for mesh in self.tracing.shapes())
        self._read(*_corners(self.tracing))
        self._orient()
        self.bent = self._bent()

    def __len__(self) -> int:
        return len(self.shape)

    def _read(self, corners, counts):
        self.shape, number = runs(counts)
        if not len(corners):
            raise RadiosityError("the scene has no faces: nothing can be lit")
        self.refuse(~np.isfinite(corners).all(axis=(1, 2)), "has vertices that are not finite numbers: repair the mesh")
        self.corners = corners
        self.low, self.high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        self.centre = (self.low + self.high) / 2
        self.lift = RAY_OFFSET * max(-self.low.min(), self.high.max(), np.finfo(np.float32).tiny)
        self.order = _canonical_order(corners)
        self.rank = np.empty_like(self.order)
        self.rank[self.order] = np.arange(len(corners))
        self.e1, self.e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        cross = np.cross(self.e1, self.e2)
        double_area = np.linalg.norm(cross, axis=1)
        longest = np.maximum.reduce([np.einsum("ij,ij->i", e, e) for e in (self.e1, self.e2, self.e2 - self.e1)])
        self.degenerate = double_area <= FLATNESS * longest
        if self.degenerate.any():
            count, where = int(self.degenerate.sum()), self.names(self.degenerate)
            self.warnings.append(f"{count} faces without area are left out, in {where}")
        self.area = double_area / 2
        self.normal = cross / np.where(self.degenerate, 1, double_area)[:, None]
        first = np.cumsum(counts) - counts
        self.first_face = owned(mi.UInt32, first)
        self._number = owned(mi.UInt32, number)
        self._shape = owned(mi.UInt32, self.shape)

    def _orient(self):
        """Turn normals towards the shading side, which is not always that of the order of corners."""
        n = len(self)
        third = dr.full(mi.Float, 1 / 3, n)
        si = self.surface(dr.arange(mi.UInt32, n), third, third)
        shading = np.array(si.sh_frame.n, dtype=np.float64).reshape(3, n).T
        self.flipped = (shading * self.normal).sum(axis=1) < 0
        self.normal[self.flipped] *= -1

    def _bent(self):
        """Which faces have vertex normals far from the geometric normal (bool [faces])."""
        cosine, start = np.ones(len(self)), 0
        for mesh in self.tracing.shapes():
            faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
            part, start = slice(start, start + len(faces)), start + len(faces)
            if mesh.has_vertex_normals() and not mesh.has_face_normals():
                normals = unit(np.array(mesh.vertex_normals_buffer(), dtype=np.float64).reshape(-1, 3))[faces]
                cosine[part] = np.abs(np.einsum("ijk,ik->ij", normals, self.normal[part])).min(axis=1)
        return ~self.degenerate & (cosine < BENT)

    @cached_property
    def vertex(self) -> np.ndarray:
        bits = np.ascontiguousarray(self.corners.reshape(-1, 3) + 0.0, dtype=np.float32).view(np.uint32)
        return np.unique(row_keys(bits), return_inverse=True)[1].reshape(-1, 3).astype(np.int64)

    def surface(self, face: "mi.UInt32", u: "mi.Float", v: "mi.Float") -> "mi.SurfaceInteraction3f":
        """Mitsuba's surface interaction at points (u, v) of faces (UInt32, Float, Float [n])."""
        n = dr.width(face)
        prelim = dr.zeros(mi.PreliminaryIntersection3f, n)
        prelim.valid = dr.full(mi.Bool, True, n)
        prelim.t = 1.0
        prelim.prim_index = dr.gather(mi.UInt32, self._number, face)
        prelim.prim_uv = mi.Point2f(u, v)
        prelim.shape_index = dr.gather(mi.UInt32, self._shape, face)
        prelim.shape = dr.gather(mi.ShapePtr, self.tracing.shapes_dr(), prelim.shape_index)
        return prelim.compute_surface_interaction(dr.zeros(mi.Ray3f, n), mi.RayFlags.All)

    # ---- What messages call them ---------------------------------------------------------------

    def refuse(self, bad: ArrayLike, why: str) -> None:
        """Raise RadiosityError naming the shape of the first face in ``bad`` (bool [faces])."""
        if np.any(bad):
            raise RadiosityError(f"{self.name(self.shape[np.argmax(bad)])} {why}")

    def name(self, shape: int) -> str:
        """How messages call the shape of a number."""
        return self.parts[shape].name

    def names(self, which: np.ndarray) -> str:
        """The shapes of faces (a mask or numbers), three of them by name."""
        names = sorted({self.name(i) for i in np.unique(self.shape[which])})
        return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _corners(scene):
    """Corners of all faces (float64 [faces, 3, 3]), and how many faces each shape has."""
    corners, counts = [np.zeros((0, 3, 3))], []
    for mesh in scene.shapes():
        positions = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
        corners.append(positions[faces])
        counts.append(len(faces))
    return np.concatenate(corners), np.array(counts)


def _canonical_order(corners):
    """Faces in an order that only geometry decides (int [faces]).

    Mitsuba's order of shapes varies from one process to the next. Along a Morton curve, so that
    neighbours in the order are neighbours in space; the bytes of the corners decide between equals.
    """
    centroid = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3
    low = centroid.min(axis=0)
    # Off the borders of cells, where halves and thirds lie: rounding must not decide there.
    place = (centroid - low) / max((centroid - low).max(), np.finfo(float).tiny) * (3**0.5 - 1) + 1 - 3**0.5 / 2
    cell = (place * (2**20 - 1)).astype(np.uint64)
    for shift, mask in SPREAD:
        cell = (cell | cell << np.uint64(shift)) & np.uint64(mask)
    morton = cell[:, 0] | cell[:, 1] << np.uint64(1) | cell[:, 2] << np.uint64(2)
    words = np.ascontiguousarray(corners, dtype=np.float32).reshape(len(corners), 9).view(np.uint32).astype(np.uint64)
    odd = np.uint64(0x9E3779B97F4A7C15) * (2 * np.arange(9, dtype=np.uint64) + np.uint64(1))
    return np.lexsort(((words * odd).sum(axis=1), morton))
