"""What of a surface is hidden, and which of its points see each other."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import opaque_index, owned, owned_vectors
from ..core.points import cosine_direction, kronecker
from ..scene import Model

LOOKS = 16  # rays per point
ENCLOSED = 1 / 2  # of the rays hit the inside of a solid: others hit a floor inside of it, of a point above that floor
POCKET = 0.05  # of the scene's diagonal: what is narrower around a point is no room,
MOST = 14 / 16  # in so many directions


def hidden(
    model: Model, points: np.ndarray, normals: np.ndarray, light: np.ndarray, asked: np.ndarray | None = None
) -> np.ndarray:
    """Numbers of the points that lie inside of solids, or in narrow pockets under and between them, and not just in the
    dark.

    points, normals (unit): [n, 3]. light: what was found there [n, …]; only points that have none, and that are
    ``asked`` for (bool [n]), are tested. A point is inside of a solid if more than ENCLOSED of its rays hit the inside
    of one (`Rays.meets_solid`) from behind, because the fronts of walls that no light reaches are those of a dark room.
    It is in a pocket if nearly all of its rays are shorter than POCKET.
    """
    dark = light.reshape(len(points), -1).max(axis=1, initial=0) == 0
    dark = np.flatnonzero(dark if asked is None else dark & asked)
    if not len(dark):
        return dark
    x, normal = _above(model, points[dark], normals[dark])
    size = np.linalg.norm(np.ptp(model.faces.corners.reshape(-1, 3), axis=0))
    reach = dr.opaque(mi.Float, POCKET * float(size))
    every, solid, near = dr.arange(mi.UInt32, len(dark)), mi.UInt32(0), mi.UInt32(0)
    for look in range(LOOKS):
        _, _, s, t = kronecker(opaque_index(look), every, opaque_index(0))
        direction = cosine_direction(normal, s, t)
        start = x + model.patches.origin
        inside = model.rays.meets_solid(start, direction) & model.rays.trace(start, direction).back
        solid += dr.select(inside, mi.UInt32(1), 0)
        near += dr.select(model.rays.blocked(x, x + direction * reach), mi.UInt32(1), 0)
    return dark[np.array((near >= MOST * LOOKS) | (solid > ENCLOSED * LOOKS)).astype(bool)]


def on_top(model: Model, patch: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Which points of patches does nothing lie on in their plane (bool [n])?"""
    u, v = (owned(mi.Float, x) for x in uv.T)
    return np.array(model.rays.on_top(owned(mi.UInt32, patch), u, v)).astype(bool)


def blocked(
    model: Model, a: np.ndarray, b: np.ndarray, normal_a: np.ndarray, normal_b: np.ndarray, height: float = 0.0
) -> np.ndarray:
    """Does anything stand between points a and b of surfaces [n, 3], ``height`` m above these (bool [n])?"""
    if not len(a):
        return np.zeros(0, dtype=bool)
    ends = (_above(model, p + height * n, n)[0] for p, n in ((a, normal_a), (b, normal_b)))
    return np.array(model.rays.blocked(*ends)).astype(bool)


def first_faces(model: Model, a: np.ndarray, b: np.ndarray, normal_a: np.ndarray, normal_b: np.ndarray) -> np.ndarray:
    """The faces that rays from points a to b, which do not see each other, meet first (int [n])."""
    if not len(a):
        return np.zeros(0, dtype=np.int64)
    start, end = (_above(model, points, normals)[0] for points, normals in ((a, normal_a), (b, normal_b)))
    ray = mi.Ray3f(start + model.patches.origin, end - start)
    prelim = model.rays.scene.ray_intersect_preliminary(ray)
    face = dr.gather(mi.UInt32, model.faces.first_face, prelim.shape_index, prelim.is_valid()) + prelim.prim_index
    return np.array(face, dtype=np.int64)


def _above(model, points, normals):
    """Points relative to the origin of the patches, off their surfaces by the rounding of rays, and normals."""
    normal = owned_vectors(mi.Vector3f, normals)
    return owned_vectors(mi.Point3f, points - model.faces.centre) + normal * model.patches.lift, normal
