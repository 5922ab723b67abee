"""Rays between patches: where they end, what they miss, and the kernel F along them."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, owned, owned_vectors, replaced
from ..core.points import cosine_direction
from .faces import Faces
from .hit import Hit
from .lobes import Lobes
from .lookup import Lookup
from .materials import Materials
from .patches import Patches, patch_table

EXCHANGES, SOLID, ROOM = range(3)  # sides with a patch or a traced lobe; sides without, by what they are the wall of
GAP = 1 / 256  # of the scene's diagonal: no light to speak of gets into a gap that is narrower


class Rays:
    """Visibility in a scene, in the words of its patches.

    Sides of faces are numbered 2 · face + (1 for the back). in_room: sides [2 · faces] that a room is behind, even
    where they have no patch (see `scene.solids`); by default there are none.
    """

    def __init__(
        self,
        faces: Faces,
        patches: Patches,
        materials: Materials,
        overlaps: "Lookup | None" = None,
        in_room: np.ndarray | None = None,
    ) -> None:
        self.scene, self.patches, self.albedo = faces.tracing, patches, patches.albedo
        self._materials = materials
        self.lobes = None if materials.all_plain else Lobes()
        self._first_face = faces.first_face
        self.front = owned_vectors(mi.Vector3f, faces.normal)
        table = patch_table(faces, patches)
        self._patch_of = owned(mi.UInt32, table)
        self.overlaps = overlaps
        dead = (table == NONE) & ~np.repeat(materials.traced[faces.shape], 2)
        room = dead & (False if in_room is None else in_room)
        self._kind = owned(mi.UInt32, np.where(room, ROOM, np.where(dead, SOLID, EXCHANGES)))
        self._gap = dr.opaque(mi.Float, GAP * float(np.linalg.norm(faces.high - faces.low)))
        self.has_rooms_behind_backs = bool(room.any())
        shines = np.array([part.shape.is_emitter() for part in faces.parts])[faces.shape]
        self._shines = owned(mi.UInt32, shines) if shines.any() else None

    def arrays(self) -> list[Any]:
        """What rays are traced and named with."""
        p, overlaps = self.patches, self.overlaps.arrays() if self.overlaps else []
        named = [self._first_face, self.front, self._patch_of, *self._materials.arrays(), p.emission, self.albedo]
        # Pointers tell Dr.Jit to look at all shapes and BSDFs there are, those of no scene as well.
        return [self.scene, self.scene.shapes_dr(), *named, *overlaps]

    def leave(
        self, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float", s: "mi.Float", t: "mi.Float"
    ) -> "tuple[mi.Point3f, mi.Vector3f]":
        """Origin and cosine-distributed direction of rays that leave patches at (u, v) (Point3f, Vector3f [n])."""
        p = self.patches
        return p.above(patch, u, v) + p.origin, cosine_direction(dr.gather(mi.Vector3f, p.normal, patch), s, t)

    def trace(self, origin: "mi.Point3f", direction: "mi.Vector3f", active: "mi.Bool | bool" = True) -> Hit:
        """Nearest hits of rays (Point3f, Vector3f [rays])."""
        return self.locate(self.meet(origin, direction, active), direction)

    def meet(
        self, origin: "mi.Point3f", direction: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "mi.PreliminaryIntersection3f":
        """Nearest intersections of rays (Point3f, Vector3f [rays])."""
        return self.scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), active=active)

    def seen(
        self, ray: "mi.Ray3f", active: "mi.Bool | bool" = True, lamps: bool = True
    ) -> "mi.PreliminaryIntersection3f":
        """Nearest intersections of a camera's rays, which keep together and may have an end. lamps: if False, rays pass
        through lamps that are surfaces, and have no end behind them, as Mitsuba's."""
        met = self.scene.ray_intersect_preliminary(ray, coherent=True, active=active)
        if lamps or self._shines is None:
            return met

        def on_lamp(met, ray):
            valid, face = self._face_met(met)
            if self.overlaps:  # the lamp is on top, whichever is met
                face, *_ = self.overlaps.owner(
                    face, self._from_behind(face, ray.d, valid), met.prim_uv.x, met.prim_uv.y, valid
                )
            return valid & (dr.gather(mi.UInt32, self._shines, face, valid) != 0)

        def past(met, ray):
            ray = met.compute_surface_interaction(ray, mi.RayFlags.Minimal).spawn_ray(ray.d)
            return self.scene.ray_intersect_preliminary(ray, coherent=True), ray

        return dr.while_loop((met, mi.Ray3f(ray)), on_lamp, past)[0]

    def _face_met(self, prelim):
        """Is there an intersection, and the face that it lies on (Bool, UInt32 [n])."""
        valid = prelim.is_valid()
        return valid, dr.gather(mi.UInt32, self._first_face, prelim.shape_index, valid) + prelim.prim_index

    def _from_behind(self, face, direction, valid):
        """Do rays meet the backs of faces (Bool [n])?"""
        return dr.dot(dr.gather(mi.Vector3f, self.front, face, valid), direction) > 0

    def locate(self, prelim: "mi.PreliminaryIntersection3f", direction: "mi.Vector3f") -> Hit:
        """Name the patches that intersections lie on."""
        valid, face = self._face_met(prelim)
        return self.side(face, self._from_behind(face, direction, valid), prelim.prim_uv.x, prelim.prim_uv.y, valid)

    def side(self, face: "mi.UInt32", back: "mi.Bool", u: "mi.Float", v: "mi.Float", valid: "mi.Bool") -> Hit:
        """Name the patches of points (u, v) of faces, on their backs where ``back``."""
        if self.overlaps:
            face, back, u, v = self.overlaps.owner(face, back, u, v, valid)
        side = 2 * face + dr.select(back, mi.UInt32(1), 0)
        return Hit(valid, self.patch_of(side, valid), u, v, back, valid & self._materials.is_traced(face, valid))

    def patch_of(self, side: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.UInt32":
        """The patches of sides, NONE where a side has none and where not ``active`` (UInt32 [n])."""
        return dr.select(active, dr.gather(mi.UInt32, self._patch_of, side, active), NONE)

    def side_met(
        self, origin: "mi.Point3f", direction: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "tuple[mi.UInt32, mi.Float, mi.Float]":
        """The side that each ray hits, NONE for none, and (u, v) on its face (UInt32, Float, Float [n])."""
        return self._side_at(self.meet(origin, direction, active), direction)

    def _side_at(self, prelim, direction):
        valid, face = self._face_met(prelim)
        back, u, v = self._from_behind(face, direction, valid), prelim.prim_uv.x, prelim.prim_uv.y
        if self.overlaps:
            face, back, u, v = self.overlaps.owner(face, back, u, v, valid)
        return dr.select(valid, 2 * face + dr.select(back, mi.UInt32(1), 0), NONE), u, v

    def is_traced_side(self, side: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.Bool":
        """Do sides belong to surfaces with lobes that are not diffuse (Bool [n])?"""
        return active & self._materials.has_lobes(side >> 1, active)

    def is_transmitting(self, side: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.Bool":
        """Do sides belong to surfaces that let light through: with a lobe that transmits (Bool [n])?"""
        return active & self._materials.is_transmitting(side >> 1, active)

    def is_wall_of_room(self, side: "mi.UInt32") -> "mi.Bool":
        """Are sides, NONE allowed, walls of rooms that have no patch (Bool [n])?"""
        if not self.has_rooms_behind_backs:
            return dr.full(mi.Bool, False, dr.width(side))
        return dr.gather(mi.UInt32, self._kind, side, side != NONE) == ROOM

    @property
    def side_count(self) -> int:
        """Number of sides: two of every face."""
        return dr.width(self._patch_of)

    @property
    def sides_without_patch(self) -> np.ndarray:
        """Which sides have no patch and are not traced (bool [sides])?"""
        return np.array(self._kind) != EXCHANGES

    def meets_solid(
        self,
        origin: "mi.Point3f",
        direction: "mi.Vector3f",
        active: "mi.Bool | bool" = True,
        surface: "mi.Vector3f | None" = None,
    ) -> "mi.Bool":
        """Do rays hit the inside of a solid: a side that has no patch, is not traced, and has no room behind it (see
        `scene.solids`) (Bool [n])?

        surface: unit normals of the surfaces that rays leave. Then the far side of a gap counts as well that is
        narrower than GAP and has no patch, even if a room is behind it.
        """
        prelim = self.scene.ray_intersect_preliminary(mi.Ray3f(origin, direction), active=active)
        side, _, _ = self._side_at(prelim, direction)
        valid = side != NONE
        kind = dr.gather(mi.UInt32, self._kind, side, valid)
        solid = valid & (kind == SOLID)
        if surface is None or not self.has_rooms_behind_backs:
            return solid
        return solid | (valid & (kind == ROOM) & (prelim.t * dr.dot(surface, direction) < self._gap))

    def follow(
        self,
        origin: "mi.Point3f",
        direction: "mi.Vector3f",
        number: "mi.UInt32",
        seed: "mi.UInt32",
        active: "mi.Bool | bool" = True,
    ) -> Hit:
        """Where power rays end: on the patch that they hit first, or, past surfaces that are not plainly diffuse, on
        the first one whose diffuse lobe is sampled (see `Lobes`).

        number: UInt32 [rays], seed: UInt32, what the random numbers are made from.
        """
        met = self.meet(origin, direction, active)
        hit = self.locate(met, direction)
        if self.lobes is None:
            return hit
        # Rays that go on do so side by side, and do not keep the others waiting.
        every = dr.zeros(mi.UInt32, dr.width(direction))
        states = [met, hit, mi.Point3f(origin + every), direction, number + every, seed + every]
        dr.eval(states)
        on = dr.compress(hit.traced)
        if dr.width(on) == 0:
            return hit
        met, first, origin, direction, number, seed = (dr.gather(type(x), x, on) for x in states)
        return replaced(hit, on, self.lobes.follow(self, met, first, mi.Ray3f(origin, direction), number, seed))

    def on_top(self, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float") -> "mi.Bool":
        """Does nothing lie on these points of patches (Bool [n])? What does is in their plane."""
        every = dr.full(mi.Bool, True, dr.width(u))
        if not self.overlaps:
            return every
        face, back = dr.gather(mi.UInt32, self.patches.face, patch), dr.gather(mi.Bool, self.patches.back, patch)
        owner, of_back, _, _ = self.overlaps.owner(face, back, u, v, every)
        return (owner == face) & (of_back == back)

    def blocked(self, a: "mi.Point3f", b: "mi.Point3f", active: "mi.Bool | bool" = True) -> "mi.Bool":
        """Does anything lie between points a and b, relative to the origin of the patches (Bool [n])?"""
        return self.scene.ray_test(self._between(a, b), active=active)

    def blocked_along(
        self, a: "mi.Point3f", direction: "mi.Vector3f", distance: "mi.Float", active: "mi.Bool | bool" = True
    ) -> "mi.Bool":
        """Does a shadow ray hit anything that starts at points a, relative to the origin of the patches, and runs a
        distance along unit directions (Bool [n])? An infinite distance sets no bound."""
        near = self._between(a, a + direction * distance)
        far = mi.Ray3f(a + self.patches.origin, direction)
        return self.scene.ray_test(dr.select(dr.isfinite(distance), near, far), active=active)

    def _between(self, a, b):
        """Rays from points a that end just before points b (Ray3f [n])."""
        ray = mi.Ray3f(a + self.patches.origin, b - a)
        ray.maxt = 1 - 1e-5
        return ray

    def kernel(
        self, i: "mi.UInt32", ui: "mi.Float", vi: "mi.Float", j: "mi.UInt32", uj: "mi.Float", vj: "mi.Float"
    ) -> "mi.Float":
        """F(x, y) = V(x, y) cos θ_x cos θ_y / (π r²) between points of patches, 1/m² (Float [n]).

        0 where the points see each other's back, or lie under another face.
        """
        n_i = dr.gather(mi.Vector3f, self.patches.normal, i)
        return self.kernel_at(self.patches.point(i, ui, vi), n_i, j, uj, vj, self.on_top(i, ui, vi))

    def kernel_at(
        self,
        x: "mi.Point3f",
        normal: "mi.Vector3f",
        j: "mi.UInt32",
        uj: "mi.Float",
        vj: "mi.Float",
        active: "mi.Bool | bool" = True,
    ) -> "mi.Float":
        """F(x, y) between any points x, relative to the origin, with their normals, and points of patches
        (Float [n])."""
        p = self.patches
        n_j, y = dr.gather(mi.Vector3f, p.normal, j), p.point(j, uj, vj)
        kernel = kernel_in_full_view(x, normal, y, n_j)
        faces = (kernel > 0) & active & self.on_top(j, uj, vj)
        seen = faces & ~self.blocked(x + normal * p.lift, y + n_j * p.lift, faces)
        return dr.select(seen, kernel, 0)


def kernel_in_full_view(
    x: "mi.Point3f", normal_x: "mi.Vector3f", y: "mi.Point3f", normal_y: "mi.Vector3f"
) -> "mi.Float":
    """cos θ_x cos θ_y / (π r²) between points with their normals, as unnormalised cosines over r⁴, 1/m² (Float [n])."""
    d = y - x
    r2 = dr.squared_norm(d)
    cosines = dr.maximum(dr.dot(normal_x, d), 0) * dr.maximum(-dr.dot(normal_y, d), 0)
    return dr.select(r2 > 0, (cosines / r2) / r2 * dr.inv_pi, 0)
