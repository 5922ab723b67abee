"""Parts of elements that nothing reaches: behind a skirting board, under the leg of a chair, under a rug."""

import drjit as dr
import mitsuba as mi

from ..scene.model import NONE
from ..core.points import cosine_direction, kronecker, triangle
from ..core.arrays import ColorSums, opaque_index
from .elements import NODES

GLANCE, LOOK = 8, 64  # points per leaf: of all leaves, and of those with a covered point
LEAST = 1 / 128  # no open share is smaller, so that nothing divides by zero


def find_covered(elements, seed):
    """Set ``elements.open_area`` to the area that is not covered (leaves, and sums for ancestors).

    A point is covered if it lies under another face of its plane, or inside a solid: rays along its
    normal and in two more directions all meet sides that take no part in light transport. Such parts
    are neither lit nor seen, so power belongs to the rest; spread over the whole element it would
    darken the picture wherever two objects touch. Solids are not looked for around lamps.
    """
    leaves = elements.leaf_indices()
    doubtful = dr.gather(mi.UInt32, leaves, dr.compress(_covered_share(elements, leaves, GLANCE, seed) > 0))
    if dr.width(doubtful) == 0:
        return
    open_share = dr.full(mi.Float, 1, len(elements))
    dr.scatter(open_share, dr.maximum(1 - _covered_share(elements, doubtful, LOOK, seed), LEAST), doubtful)
    area = mi.Float64(dr.gather(mi.Float, elements.area, leaves) * dr.gather(mi.Float, open_share, leaves))
    sums = ColorSums(len(elements), [2 * elements.model.total_area, 1, 1])
    elements.add_to_ancestors(sums, leaves, [area, mi.Float64(0), mi.Float64(0)])
    elements.open_area = mi.Float(sums.gather(dr.arange(mi.UInt32, len(elements)))[0])
    dr.eval(elements.open_area)


def find_divided(elements):
    """Set ``elements.divided``: does a wall stand across a leaf, or across one below an element?

    What crosses a triangle crosses its sides, so lines just above the sides find it. Until light
    has come down, all nodes of such leaves that are not covered are ``across``.
    """
    leaves = elements.leaf_indices()
    patch = dr.gather(mi.UInt32, elements.patch, leaves)
    corners = [elements.node_point(leaves, a, b) for a, b in NODES[:3]]
    divided = dr.full(mi.Bool, False, dr.width(leaves))
    for a, b in zip(corners, corners[1:] + corners[:1]):
        divided |= elements.model.walled(patch, *a, *b, ~divided)
    leaves = dr.gather(mi.UInt32, leaves, dr.compress(divided))
    elements.divided, elements.across = dr.zeros(mi.Bool, len(elements)), dr.zeros(mi.UInt32, len(elements))
    if dr.width(leaves) == 0:
        return
    elements.mark_ancestors(elements.divided, leaves)
    across = dr.zeros(mi.UInt32, dr.width(leaves))
    for k, (a, b) in enumerate(NODES):
        across |= dr.select(is_covered(elements, leaves, *elements.node_point(leaves, a, b)), mi.UInt32(0), 1 << k)
    dr.scatter(elements.across, across, leaves)
    dr.eval(elements.across)


def note_light(elements, leaves, u, v):
    """Nodes of divided ``leaves`` in sight of points (u, v) where light came down (NaN for none) are not across."""
    across, seen = dr.gather(mi.UInt32, elements.across, leaves), mi.UInt32(0)
    for k, (a, b) in enumerate(NODES):
        asked = ~dr.isnan(u) & ((across & (1 << k)) != 0)
        seen |= dr.select(asked & elements.in_sight(leaves, u, v, a, b, asked), mi.UInt32(1 << k), 0)
    dr.scatter_reduce(dr.ReduceOp.And, elements.across, ~seen, leaves, mode=dr.ReduceMode.Direct)
    dr.eval(elements.across)


def _covered_share(elements, leaves, points, seed):
    """Share of ``points`` points of each leaf that are covered (Float [leaves])."""
    each = opaque_index(points)
    k = dr.arange(mi.UInt32, dr.width(leaves) * points)
    leaf = dr.gather(mi.UInt32, leaves, k // each)
    x0, x1, s, t = kronecker(k % each, elements.key(leaves), opaque_index(seed ^ 0xC0), k // each)
    covered = is_covered(elements, leaf, *elements.patch_point(leaf, *triangle(x0, x1)), s, t)
    return mi.Float(dr.block_sum(dr.select(covered, mi.UInt32(1), 0), points)) / mi.Float(each)


def is_covered(elements, leaf, u, v, s=0.3, t=0.6):
    """Are patch points (u, v) of leaves covered (Bool [n])? s, t: two numbers that say where rays look."""
    model, patch = elements.model, dr.gather(mi.UInt32, elements.patch, leaf)
    normal, lamp = dr.gather(mi.Vector3f, model.normal, patch), dr.max(dr.gather(mi.Color3f, model.emission, patch)) > 0
    origin, aside = model.leave(patch, u, v, s, t)
    other = cosine_direction(normal, 1 - s, dr.select(t < 0.5, t + 0.5, t - 0.5))

    def inside(direction, active):
        hit = model.trace(origin, direction, active)
        return active & hit.valid & (hit.patch == NONE)

    return inside(other, inside(aside, inside(normal, ~lamp))) | ~model.owns(patch, u, v)
