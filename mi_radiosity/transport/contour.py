"""Exchange areas of triangles that nothing stands between, by their contours."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned

AT_ONCE = 1 << 18  # pairs in one launch: bounds memory
FAR = 3.0  # distance of two triangles, in their radii, from which on few nodes are enough
NODES_FAR, NODES_NEAR = 6, 16
TINY = 1e-30


def exchange_area(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """A_p F_pq of pairs of triangles in full view of each other, m² (float64 [pairs]).

    By Stokes' theorem, 1/2π ∮∮ ln r dx·dy over both borders: the inner integral in closed form, the outer one by
    Gauss' rule, its nodes crowded towards the ends where ln r is singular if triangles touch. What lies behind the
    plane of the other triangle is cut off. p, q: corners, counter-clockwise as seen from the side meant [pairs, 3, 3].
    Source: Sparrow, "A new and simpler formulation for radiative angle factors", 1963.
    """
    centre = [t.mean(axis=1) for t in (p, q)]
    radius = [np.linalg.norm(t - c[:, None], axis=2).max(axis=1) for t, c in zip((p, q), centre)]
    far = np.linalg.norm(centre[0] - centre[1], axis=1) > FAR * (radius[0] + radius[1])
    result = np.zeros(len(p))
    for chosen, nodes in ((np.flatnonzero(far), _gauss(NODES_FAR, 0)), (np.flatnonzero(~far), _gauss(NODES_NEAR, 1))):
        for start in range(0, len(chosen), AT_ONCE):
            part = chosen[start : start + AT_ONCE]
            result[part] = np.array(_contours(_corners(p[part]), _corners(q[part]), *nodes))
    return np.maximum(result, 0)


def _gauss(count, grade):
    """Nodes in [0, 1] and weights, crowded towards the ends by ``grade`` smooth steps (two Float64 [count])."""
    x, weight = np.polynomial.legendre.leggauss(count)
    t, weight = (x + 1) / 2, weight / 2
    for _ in range(grade):
        t, weight = t * t * (3 - 2 * t), weight * 6 * t * (1 - t)
    return owned(mi.Float64, t), owned(mi.Float64, weight)


def _corners(triangles):
    return [mi.Vector3d(*(owned(mi.Float64, x) for x in triangles[:, k].T)) for k in range(3)]


def _clipped(p, q):
    """What of triangles p lies before the plane of triangles q: four sides (from, to), some of no length."""
    normal = dr.cross(q[1] - q[0], q[2] - q[0])
    height = [dr.dot(x - q[0], normal) for x in p]
    sides, leaves, enters = [], mi.Vector3d(p[0]), mi.Vector3d(p[0])
    for k in range(3):
        a, b, ha, hb = p[k], p[(k + 1) % 3], height[k], height[(k + 1) % 3]
        out, back = (ha >= 0) & (hb < 0), (ha < 0) & (hb >= 0)
        cut = a + (b - a) * dr.select(out | back, ha / dr.select(out | back, ha - hb, 1), 0)
        behind = (ha < 0) & (hb < 0)
        sides.append((dr.select(back, cut, a), dr.select(out, cut, dr.select(behind, a, b))))
        leaves, enters = dr.select(out, cut, leaves), dr.select(back, cut, enters)
    return [*sides, (leaves, enters)]


def _contours(p, q, nodes, weights):
    """The double integral (Float64 [pairs])."""
    outer, inner = _clipped(p, q), _clipped(q, p)
    along = []
    for c, d in inner:
        length = dr.norm(d - c)
        along.append((c, length, (d - c) / dr.maximum(length, TINY)))

    def add(k, total):
        t, weight = dr.gather(mi.Float64, nodes, k), dr.gather(mi.Float64, weights, k)
        for a, b in outer:
            side = b - a
            x = a + side * t
            for c, length, direction in along:
                s = dr.dot(c - x, direction)
                h = dr.norm(c - x - direction * s)
                total += weight * dr.dot(side, direction) * (_primitive(s + length, h) - _primitive(s, h))
        return k + 1, total

    count = dr.opaque(mi.UInt32, dr.width(nodes))
    start = mi.UInt32(0), dr.zeros(mi.Float64, dr.width(p[0]))
    return dr.while_loop(start, lambda k, total: k < count, add)[1] * (0.5 * dr.inv_pi)


def _primitive(s, h):
    """∫ ln √(s² + h²) ds."""
    return 0.5 * s * dr.log(s * s + h * h + TINY) - s + h * dr.atan(s / (h + TINY))
