"""Exchange areas of triangles that nothing stands between, by their contours."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned

AT_ONCE = 1 << 18  # pairs in one launch: bounds memory
FAR = 3.0  # distance of two triangles, in their radii, from which on few nodes are enough
NODES_FAR, NODES_NEAR = 6, 16
CLOSE = 0.5  # distance of two contours, in the smaller radius, below which sides are split where they come close
TINY = 1e-30


def exchange_area(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """A_p F_pq of pairs of triangles in full view of each other, m² (float64 [pairs]).

    By Stokes' theorem, 1/2π ∮∮ ln r dx·dy over both borders: the inner integral in closed form, the outer one by
    Gauss' rule, its nodes crowded towards the ends where ln r is singular if triangles touch. Where contours come
    close, sides are split at the places closest to a corner or to a side of the other contour, because ln r varies
    there over a distance as small as the gap. What lies behind the plane of the other triangle is cut off. p, q:
    corners, counter-clockwise as seen from the side meant [pairs, 3, 3].
    Source: Sparrow, "A new and simpler formulation for radiative angle factors", 1963.
    """
    centre = [t.mean(axis=1) for t in (p, q)]
    radius = [np.linalg.norm(t - c[:, None], axis=2).max(axis=1) for t, c in zip((p, q), centre)]
    far = np.linalg.norm(centre[0] - centre[1], axis=1) > FAR * (radius[0] + radius[1])
    near, close = np.flatnonzero(~far), np.zeros(len(p), bool)
    for start in range(0, len(near), AT_ONCE):
        part = near[start : start + AT_ONCE]
        gap = np.array(_gap(_corners(p[part]), _corners(q[part])))
        close[part] = gap < CLOSE * np.minimum(radius[0][part], radius[1][part])
    result = np.zeros(len(p))
    for group, nodes, weights, pieces in (
        (far, *_gauss(NODES_FAR, 0), 1),
        (~far & ~close, *_gauss(NODES_NEAR, 1), 1),
        (close, *_gauss(NODES_NEAR, 1), 4),
    ):
        chosen = np.flatnonzero(group)
        for start in range(0, len(chosen), AT_ONCE):
            part = chosen[start : start + AT_ONCE]
            result[part] = np.array(_contours(_corners(p[part]), _corners(q[part]), nodes, weights, pieces))
    return np.maximum(result, 0)


def _gap(p, q):
    """The least distance of the sides of triangles p from those of triangles q (Float64 [pairs])."""
    least = mi.Float64(np.inf)
    for k in range(3):
        a, side = p[k], p[(k + 1) % 3] - p[k]
        for m in range(3):
            c, other = q[m], q[(m + 1) % 3] - q[m]
            for t in _closest(a, side, c, other):
                x = a + side * t
                s = dr.clip(dr.dot(x - c, other) / dr.maximum(dr.squared_norm(other), TINY), 0, 1)
                least = dr.minimum(least, dr.norm(x - c - other * s))
            for corner in (a, a + side):
                s = dr.clip(dr.dot(corner - c, other) / dr.maximum(dr.squared_norm(other), TINY), 0, 1)
                least = dr.minimum(least, dr.norm(corner - c - other * s))
    return least


def _closest(a, side, c, other):
    """Where sides a + t side are closest to the ends and to the line of c + s other: three t in [0, 1]."""
    aa, bb, ab, w = dr.squared_norm(side), dr.squared_norm(other), dr.dot(side, other), c - a
    across = aa * bb - ab * ab
    line = (dr.dot(w, side) * bb - dr.dot(w, other) * ab) / dr.select(across > 1e-12 * aa * bb, across, np.inf)
    places = (dr.dot(w, side), dr.dot(w + other, side))
    return [dr.clip(t, 0, 1) for t in (*(x / dr.maximum(aa, TINY) for x in places), line)]


def _pieces(a, side, c, other):
    """Ends of the pieces of sides between the places of `_closest` (five Float64 [pairs], ascending)."""
    t = _closest(a, side, c, other)
    for k in (0, 1, 0):
        t[k], t[k + 1] = dr.minimum(t[k], t[k + 1]), dr.maximum(t[k], t[k + 1])
    return [mi.Float64(0), *t, mi.Float64(1)]


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


def _contours(p, q, nodes, weights, pieces):
    """The double integral, every outer side in one piece or in four (Float64 [pairs])."""
    outer, inner = _clipped(p, q), _clipped(q, p)
    along = []
    for c, d in inner:
        length = dr.norm(d - c)
        along.append((c, length, (d - c) / dr.maximum(length, TINY)))
    each = dr.opaque(mi.UInt32, dr.width(nodes))
    ends = {(i, j): _pieces(a, b - a, c, d - c) for i, (a, b) in enumerate(outer) for j, (c, d) in enumerate(inner)}

    def add(k, total):
        node, piece = k % each, k // each
        t, weight = dr.gather(mi.Float64, nodes, node), dr.gather(mi.Float64, weights, node)
        for i, (a, b) in enumerate(outer):
            side = b - a
            for j, (c, length, direction) in enumerate(along):
                low, high = mi.Float64(0), mi.Float64(1)
                for number in range(pieces if pieces > 1 else 0):
                    low = dr.select(piece == number, ends[i, j][number], low)
                    high = dr.select(piece == number, ends[i, j][number + 1], high)
                x = a + side * (low + (high - low) * t)
                s = dr.dot(c - x, direction)
                h = dr.norm(c - x - direction * s)
                inner_integral = _primitive(s + length, h) - _primitive(s, h)
                total += weight * (high - low) * dr.dot(side, direction) * inner_integral
        return k + 1, total

    count = dr.opaque(mi.UInt32, dr.width(nodes) * pieces)
    start = mi.UInt32(0), dr.zeros(mi.Float64, dr.width(p[0]))
    return dr.while_loop(start, lambda k, total: k < count, add)[1] * (0.5 * dr.inv_pi)


def _primitive(s, h):
    """∫ ln √(s² + h²) ds."""
    return 0.5 * s * dr.log(s * s + h * h + TINY) - s + h * dr.atan(s / (h + TINY))
