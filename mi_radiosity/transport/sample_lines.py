"""Sample lines between facets, distributed nearly like the kernel: the visible share of exchange areas."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import opaque_index, owned, runs
from ..core.points import Stream, hash_pair, paired_nets, stream_seed, triangle
from ..mesh.subdivision import NODES
from .facets import AT_ONCE, Facets

LINES = 8  # lines of a block; the blocks of a pair are even in number, for two halves


def visible_sums(
    facets: Facets,
    i: np.ndarray,
    j: np.ndarray,
    whole: np.ndarray,
    blocks: np.ndarray,
    seed: int,
    progress: Callable[[int, int], None],
) -> np.ndarray:
    """Σ k, Σ k², Σ k V and Σ k² V over the sample lines of pairs of cells, by halves (float64 [4, 2, pairs]).

    i, j: cells [pairs]; whole: their exchange areas in full view, m² [pairs]; blocks: of LINES lines each, an even
    number [pairs]. k is the kernel over the density of the line, in units of its mean. V is 1 for visible lines.

    One end of a line is uniform on the smaller cell, the other end is uniform in the solid angle of the larger cell.
    So k = A Ω cos θ / (π · whole) is bounded, also where cells touch and the kernel itself is singular.
    """
    small = facets.area[i] <= facets.area[j]
    i, j = np.where(small, i, j), np.where(small, j, i)
    unit = facets.area[i] / (np.pi * np.where(whole > 0, whole, np.inf))
    pair, number = runs(blocks)
    stream = opaque_index(stream_seed(seed, Stream.FACTORS, 1))
    sums, most = np.zeros((4, len(pair))), AT_ONCE // LINES
    for start in range(0, len(pair), most):
        part = slice(start, start + most)
        of = pair[part]
        first, second, block, count = (owned(mi.UInt32, x) for x in (i[of], j[of], number[part], LINES * blocks[of]))
        values = _along_lines(facets, first, second, block, count, owned(mi.Float, unit[of]), stream)
        sums[:, part] = [np.array(dr.block_sum(x, LINES)) for x in values]
        progress(min(start + most, len(pair)), len(pair))
    halves = [np.where(number % 2 == half, sums, 0) for half in (0, 1)]
    return np.stack([np.add.reduceat(half, np.cumsum(blocks) - blocks, axis=1) for half in halves], axis=1)


def _along_lines(facets, i, j, number, count, unit, stream):
    """k, k², k V and k² V along the lines of blocks (four Float [LINES · blocks])."""
    e, p, rays = facets.elements, facets.model.patches, facets.model.rays
    i, j = (dr.gather(mi.UInt32, facets.cells, cell) for cell in (i, j))
    line = dr.arange(mi.UInt32, LINES * dr.width(i))
    block = line // LINES
    index = LINES * dr.gather(mi.UInt32, number, block) + line % LINES
    count = dr.gather(mi.UInt32, count, block)
    x0, x1, y0, y1 = paired_nets(index, count, hash_pair(e.key(i), e.key(j)), stream, block)
    i, j = dr.gather(mi.UInt32, i, block), dr.gather(mi.UInt32, j, block)
    patch_i, patch_j = dr.gather(mi.UInt32, e.patch, i), dr.gather(mi.UInt32, e.patch, j)
    n_i, n_j = (dr.gather(mi.Vector3f, p.normal, patch) for patch in (patch_i, patch_j))
    at_x = e.patch_point(i, *triangle(x0, x1))
    x = p.point(patch_i, *at_x)
    corners = [p.point(patch_j, *e.patch_point(j, *map(mi.Float, node))) for node in NODES[:3]]
    a, b, solid_angle = uniform_in_solid_angle(x, corners, y0, y1)
    at_y = e.patch_point(j, a, b)
    y = p.point(patch_j, *at_y)
    towards = dr.normalize(y - x)
    facing = (dr.dot(n_j, towards) < 0) & dr.isfinite(solid_angle)
    k = dr.select(facing, dr.maximum(dr.dot(n_i, towards), 0) * solid_angle, 0) * dr.gather(mi.Float, unit, block)
    shows = (k > 0) & rays.on_top(patch_i, *at_x) & rays.on_top(patch_j, *at_y)
    visible = shows & ~rays.blocked(x + n_i * p.lift, y + n_j * p.lift, shows)
    seen = dr.select(visible, k, 0)
    return k, k * k, seen, seen * k


def uniform_in_solid_angle(
    x: "mi.Point3f", corners: "list[mi.Point3f]", s: "mi.Float", t: "mi.Float"
) -> "tuple[mi.Float, mi.Float, mi.Float]":
    """Barycentric coordinates of points that are uniform in the solid angle of triangles at x, and that angle, sr.

    x: Point3f [n]; corners: three Point3f [n]; s, t: two uniform numbers [n]. In double precision, because differences
    of angles are as small as the solid angle. Points in the plane of the triangle get a solid angle of 0 or NaN.
    Source: Arvo, "Stratified sampling of spherical triangles", 1995, with Van Oosterom and Strackee's solid angle.
    """
    q = [mi.Vector3d(corner) - mi.Vector3d(x) for corner in corners]
    a, b, c = (dr.normalize(corner) for corner in q)
    cosine = dr.dot(a, b)
    solid_angle = 2 * dr.atan2(dr.abs(dr.dot(a, dr.cross(b, c))), 1 + cosine + dr.dot(b, c) + dr.dot(c, a))
    # The angle at a of the spherical triangle, and the area of the part of it that s cuts off at the side a b.
    ab, ac = dr.cross(a, b), dr.cross(a, c)
    cos_a, sin_a = dr.dot(ab, ac), dr.norm(dr.cross(ab, ac))
    scale = 1 / dr.norm(mi.Vector2d(cos_a, sin_a))
    cos_a, sin_a = cos_a * scale, sin_a * scale
    sin_s, cos_s = dr.sincos(mi.Float64(s) * solid_angle)
    sin_phi, cos_phi = sin_a * cos_s - cos_a * sin_s, -(cos_a * cos_s + sin_a * sin_s)
    k1, k2 = cos_phi + cos_a, sin_phi - sin_a * cosine
    cos_b = (k2 + (k2 * cos_phi - k1 * sin_phi) * cos_a) / ((k2 * sin_phi + k1 * cos_phi) * sin_a)
    end = _on_arc(a, c, dr.clip(cos_b, -1, 1))
    z = 1 - mi.Float64(t) * (1 - dr.dot(end, b))
    direction = _on_arc(b, end, dr.clip(z, -1, 1))
    # Where the direction meets the plane of the triangle.
    e1, e2 = q[1] - q[0], q[2] - q[0]
    across = dr.cross(direction, e2)
    over = dr.rcp(dr.dot(e1, across))
    u = -dr.dot(q[0], across) * over
    v = -dr.dot(direction, dr.cross(q[0], e1)) * over
    u = dr.clip(u, 0, 1)
    v = dr.clip(v, 0, 1 - u)
    return mi.Float(u), mi.Float(v), mi.Float(solid_angle)


def _on_arc(a, b, cosine):
    """The unit vector at an angle from a, given by its cosine, towards b."""
    return a * cosine + dr.normalize(b - a * dr.dot(a, b)) * dr.safe_sqrt(1 - cosine * cosine)
