"""The scene as the solver sees it: oriented patches and the rays between them."""
import hashlib
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import _llvm
from ..errors import RadiosityError
from .overlap import Overlaps
from .sampling import ROUNDS, cosine_direction, kronecker, triangle
from .support import is_textured, label, require_supported
from .tessellate import disk_mesh

NONE = 0xFFFFFFFF           # "no patch", "no element", "no pair"
RAY_OFFSET = 2.0 ** -18     # of the largest coordinate: some 30 roundings of float32
FLATNESS = 1e-12            # area / longest edge² below which a face is degenerate
PROBES = 32                 # rays per side that look for light
LAMP_PROBES = 1 << 16       # rays from all lamps together


def require_variant():
    """Raise RadiosityError unless the active Mitsuba variant can run the solver."""
    variant = mi.variant() or "none"
    if not variant.startswith(("llvm_", "cuda_")) or "rgb" not in variant:
        raise RadiosityError(f"the Mitsuba variant '{variant}' cannot be used: choose llvm_ad_rgb or cuda_ad_rgb "
                             "with mi.set_variant(...) or -m")
    if variant.startswith("llvm_") and (problem := _llvm.problem()):
        raise RadiosityError(problem)


@dataclass
class Hit:
    """Where rays end. patch is NONE on the sides of faces that take no part in light transport."""
    valid: "mi.Bool"        # [rays] something was hit
    patch: "mi.UInt32"      # [rays]
    u: "mi.Float"           # [rays] barycentric coordinates on the face
    v: "mi.Float"


