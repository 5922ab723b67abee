"""The surface nearest to a point."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import opaque_index, owned_vectors
from .faces import Faces

REACH = 0.01  # of the diagonal of the scene, beyond which a point has no surface
TILT = 4.0  # times the lift: how much nearer a face counts that a normal belongs to


def nearest_face(
    faces: Faces, points: np.ndarray, normals: np.ndarray, lift: float
) -> "tuple[mi.UInt32, mi.Float, mi.Float, mi.Bool]":
    """The face nearest to points and where on it (UInt32, Float u, Float v), and whether it is within REACH (Bool [n]).

    points, normals: float64 [n, 3]. At edges the face counts whose normal is most like the given one or its opposite.
    """
    corners = owned_vectors(mi.Point3f, faces.corners[:, 0] - faces.centre)
    e1, e2, normal = (owned_vectors(mi.Vector3f, a) for a in (faces.e1, faces.e2, faces.normal))
    x, n = owned_vectors(mi.Point3f, points - faces.centre), owned_vectors(mi.Vector3f, normals)
    u, v, face, least = _search(corners, e1, e2, normal, opaque_index(len(faces)), x, n, dr.opaque(mi.Float, lift))
    size = faces.high - faces.low
    return face, u, v, least <= dr.opaque(mi.Float, REACH**2 * float(size @ size))


@dr.syntax
def _search(corners, e1, e2, normal, count, x, n, lift):
    k, face, least = mi.UInt32(0), dr.zeros(mi.UInt32, dr.width(x)), dr.full(mi.Float, dr.inf, dr.width(x))
    u, v = dr.zeros(mi.Float, dr.width(x)), dr.zeros(mi.Float, dr.width(x))
    while k < count:
        a, b = dr.gather(mi.Vector3f, e1, k), dr.gather(mi.Vector3f, e2, k)
        here_u, here_v, distance = _closest(x - dr.gather(mi.Point3f, corners, k), a, b)
        distance += dr.square(TILT * lift) * (1 - dr.abs(dr.dot(n, dr.gather(mi.Vector3f, normal, k))))
        nearer = distance < least
        face = dr.select(nearer, k, face)
        u, v = dr.select(nearer, here_u, u), dr.select(nearer, here_v, v)
        least = dr.select(nearer, distance, least)
        k += 1
    return u, v, face, least


def _closest(d, a, b):
    """The point u a + v b, u, v ≥ 0, u + v ≤ 1, nearest to d, and its squared distance (three Float [n])."""
    aa, ab, bb, da, db = dr.dot(a, a), dr.dot(a, b), dr.dot(b, b), dr.dot(d, a), dr.dot(d, b)
    area2 = dr.maximum(aa * bb - ab * ab, 1e-37)
    u, v = (bb * da - ab * db) / area2, (aa * db - ab * da) / area2
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    along_a, along_b = dr.clip(da / dr.maximum(aa, 1e-37), 0, 1), dr.clip(db / dr.maximum(bb, 1e-37), 0, 1)
    opposite = dr.clip((da - db - ab + bb) / dr.maximum(aa - 2 * ab + bb, 1e-37), 0, 1)
    best_u, best_v = u, v
    least = dr.select(inside, dr.squared_norm(d - a * u - b * v), dr.inf)
    for edge_u, edge_v in ((along_a, 0), (0, along_b), (opposite, 1 - opposite)):
        distance = dr.squared_norm(d - a * edge_u - b * edge_v)
        nearer = ~inside & (distance < least)
        best_u, best_v = dr.select(nearer, edge_u, best_u), dr.select(nearer, edge_v, best_v)
        least = dr.select(nearer, distance, least)
    return best_u, best_v, least
