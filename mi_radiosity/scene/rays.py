"""Rays between patches: where they end, what they miss, and the kernel F along them."""

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, owned, owned_vectors
from ..core.points import cosine_direction
from .faces import Faces
from .hit import Hit, Trail
from .lobes import Lobes
from .lookup import Lookup
from .materials import Materials
from .patches import Patches, patch_table


class Rays:
    """Visibility in a scene, in the words of its patches."""

    def __init__(self, faces: Faces, patches: Patches, materials: Materials, overlaps: "Lookup | None" = None) -> None:
        self.scene, self.patches, self.albedo = faces.tracing, patches, patches.albedo
        self._materials = materials
        self.lobes, self.glossy = Lobes() if materials.traced.any() else None, materials.glossy
        self._first_face = faces.first_face
        self.front = owned_vectors(mi.Vector3f, faces.normal)
        self._patch_of = patch_table(faces, patches)
        self.overlaps = overlaps
        shines = np.array([part.shape.is_emitter() for part in faces.parts])[faces.shape]
        self._shines = owned(mi.UInt32, shines) if shines.any() else None

    def arrays(self) -> list[Any]:
        """What rays are traced and named with."""
        p, overlaps = self.patches, self.overlaps.arrays() if self.overlaps else []
        named = [self._first_face, self.front, self._patch_of, self._materials.traced_faces, p.emission, self.albedo]
        # Pointers tell Dr.Jit to look at all shapes and BSDFs there are, those of no scene as well.
        return [self.scene, self.scene.shapes_dr(), self._materials.bsdfs, *named, *overlaps]

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
        patch = dr.gather(mi.UInt32, self._patch_of, 2 * face + dr.select(back, mi.UInt32(1), 0), valid)
        traced = valid & self._materials.is_traced(face, valid)
        return Hit(valid, dr.select(valid, patch, NONE), u, v, back, traced)

    def follow(
        self,
        origin: "mi.Point3f",
        direction: "mi.Vector3f",
        number: "mi.UInt32",
        seed: "mi.UInt32",
        power: bool = False,
        camera: bool = False,
        active: "mi.Bool | bool" = True,
        highlights: Any = None,
        first: "Sequence[mi.Float]" = (),
        met: "mi.PreliminaryIntersection3f | None" = None,
    ) -> Hit | Trail:
        """Where rays end that go on through lobes that are not diffuse: a Trail, or a Hit in scenes without such.

        number: UInt32 [rays], what their chances are drawn by. power: they carry it, and do not look for light.
        camera: they look for light, and the first surface's own counts. highlights, first: see `Lobes.follow`. met: the
        first intersections, if they are known.
        """
        if met is None:
            met = self.meet(origin, direction, active)
        hit = self.locate(met, direction)
        if self.lobes is None:
            return hit
        # Those that go on do so side by side, and do not keep the others waiting.
        every = dr.zeros(mi.UInt32, dr.width(direction))
        states = [met, hit, mi.Point3f(origin + every), direction, number + every, seed + every, *first]
        dr.eval(states)
        on = dr.compress(hit.traced)
        end = Trail.straight(hit, direction)
        if dr.width(on) == 0:
            return end
        met, hit, origin, direction, number, seed, *first = (dr.gather(type(x), x, on) for x in states)
        mode, ray = mi.TransportMode.Importance if power else mi.TransportMode.Radiance, mi.Ray3f(origin, direction)
        followed = self.lobes.follow(self, met, hit, ray, number, seed, mode, camera, highlights, first)
        return end.replaced(on, followed)

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
        ray = mi.Ray3f(a + self.patches.origin, b - a)
        ray.maxt = 1 - 1e-5
        return self.scene.ray_test(ray, active=active)

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