class Model:
    """Oriented patches of a Mitsuba scene and visibility between them.

    A patch is one side of one face that light can reach: the front (where the shading normal
    points), and the back where the BSDF is two-sided. A point of a patch is p₀ + u e₁ + v e₂,
    relative to the centre of the scene, and (u, v) are the barycentric coordinates Mitsuba uses.

    Attributes, all Dr.Jit arrays over patches: ``p0`` (Point3f), ``e1``, ``e2``, ``normal``
    (Vector3f, unit, towards the side), ``area`` (Float), ``reflectance`` ρ (Color3f, mean over the
    patch) and ``emission`` E = π L_e (Color3f, W/m²).

    Raises RadiosityError for whatever is not modelled, naming the shape.
    Lengths are scene units, called metres throughout.
    """

    def __init__(self, scene):
        require_variant()
        require_supported(scene)
        self.scene = scene
        self.warnings = []
        shapes = scene.shapes()
        if not shapes:
            raise RadiosityError("the scene has no shapes: nothing can be lit")
        self.tracing = self._tracing_scene(scene)
        self._read_faces(shapes)
        self._read_materials(shapes)
        self._find_overlaps()
        self._choose_sides()
        self.fingerprint = self._fingerprint()

    # ---- Reading the scene ---------------------------------------------------------------------

    @staticmethod
    def _tracing_scene(scene):
        """The scene itself, or one in which every shape is a mesh."""
        shapes = scene.shapes()
        if all(isinstance(shape, mi.Mesh) for shape in shapes):
            return scene
        meshes = [s if isinstance(s, mi.Mesh) else disk_mesh(s) for s in shapes]
        return mi.load_dict({"type": "scene"} | {f"shape_{i}": m for i, m in enumerate(meshes)}, optimize=False)

    def _read_faces(self, shapes):
        corners, counts = [], []
        for mesh in self.tracing.shapes():
            positions = np.array(mesh.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
            faces = np.array(mesh.faces_buffer()).reshape(-1, 3)
            corners.append(positions[faces])
            counts.append(len(faces))
        self.face_shape = np.repeat(np.arange(len(counts)), counts)             # [faces]
        corners = np.concatenate(corners)                                       # [faces, 3, 3]
        if not len(corners):
            raise RadiosityError("the scene has no faces: nothing can be lit")
        self._refuse(~np.isfinite(corners).all(axis=(1, 2)), shapes, "has vertices that are not finite numbers: repair the mesh")

        self.corners = corners
        self.centre = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
        self._rank = _canonical_rank(corners)
        self.offset = RAY_OFFSET * max(np.abs(corners).max(), np.finfo(np.float32).tiny)
        e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        cross = np.cross(e1, e2)
        double_area = np.linalg.norm(cross, axis=1)
        longest = np.maximum.reduce([(e ** 2).sum(axis=1) for e in (e1, e2, e2 - e1)])
        self.degenerate = double_area <= FLATNESS * longest
        if self.degenerate.any():
            names = sorted({label(shapes[i], i) for i in self.face_shape[self.degenerate]})
            self.warnings.append(f"{int(self.degenerate.sum())} faces without area are left out, in {_some(names)}")
        self._e1, self._e2 = e1, e2
        self._area = double_area / 2
        self._normal = cross / np.where(self.degenerate, 1, double_area)[:, None]
        self.first_face = owned(mi.UInt32, np.concatenate([[0], np.cumsum(counts)[:-1]]))
        self._face_prim = (np.arange(len(corners)) - np.repeat(np.cumsum(counts) - counts, counts))

    def _refuse(self, bad, shapes, why):
        """Raise RadiosityError naming the shape of the first face in ``bad`` (bool [faces])."""
        if bad.any():
            index = self.face_shape[np.argmax(bad)]
            raise RadiosityError(f"{label(shapes[index], index)} {why}")

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

    def _read_materials(self, shapes):
        self._prim = owned(mi.UInt32, self._face_prim)
        self._shape = owned(mi.UInt32, self.face_shape)
        n = len(self.face_shape)
        face, third = dr.arange(mi.UInt32, n), dr.full(mi.Float, 1 / 3, n)
        si = self.surface(face, third, third)
        shading = np.array(si.sh_frame.n, dtype=np.float64).reshape(3, n).T
        self._flipped = (shading * self._normal).sum(axis=1) < 0
        two_sided = np.array([mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.BackSide) for s in shapes])
        textured = np.array([is_textured(s.bsdf()) for s in shapes])
        self.two_sided, self.textured = two_sided[self.face_shape], bool(textured.any())

        points = 16 if self.textured else 1
        rho = np.zeros((2, n, 3))
        for k in range(points):
            u, v = (third, third) if points == 1 else triangle(*(mi.Float(x) for x in ((k + .5) / points, (k * 7 % 16 + .5) / 16)))
            for side in range(2):
                value = self.reflectance_at(face, u + dr.zeros(mi.Float, n), v + dr.zeros(mi.Float, n), dr.full(mi.Bool, side == 1, n))
                rho[side] += np.array(value, dtype=np.float64).reshape(3, n).T / points
        self._refuse(~np.isfinite(rho).all(axis=(0, 2)), shapes, "has a reflectance that is not a number: repair its BSDF")
        self._refuse((rho >= 1).any(axis=(0, 2)), shapes, "has a reflectance of 1 or more, which conserves no energy: make it less than 1")
        self._refuse((rho < 0).any(axis=(0, 2)), shapes, "has a negative reflectance: make it 0 or more")
        self._rho = rho                                                         # [2 sides, faces, 3]

        originals = dr.gather(mi.ShapePtr, self.scene.shapes_dr(), dr.arange(mi.UInt32, len(shapes)))
        si = dr.zeros(mi.SurfaceInteraction3f, len(shapes))
        si.wi = mi.Vector3f(0, 0, 1)
        radiance = np.array(mi.Color3f(originals.emitter().eval(si)), dtype=np.float64).reshape(3, -1).T
        lit = np.array([s.is_emitter() for s in shapes])
        self._exitance = np.where(lit[:, None], np.pi * radiance, 0)[self.face_shape]       # [faces, 3]
        self._refuse(~np.isfinite(self._exitance).all(axis=1) | (self._exitance < 0).any(axis=1), shapes,
                     "emits a radiance that is negative or not a number: repair its emitter")
        if not (self._exitance * self._area[:, None]).any():
            raise RadiosityError("the scene has no light: give at least one shape an 'area' emitter")

    def _find_overlaps(self):
        """Faces in one another: one of them is lit and shown wherever several are."""
        sound = ~self.degenerate
        front = self._normal * np.where(self._flipped, -1.0, 1.0)[:, None]
        self._candidate = np.column_stack([sound, sound & self.two_sided])      # [faces, front and back]
        exitance = self._exitance.sum(axis=1)
        self.overlaps = Overlaps(self.corners, front, self._area, sound, self._rank, self._candidate, np.column_stack([exitance, 0 * exitance]),
                                 self._rho.sum(axis=2).T, self.offset)
        self._candidate &= ~self.overlaps.covered
        if self.overlaps:
            self.overlaps.prepare(owned, self.centre)

    def _settle_overlaps(self):
        """Keep what patches need of the overlaps, and tell the user what was decided."""
        if not self.overlaps:
            return
        faces = self.overlaps.keep(2 * self._faces + self.sides % 2)
        self.overlaps.prepare(owned, self.centre)
        if len(faces):
            names = sorted({label(self.scene.shapes()[i], i) for i in self.face_shape[faces]})
            self.warnings.append(f"{len(faces)} faces lie in others, in {_some(names)}: where they do, a lamp or else the smaller surface is taken to be on top")

    # ---- Patches -------------------------------------------------------------------------------

    def _choose_sides(self):
        """Make patches of the sides that light can reach: model only what a scene needs."""
        sides = np.flatnonzero(self._candidate)         # front and back in turn
        self.use_sides(np.sort(2 * self._rank[sides // 2] + sides % 2))
        reached = self._reached()
        self.use_sides(self.sides[reached])
        self.unreached = int((~reached).sum())
        self._settle_overlaps()

    def use_sides(self, sides):
        """Patches are the given sides (int [patches]): 2 · the face's rank + (1 for the back)."""
        self.sides = sides
        face, back = np.argsort(self._rank)[sides // 2], sides % 2
        sign = np.where(self._flipped[face] ^ (back == 1), -1.0, 1.0)
        table = np.full(2 * len(self.face_shape), NONE, dtype=np.uint32)
        table[2 * face + back] = np.arange(len(sides))
        def vector(kind, a): return kind(*(owned(mi.Float, a[:, k]) for k in range(3)))
        self.count, self._faces = len(sides), face
        self.face = owned(mi.UInt32, face)
        self.back = owned(mi.UInt32, back) == 1
        self.p0 = vector(mi.Point3f, (self.corners[:, 0] - self.centre)[face])
        self.e1, self.e2 = vector(mi.Vector3f, self._e1[face]), vector(mi.Vector3f, self._e2[face])
        self.normal = vector(mi.Vector3f, self._normal[face] * sign[:, None])
        self.area = owned(mi.Float, self._area[face])
        self.total_area = float(self._area[face].sum())
        self.reflectance = vector(mi.Color3f, self._rho[back, face])
        self.emission = vector(mi.Color3f, np.where((back == 0)[:, None], self._exitance[face], 0))
        self._side_patch = owned(mi.UInt32, table)
        self._front = vector(mi.Vector3f, self._normal * np.where(self._flipped, -1.0, 1.0)[:, None])
        self.origin = mi.Point3f(*(dr.opaque(mi.Float, c) for c in self.centre))
        self._lift = dr.opaque(mi.Float, self.offset)

    def _reached(self):
        """Which patches exchange light, directly or over others, with a lamp (bool [patches])?

        Every patch casts PROBES rays and the lamps LAMP_PROBES; light spreads along them, in both
        directions, until nothing new is reached. As rays hardly find lamps that are small or seen at
        a grazing angle, every patch draws PROBES lines to lamps as well.
        """
        n = self.count
        emits = np.array(dr.max(self.emission) > 0).astype(bool)
        def cast(patch, index):
            u, v, s, t = kronecker(index, patch, dr.opaque(mi.UInt32, 0))
            hit = self.trace(*self.leave(patch, *triangle(u, v), s, t))
            return np.array(dr.select(hit.valid, hit.patch, NONE))

        index = dr.arange(mi.UInt32, n * PROBES)
        source = np.repeat(np.arange(n), PROBES)
        target = cast(index // PROBES, index % PROBES)
        if emits.any():
            lamps = np.flatnonzero(emits)
            each = -(-LAMP_PROBES // len(lamps))
            more = np.repeat(lamps, each)
            source = np.concatenate([source, more])
            number = owned(mi.UInt32, np.tile(np.arange(each), len(lamps)))
            target = np.concatenate([target, cast(owned(mi.UInt32, more), number)])
            patch, line = index // PROBES, index % PROBES
            lamp = dr.gather(mi.UInt32, owned(mi.UInt32, lamps), mi.sample_tea_32(index, 0, ROUNDS)[0] % dr.opaque(mi.UInt32, len(lamps)))
            x0, x1, y0, y1 = kronecker(line, patch, dr.opaque(mi.UInt32, 1))
            sees = np.array(self._connected(patch, *triangle(x0, x1), lamp, *triangle(y0, y1))).astype(bool)
            source, target = np.concatenate([source, np.array(lamp)[sees]]), np.concatenate([target, np.array(patch)[sees]])
        source, target = source[target != NONE], target[target != NONE]
        reached, before = emits, 0
        while reached.sum() > before:
            before = reached.sum()
            reached[target[reached[source]]] = True
            reached[source[reached[target]]] = True
        return reached

    def _fingerprint(self):
        """SHA-256 of geometry, orientation, reflectance and emission."""
        digest = hashlib.sha256()
        order = np.argsort(self._rank)
        for array in (self.corners, self._flipped, self.two_sided, np.round(self._rho, 4).swapaxes(0, 1) + 0, self._exitance):
            digest.update(np.ascontiguousarray(array[order], dtype=np.float32).tobytes())
        return digest.hexdigest()

    def shape_of(self, patch):
        """How messages call the shape that patch number ``patch`` belongs to."""
        index = self.face_shape[self._faces[patch]]
        return label(self.scene.shapes()[index], index)

    # ---- Rays ----------------------------------------------------------------------------------

    def point(self, patch, u, v):
        """Points of patches relative to the scene's centre (Point3f [n])."""
        return (dr.gather(mi.Point3f, self.p0, patch) + dr.gather(mi.Vector3f, self.e1, patch) * u
                + dr.gather(mi.Vector3f, self.e2, patch) * v)

    def corner(self, k):
        """Corner k of all patches where the file has it, to the bit (Point3f [patches])."""
        corner = self.corners[self._faces, k].astype(np.float32)
        return mi.Point3f(*(owned(mi.Float, x) for x in corner.T))

    def leave(self, patch, u, v, s, t):
        """Origin and cosine-distributed direction of rays that leave patches at (u, v)."""
        normal = dr.gather(mi.Vector3f, self.normal, patch)
        origin = self.point(patch, u, v) + self.origin + normal * self._lift
        return origin, cosine_direction(normal, s, t)

    def trace(self, origin, direction, active=True):
        """Nearest hits of rays (Point3f, Vector3f [rays])."""
        prelim = self.tracing.ray_intersect_preliminary(mi.Ray3f(origin, direction), active=active)
        return self.locate(prelim, direction)

    def locate(self, prelim, direction):
        """Name the patches that intersections lie on."""
        valid = prelim.is_valid()
        face = dr.gather(mi.UInt32, self.first_face, prelim.shape_index, valid) + prelim.prim_index
        back = dr.dot(dr.gather(mi.Vector3f, self._front, face, valid), direction) > 0
        u, v = prelim.prim_uv.x, prelim.prim_uv.y
        if self.overlaps:
            face, back, u, v = self.overlaps.owner(face, back, u, v, valid)
        patch = dr.gather(mi.UInt32, self._side_patch, 2 * face + dr.select(back, mi.UInt32(1), 0), valid)
        return Hit(valid, dr.select(valid, patch, NONE), u, v)

    def blocked(self, ray, active):
        """Does anything lie on the segments ``ray`` (Bool [n])?"""
        return self.tracing.ray_test(ray, active=active)

    def kernel(self, i, ui, vi, j, uj, vj):
        """F(x, y) = V(x, y) cos θ_x cos θ_y / (π r²) between points of patches, 1/m² (Float [n]).

        Evaluated as unnormalised cosines over r⁴, and 0 where the points see each other's back.
        """
        n_i, n_j = dr.gather(mi.Vector3f, self.normal, i), dr.gather(mi.Vector3f, self.normal, j)
        x, y = self.point(i, ui, vi), self.point(j, uj, vj)
        d = y - x
        r2 = dr.squared_norm(d)
        cosines = dr.maximum(dr.dot(n_i, d), 0) * dr.maximum(-dr.dot(n_j, d), 0)
        faces = (cosines > 0) & (r2 > 0)
        start = x + n_i * self._lift
        ray = mi.Ray3f(start + self.origin, (y + n_j * self._lift) - start)
        ray.maxt = 1 - 1e-5
        seen = faces & ~self.blocked(ray, faces)
        return dr.select(seen, (cosines / r2) / r2 * dr.inv_pi, 0)


    def _connected(self, i, ui, vi, j, uj, vj):
        """Do points of patches see each other, each more than rounding above the plane of the other (Bool [n])?"""
        d = self.point(j, uj, vj) - self.point(i, ui, vi)
        above = (dr.dot(dr.gather(mi.Vector3f, self.normal, i), d) > self._lift) & (-dr.dot(dr.gather(mi.Vector3f, self.normal, j), d) > self._lift)
        return above & (self.kernel(i, ui, vi, j, uj, vj) > 0)


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


def _some(names):
    """Up to three names, and how many more there are."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def _canonical_rank(corners):
    """Place of every face in an order that only geometry decides (int [faces]).

    Mitsuba's order of shapes varies from one process to the next. Along a Morton curve, so that
    neighbours in the order are neighbours in space; the bytes of the corners decide between equals.
    """
    centroid = corners.mean(axis=1)
    low = centroid.min(axis=0)
    # Off the borders of cells, where halves and thirds lie: rounding must not decide there.
    place = (centroid - low) / max((centroid - low).max(), np.finfo(float).tiny) * (3 ** .5 - 1) + 1 - 3 ** .5 / 2
    cell = (place * (2 ** 20 - 1)).astype(np.uint64)
    morton = np.zeros(len(corners), dtype=np.uint64)
    for bit in range(20):
        for axis in range(3):
            morton |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    words = np.ascontiguousarray(corners, dtype=np.float32).reshape(len(corners), 9).view(np.uint32).astype(np.uint64)
    odd = np.uint64(0x9E3779B97F4A7C15) * (2 * np.arange(9, dtype=np.uint64) + np.uint64(1))
    rank = np.empty(len(corners), dtype=np.int64)
    rank[np.lexsort(((words * odd).sum(axis=1), morton))] = np.arange(len(corners))
    return rank
