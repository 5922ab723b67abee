"""Faces of a Mitsuba scene with their geometry and materials, as NumPy arrays."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.points import triangle
from .support import is_textured, label
from .tessellate import disk_mesh

FLATNESS = 1e-12  # area / longest edge² below which a face is degenerate


class Faces:
    """Every face of a scene, in Mitsuba's order, which a ray's hit names it by.

    ``tracing``: the scene itself, or one in which every shape is a mesh. Arrays over faces: ``corners``
    [faces, 3, 3], ``e1``, ``e2``, ``normal`` (unit, towards the shading side), ``area``, ``shape`` (its
    number), ``degenerate``, ``two_sided``, ``rho`` [2 sides, faces, 3], ``exitance`` E = π L_e in W/m²
    [faces, 3] and ``rank`` (its place in an order that only geometry decides).

    Raises RadiosityError for what cannot be lit, naming the shape.
    """

    def __init__(self, scene):
        self.scene, self.warnings = scene, []
        shapes = scene.shapes()
        if not shapes:
            raise RadiosityError("the scene has no shapes: nothing can be lit")
        self.tracing = self._tracing_scene(scene)
        self._read_geometry()
        self._read_materials()

    @staticmethod
    def _tracing_scene(scene):
        """The scene itself, or one in which every shape is a mesh."""
        shapes = scene.shapes()
        if all(isinstance(shape, mi.Mesh) for shape in shapes):
            return scene
        meshes = [s if isinstance(s, mi.Mesh) else disk_mesh(s) for s in shapes]
        return mi.load_dict({"type": "scene"} | {f"shape_{i}": m for i, m in enumerate(meshes)}, optimize=False)

    def _read_geometry(self):
        corners, counts = [], []
        for mesh in self.tracing.shapes():
            positions = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
            faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
            corners.append(positions[faces])
            counts.append(len(faces))
        self.shape = np.repeat(np.arange(len(counts)), counts)  # [faces]
        corners = np.concatenate(corners)  # [faces, 3, 3]
        if not len(corners):
            raise RadiosityError("the scene has no faces: nothing can be lit")
        self._refuse(
            ~np.isfinite(corners).all(axis=(1, 2)), "has vertices that are not finite numbers: repair the mesh"
        )

        self.corners = corners
        self.centre = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
        self.rank = _canonical_rank(corners)
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        cross = np.cross(e1, e2)
        double_area = np.linalg.norm(cross, axis=1)
        longest = np.maximum.reduce([(e**2).sum(axis=1) for e in (e1, e2, e2 - e1)])
        self.degenerate = double_area <= FLATNESS * longest
        if self.degenerate.any():
            self.warnings.append(
                f"{int(self.degenerate.sum())} faces without area are left out, in {self.names(self.degenerate)}"
            )
        self.e1, self.e2 = e1, e2
        self.area = double_area / 2
        self.normal = cross / np.where(self.degenerate, 1, double_area)[:, None]
        self.first_face = owned(mi.UInt32, np.concatenate([[0], np.cumsum(counts)[:-1]]))
        self._prim = owned(mi.UInt32, np.arange(len(corners)) - np.repeat(np.cumsum(counts) - counts, counts))
        self._shape = owned(mi.UInt32, self.shape)

    def _refuse(self, bad, why):
        """Raise RadiosityError naming the shape of the first face in ``bad`` (bool [faces])."""
        if bad.any():
            index = self.shape[np.argmax(bad)]
            raise RadiosityError(f"{self.name(index)} {why}")

    def surface(self, face, u, v):
        """Mitsuba's surface interaction at points (u, v) of faces (UInt32, Float, Float [n])."""
        n = dr.width(face)
        prelim = dr.zeros(mi.PreliminaryIntersection3f, n)
        prelim.valid = dr.full(mi.Bool, True, n)
        prelim.t = 1.0
        prelim.prim_index = dr.gather(mi.UInt32, self._prim, face)
        prelim.prim_uv = mi.Point2f(u, v)
        prelim.shape_index = dr.gather(mi.UInt32, self._shape, face)
        prelim.shape = dr.gather(mi.ShapePtr, self.tracing.shapes_dr(), prelim.shape_index)
        return prelim.compute_surface_interaction(dr.zeros(mi.Ray3f, n), mi.RayFlags.All)

    def reflectance_at(self, face, u, v, back):
        """ρ at points of faces, on the back side where ``back`` (Bool). Returns Color3f [n]."""
        si = self.surface(face, u, v)
        si.wi = mi.Vector3f(0, 0, dr.select(back, -1.0, 1.0))
        return mi.Color3f(si.bsdf().eval_diffuse_reflectance(si))

    def _read_materials(self):
        shapes, n = self.scene.shapes(), len(self.shape)
        face, third = dr.arange(mi.UInt32, n), dr.full(mi.Float, 1 / 3, n)
        si = self.surface(face, third, third)
        shading = np.array(si.sh_frame.n, dtype=np.float64).reshape(3, n).T
        self.flipped = (shading * self.normal).sum(axis=1) < 0  # against the order of the corners
        self.normal[self.flipped] *= -1
        two_sided = np.array([mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.BackSide) for s in shapes])
        textured = np.array([is_textured(s.bsdf()) for s in shapes])
        self.two_sided, self.textured = two_sided[self.shape], bool(textured.any())

        points = 16 if self.textured else 1
        rho = np.zeros((2, n, 3))
        for k in range(points):
            u, v = (
                (third, third)
                if points == 1
                else triangle(*(mi.Float(x) for x in ((k + 0.5) / points, (k * 7 % 16 + 0.5) / 16)))
            )
            for side in range(2):
                value = self.reflectance_at(
                    face, u + dr.zeros(mi.Float, n), v + dr.zeros(mi.Float, n), dr.full(mi.Bool, side == 1, n)
                )
                rho[side] += np.array(value, dtype=np.float64).reshape(3, n).T / points
        self._refuse(~np.isfinite(rho).all(axis=(0, 2)), "has a reflectance that is not a number: repair its BSDF")
        self._refuse(
            (rho >= 1).any(axis=(0, 2)),
            "has a reflectance of 1 or more, which conserves no energy: make it less than 1",
        )
        self._refuse((rho < 0).any(axis=(0, 2)), "has a negative reflectance: make it 0 or more")
        self.rho = rho  # [2 sides, faces, 3]

        originals = dr.gather(mi.ShapePtr, self.scene.shapes_dr(), dr.arange(mi.UInt32, len(shapes)))
        si = dr.zeros(mi.SurfaceInteraction3f, len(shapes))
        si.wi = mi.Vector3f(0, 0, 1)
        radiance = np.array(mi.Color3f(originals.emitter().eval(si)), dtype=np.float64).reshape(3, -1).T
        lit = np.array([s.is_emitter() for s in shapes])
        self.exitance = np.where(lit[:, None], np.pi * radiance, 0)[self.shape]  # [faces, 3]
        self._refuse(
            ~np.isfinite(self.exitance).all(axis=1) | (self.exitance < 0).any(axis=1),
            "emits a radiance that is negative or not a number: repair its emitter",
        )
        if not (self.exitance * self.area[:, None]).any():
            raise RadiosityError("the scene has no light: give at least one shape an 'area' emitter")

    def name(self, index):
        """How messages call the shape number ``index``."""
        return label(self.scene.shapes()[index], index)

    def names(self, which):
        """The shapes of faces (a mask or numbers), three of them by name."""
        names = sorted({self.name(i) for i in np.unique(self.shape[which])})
        return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def owned(kind, array):
    """A Dr.Jit array (mi.Float or mi.UInt32) with a copy of a NumPy array of one dimension.

    Without the copy Dr.Jit reads NumPy's memory, and has its alignment in the kernels.
    """
    kept = np.ascontiguousarray(array, dtype=np.float32 if kind is mi.Float else np.uint32)
    copy = dr.empty(kind, len(kept))
    if len(kept):
        dr.scatter(copy, kind(kept), dr.arange(mi.UInt32, len(kept)))
        dr.eval(copy)
    return copy


def _canonical_rank(corners):
    """Place of every face in an order that only geometry decides (int [faces]).

    Mitsuba's order of shapes varies from one process to the next. Along a Morton curve, so that
    neighbours in the order are neighbours in space; the bytes of the corners decide between equals.
    """
    centroid = corners.mean(axis=1)
    low = centroid.min(axis=0)
    # Off the borders of cells, where halves and thirds lie: rounding must not decide there.
    place = (centroid - low) / max((centroid - low).max(), np.finfo(float).tiny) * (3**0.5 - 1) + 1 - 3**0.5 / 2
    cell = (place * (2**20 - 1)).astype(np.uint64)
    morton = np.zeros(len(corners), dtype=np.uint64)
    for bit in range(20):
        for axis in range(3):
            morton |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    words = np.ascontiguousarray(corners, dtype=np.float32).reshape(len(corners), 9).view(np.uint32).astype(np.uint64)
    odd = np.uint64(0x9E3779B97F4A7C15) * (2 * np.arange(9, dtype=np.uint64) + np.uint64(1))
    rank = np.empty(len(corners), dtype=np.int64)
    rank[np.lexsort(((words * odd).sum(axis=1), morton))] = np.arange(len(corners))
    return rank
