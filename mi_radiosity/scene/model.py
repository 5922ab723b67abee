"""The scene as the solver sees it: oriented patches and the rays between them."""

import hashlib
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import llvm as _llvm
from ..core.errors import RadiosityError
from .faces import Faces, owned
from .overlap import Overlaps
from ..core.points import ROUNDS, cosine_direction, kronecker, triangle
from .support import require_supported

NONE = 0xFFFFFFFF  # "no patch", "no element", "no pair"
RAY_OFFSET = 2.0**-18  # of the largest coordinate: some 30 roundings of float32
PROBES = 32  # rays per side that look for light
LAMP_PROBES = 1 << 16  # rays from all lamps together


def require_variant():
    """Raise RadiosityError unless the active Mitsuba variant can run the solver."""
    variant = mi.variant() or "none"
    if not variant.startswith(("llvm_", "cuda_")) or "rgb" not in variant:
        raise RadiosityError(
            f"the Mitsuba variant '{variant}' cannot be used: choose llvm_ad_rgb or cuda_ad_rgb "
            "with mi.set_variant(...) or -m"
        )
    if variant.startswith("llvm_") and (problem := _llvm.problem()):
        raise RadiosityError(problem)


@dataclass
class Hit:
    """Where rays end. patch is NONE on the sides of faces that take no part in light transport."""

    valid: "mi.Bool"  # [rays] something was hit
    patch: "mi.UInt32"  # [rays]
    u: "mi.Float"  # [rays] barycentric coordinates on the face
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
        self.scene, self.faces = scene, Faces(scene)
        corners = self.faces.corners
        self.tracing, self.warnings, self.textured = self.faces.tracing, self.faces.warnings, self.faces.textured
        self.centre = (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1))) / 2
        self.offset = RAY_OFFSET * max(np.abs(corners).max(), np.finfo(np.float32).tiny)
        self._find_overlaps()
        self._choose_sides()
        self.fingerprint = self._fingerprint()

    def _find_overlaps(self):
        """Faces in one another: one of them is lit and shown wherever several are."""
        f = self.faces
        sound, exitance = ~f.degenerate, f.exitance.sum(axis=1)
        self._candidate = np.column_stack([sound, sound & f.two_sided])  # [faces, front and back]
        self.overlaps = Overlaps(
            f.corners,
            f.normal,
            f.area,
            sound,
            f.rank,
            self._candidate,
            np.column_stack([exitance, 0 * exitance]),
            f.rho.sum(axis=2).T,
            self.offset,
        )
        self._candidate &= ~self.overlaps.covered
        if self.overlaps:
            self.overlaps.prepare(owned, self.centre)

    def _settle_overlaps(self):
        """Keep what patches need of the overlaps, and tell the user what was decided."""
        if not self.overlaps:
            return
        doubled = self.overlaps.keep(2 * self._faces + self.sides % 2)
        self.overlaps.prepare(owned, self.centre)
        if len(doubled):
            self.warnings.append(
                f"{len(doubled)} faces lie in others, in {self.faces.names(doubled)}: where they do, a lamp or else the smaller surface is taken to be on top"
            )

    # ---- Patches -------------------------------------------------------------------------------

    def _choose_sides(self):
        """Make patches of the sides that light can reach: model only what a scene needs."""
        sides = np.flatnonzero(self._candidate)  # front and back in turn
        self.use_sides(np.sort(2 * self.faces.rank[sides // 2] + sides % 2))
        reached = self._reached()
        self.use_sides(self.sides[reached])
        self.unreached = int((~reached).sum())
        self._settle_overlaps()

    def use_sides(self, sides):
        """Patches are the given sides (int [patches]): 2 · the face's rank + (1 for the back)."""
        self.sides = sides
        face, back = np.argsort(self.faces.rank)[sides // 2], sides % 2
        sign = np.where(back == 1, -1.0, 1.0)
        table = np.full(2 * len(self.faces.shape), NONE, dtype=np.uint32)
        table[2 * face + back] = np.arange(len(sides))

        def vector(kind, a):
            return kind(*(owned(mi.Float, a[:, k]) for k in range(3)))

        self.count, self._faces = len(sides), face
        self.face = owned(mi.UInt32, face)
        self.back = owned(mi.UInt32, back) == 1
        self.p0 = vector(mi.Point3f, (self.faces.corners[:, 0] - self.centre)[face])
        self.e1, self.e2 = vector(mi.Vector3f, self.faces.e1[face]), vector(mi.Vector3f, self.faces.e2[face])
        self.normal = vector(mi.Vector3f, self.faces.normal[face] * sign[:, None])
        self.area = owned(mi.Float, self.faces.area[face])
        self.total_area = float(self.faces.area[face].sum())
        self.reflectance = vector(mi.Color3f, self.faces.rho[back, face])
        self.emission = vector(mi.Color3f, np.where((back == 0)[:, None], self.faces.exitance[face], 0))
        self._side_patch = owned(mi.UInt32, table)
        self._front = vector(mi.Vector3f, self.faces.normal)
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
            lamp = dr.gather(
                mi.UInt32,
                owned(mi.UInt32, lamps),
                mi.sample_tea_32(index, 0, ROUNDS)[0] % dr.opaque(mi.UInt32, len(lamps)),
            )
            x0, x1, y0, y1 = kronecker(line, patch, dr.opaque(mi.UInt32, 1))
            sees = np.array(self._connected(patch, *triangle(x0, x1), lamp, *triangle(y0, y1))).astype(bool)
            source, target = (
                np.concatenate([source, np.array(lamp)[sees]]),
                np.concatenate([target, np.array(patch)[sees]]),
            )
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
        f = self.faces
        order = np.argsort(f.rank)
        for array in (f.corners, f.flipped, f.two_sided, np.round(f.rho, 4).swapaxes(0, 1) + 0, f.exitance):
            digest.update(np.ascontiguousarray(array[order], dtype=np.float32).tobytes())
        return digest.hexdigest()

    # ---- Rays ----------------------------------------------------------------------------------

    def point(self, patch, u, v):
        """Points of patches relative to the scene's centre (Point3f [n])."""
        return (
            dr.gather(mi.Point3f, self.p0, patch)
            + dr.gather(mi.Vector3f, self.e1, patch) * u
            + dr.gather(mi.Vector3f, self.e2, patch) * v
        )

    def above(self, patch, u, v):
        """Points of patches, lifted off them by the rounding of rays (Point3f [n])."""
        return mi.Point3f(self.point(patch, u, v) + dr.gather(mi.Vector3f, self.normal, patch) * self._lift)

    def corner(self, k):
        """Corner k of all patches where the file has it, to the bit (Point3f [patches])."""
        corner = self.faces.corners[self._faces, k].astype(np.float32)
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
        face = dr.gather(mi.UInt32, self.faces.first_face, prelim.shape_index, valid) + prelim.prim_index
        back = dr.dot(dr.gather(mi.Vector3f, self._front, face, valid), direction) > 0
        u, v = prelim.prim_uv.x, prelim.prim_uv.y
        if self.overlaps:
            face, back, u, v = self.overlaps.owner(face, back, u, v, valid)
        patch = dr.gather(mi.UInt32, self._side_patch, 2 * face + dr.select(back, mi.UInt32(1), 0), valid)
        return Hit(valid, dr.select(valid, patch, NONE), u, v)

    def owns(self, patch, u, v):
        """Do points of patches belong to them, not to faces that lie on them (Bool [n])?"""
        if not self.overlaps:
            return dr.full(mi.Bool, True, dr.width(u))
        face, back = dr.gather(mi.UInt32, self.face, patch), dr.gather(mi.Bool, self.back, patch)
        owner, of_back, _, _ = self.overlaps.owner(face, back, u, v, dr.full(mi.Bool, True, dr.width(u)))
        return (owner == face) & (of_back == back)

    def blocked(self, a, b, active):
        """Does anything lie between points a and b, relative to the scene's centre (Bool [n])?"""
        ray = mi.Ray3f(a + self.origin, b - a)
        ray.maxt = 1 - 1e-5
        return self.tracing.ray_test(ray, active=active)

    def walled(self, patch, ua, va, ub, vb, active=True):
        """Does anything stand on the line from (ua, va) to (ub, vb) of patches (Bool [n])?"""
        return self.blocked(self.above(patch, ua, va), self.above(patch, ub, vb), active)

    def kernel(self, i, ui, vi, j, uj, vj):
        """F(x, y) = V(x, y) cos θ_x cos θ_y / (π r²) between points of patches, 1/m² (Float [n]).

        Evaluated as unnormalised cosines over r⁴; 0 where the points see each other's back, or lie
        under another face.
        """
        n_i, n_j = dr.gather(mi.Vector3f, self.normal, i), dr.gather(mi.Vector3f, self.normal, j)
        x, y = self.point(i, ui, vi), self.point(j, uj, vj)
        d = y - x
        r2 = dr.squared_norm(d)
        cosines = dr.maximum(dr.dot(n_i, d), 0) * dr.maximum(-dr.dot(n_j, d), 0)
        faces = (cosines > 0) & (r2 > 0) & self.owns(i, ui, vi) & self.owns(j, uj, vj)
        seen = faces & ~self.blocked(x + n_i * self._lift, y + n_j * self._lift, faces)
        return dr.select(seen, (cosines / r2) / r2 * dr.inv_pi, 0)

    def _connected(self, i, ui, vi, j, uj, vj):
        """Do points of patches see each other, each more than rounding above the plane of the other (Bool [n])?"""
        d = self.point(j, uj, vj) - self.point(i, ui, vi)
        above = (dr.dot(dr.gather(mi.Vector3f, self.normal, i), d) > self._lift) & (
            -dr.dot(dr.gather(mi.Vector3f, self.normal, j), d) > self._lift
        )
        return above & (self.kernel(i, ui, vi, j, uj, vj) > 0)
