"""The table of patches: oriented sides of faces."""

from dataclasses import dataclass, replace
from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, owned, owned_vectors
from .faces import Faces
from .lights import Lights
from .materials import Materials

CORNERS = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))


@dataclass(frozen=True)
class Patches:
    """One row per patch: a side of a face that light can reach, the front (where the shading normal points) or the
    back, where the BSDF is two-sided. Dr.Jit arrays [patches]; lengths are scene units, called metres throughout.

    A point of a patch is p₀ + u e₁ + v e₂, relative to the ``origin`` of all points (the centre of the scene, for
    the sake of float32); (u, v) are the barycentric coordinates Mitsuba uses.
    """

    count: int
    sides: np.ndarray  # 2 · the face's rank + (1 for the back): names a patch whatever Mitsuba's order of shapes
    face: "mi.UInt32"
    back: "mi.Bool"
    p0: "mi.Point3f"
    e1: "mi.Vector3f"
    e2: "mi.Vector3f"
    normal: "mi.Vector3f"  # unit, towards the side
    area: "mi.Float"  # m²
    reflectance: "mi.Color3f"  # ρ, mean over the patch
    # τ, the share of the irradiance that leaves diffusely from the other side of the face; None if no face transmits
    transmittance: "mi.Color3f | None"
    emission: "mi.Color3f"  # E = π L_e, W/m²
    origin: "mi.Point3f"
    lift: "mi.Float"  # by which rays start off a surface, m
    corners: list  # three Point3f where the file has them, to the bit

    def point(self, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float") -> "mi.Point3f":
        """Points of patches, relative to the origin (Point3f [n])."""
        along, across = dr.gather(mi.Vector3f, self.e1, patch), dr.gather(mi.Vector3f, self.e2, patch)
        return dr.gather(mi.Point3f, self.p0, patch) + along * u + across * v

    def above(self, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float") -> "mi.Point3f":
        """Points of patches, lifted off them by the rounding of rays (Point3f [n])."""
        return mi.Point3f(self.point(patch, u, v) + dr.gather(mi.Vector3f, self.normal, patch) * self.lift)

    def only(self, rows: np.ndarray) -> "Patches":
        """Some of them (int [patches])."""
        chosen = owned(mi.UInt32, rows)

        def pick(column):
            return dr.gather(type(column), column, chosen)

        columns = ("face", "back", "p0", "e1", "e2", "normal", "area", "reflectance", "emission", "transmittance")
        known = {name: getattr(self, name) for name in columns}
        picked: dict = {name: pick(column) for name, column in known.items() if column is not None}
        picked["corners"] = [pick(corner) for corner in self.corners]
        dr.eval(picked)
        return replace(self, count=len(rows), sides=self.sides[rows], **picked)

    @cached_property
    def albedo(self) -> "mi.Color3f":
        """ρ + τ, the share of the irradiance that leaves diffusely on either side of the face (Color3f [patches])."""
        if self.transmittance is None:
            return self.reflectance
        albedo = self.reflectance + self.transmittance
        dr.eval(albedo)
        return albedo

    @cached_property
    def twin(self) -> "np.ndarray | None":
        """The patch on the other side of each face that transmits diffusely, NONE for the others (int [patches]); None
        if no patch has such a twin."""
        if self.transmittance is None:
            return None
        row = np.full(2 * (int(self.sides.max()) // 2) + 2, -1)
        row[self.sides] = np.arange(self.count)
        other, tau = row[self.sides ^ 1], np.array(self.transmittance).reshape(3, -1)
        transmits = tau.max(axis=0) > 0
        there = (other >= 0) & (transmits | transmits[other])
        return np.where(there, other, NONE) if there.any() else None

    @cached_property
    def _twins(self):
        """`twin` on the device."""
        return owned(mi.UInt32, self.twin)

    def behind(
        self, patch: "mi.UInt32", active: "mi.Bool | bool" = True
    ) -> "tuple[mi.UInt32, mi.Color3f, mi.Bool] | None":
        """What transmits light to patches: the twin of each patch, τ of the twin, and whether there is a twin (UInt32,
        Color3f, Bool [n]); None if no patch has a twin."""
        if self.twin is None:
            return None
        twin = dr.gather(mi.UInt32, self._twins, patch, active)
        there = active & (twin != NONE)
        twin = dr.select(there, twin, 0)
        return twin, dr.gather(mi.Color3f, self.transmittance, twin, there), there

    @cached_property
    def total_area(self) -> float:
        """Of all patches, m²."""
        return float(np.array(self.area).sum(dtype=np.float64))


def make_patches(faces: Faces, materials: Materials, lights: Lights, sides: np.ndarray) -> Patches:
    """Patches of the given sides (int [patches]): 2 · the face's rank + (1 for the back)."""
    face, back = faces.order[sides // 2], sides % 2
    sign, emits = np.where(back == 1, -1.0, 1.0)[:, None], (back == 0)[:, None]
    corners = faces.corners[face]
    return Patches(
        count=len(sides),
        sides=sides,
        face=owned(mi.UInt32, face),
        back=owned(mi.UInt32, back) == 1,
        p0=owned_vectors(mi.Point3f, corners[:, 0] - faces.centre),
        e1=owned_vectors(mi.Vector3f, faces.e1[face]),
        e2=owned_vectors(mi.Vector3f, faces.e2[face]),
        normal=owned_vectors(mi.Vector3f, faces.normal[face] * sign),
        area=owned(mi.Float, faces.area[face]),
        reflectance=owned_vectors(mi.Color3f, materials.rho[back, face]),
        transmittance=owned_vectors(mi.Color3f, materials.tau[back, face]) if materials.transmits.any() else None,
        emission=owned_vectors(mi.Color3f, np.where(emits, lights.exitance[face], 0)),
        origin=mi.Point3f(*(dr.opaque(mi.Float, c) for c in faces.centre)),
        lift=dr.opaque(mi.Float, faces.lift),
        corners=[owned_vectors(mi.Point3f, corners[:, k].astype(np.float32)) for k in range(3)],
    )


def patch_table(faces: Faces, patches: Patches) -> np.ndarray:
    """The patch of every side 2 · face + (1 for the back), NONE where there is none (uint32 [2 · faces])."""
    face, back = faces.order[patches.sides // 2], patches.sides % 2
    table = np.full(2 * len(faces), NONE, dtype=np.uint32)
    table[2 * face + back] = np.arange(patches.count)
    return table
