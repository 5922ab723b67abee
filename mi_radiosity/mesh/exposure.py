"""What of an element sees anything: what solids and rugs cover of it, and which elements a wall crosses."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, opaque_index
from ..core.points import Stream, cosine_direction, kronecker, stream_seed, triangle
from ..scene.rays import Rays
from .elements import Elements
from .hierarchy import mark, sum_up
from .subdivision import NODES

GLANCE, LOOK = 8, 64  # points per leaf: of all leaves, and of those with a covered point
FEWEST, MANY = 2, 1 << 19  # points of the first kind per leaf, where there are more than so many
LEAST = 1 / 128  # no open share is smaller, so that nothing divides by zero
TUCK = 2.0**-14  # how far inside of its element a node is when something is looked for between it and others


@dataclass(frozen=True)
class Exposure:
    """What of the elements of a mesh is open, and where walls stand on them. Immutable.

    ``open_area`` (Float [elements], m²): the area that is not covered; a point is covered if it lies under another
    face of its plane, or inside a solid. Such parts are neither lit nor seen, so power belongs to the rest; spread
    over the whole element it would darken the picture wherever two objects touch.
    ``crossed`` (Bool [elements]): a wall stands across a leaf, or across one below the element. Such a leaf has light
    on one side of the wall, perhaps, and not on the other.
    ``slot`` (UInt32 [elements]): numbers crossed leaves from 0, NONE for other elements; there are ``slots`` of them.
    """

    open_area: "mi.Float"
    crossed: "mi.Bool"
    slot: "mi.UInt32"
    slots: int

    @staticmethod
    def unseen(elements: Elements) -> "Exposure":
        """As if nothing were covered or crossed: what a pilot assumes."""
        n = len(elements)
        return Exposure(elements.area, dr.zeros(mi.Bool, n), dr.full(mi.UInt32, NONE, n), 0)

    @staticmethod
    def of(elements: Elements, rays: Rays, seed: int) -> "Exposure":
        """Look at every leaf."""
        crossed = crossed_leaves(elements, rays)
        slot = dr.full(mi.UInt32, NONE, len(elements))
        if dr.width(crossed):
            dr.scatter(slot, dr.arange(mi.UInt32, dr.width(crossed)), crossed)
        return Exposure(_open_area(elements, rays, seed), mark(elements, crossed), slot, dr.width(crossed))

    def open_share(self, elements: Elements, element: "mi.UInt32") -> "mi.Float":
        """The part of elements that is open (Float [n])."""
        return dr.gather(mi.Float, self.open_area, element) / dr.gather(mi.Float, elements.area, element)


def _open_area(elements, rays, seed):
    """Area that is not covered, of leaves, and sums for their ancestors (Float [elements])."""
    glance = max(FEWEST, min(GLANCE, MANY // dr.width(elements.leaves)))
    doubtful = dr.compress(_covered_share(elements, rays, elements.leaves, glance, seed) > 0)
    if dr.width(doubtful) == 0:
        return elements.area
    doubtful = dr.gather(mi.UInt32, elements.leaves, doubtful)
    open_share = 1 - _covered_share(elements, rays, doubtful, LOOK, seed)
    if rays.has_rooms_behind_backs:
        # A leaf that lies in a gap as a whole keeps its area: no part of it is left that its light could belong to.
        closed = dr.compress(open_share == 0)
        if dr.width(closed):
            leaves = dr.gather(mi.UInt32, doubtful, closed)
            dr.scatter(open_share, 1 - _covered_share(elements, rays, leaves, LOOK, seed, gaps=False), closed)
    share = dr.full(mi.Float, 1, len(elements))
    dr.scatter(share, dr.maximum(open_share, LEAST), doubtful)
    area = mi.Float64(dr.gather(mi.Float, elements.area * share, elements.leaves))
    sums = sum_up(elements, [area, mi.Float64(0), mi.Float64(0)], [2 * elements.patches.total_area, 1, 1])
    result = mi.Float(sums.gather(dr.arange(mi.UInt32, len(elements)))[0])
    result = dr.select(result > 0, result, elements.area)  # clusters are no ancestors
    dr.eval(result)
    return result


def _covered_share(elements, rays, leaves, points, seed, gaps=True):
    """Share of ``points`` points of each leaf that are covered (Float [leaves])."""
    each = opaque_index(points)
    k = dr.arange(mi.UInt32, dr.width(leaves) * points)
    leaf = dr.gather(mi.UInt32, leaves, k // each)
    x0, x1, s, t = kronecker(k % each, elements.key(leaves), opaque_index(stream_seed(seed, Stream.COVER)), k // each)
    covered = is_covered(elements, rays, leaf, *elements.patch_point(leaf, *triangle(x0, x1)), s, t, gaps)
    return mi.Float(dr.block_sum(dr.select(covered, mi.UInt32(1), 0), points)) / mi.Float(each)


def is_covered(
    elements: Elements,
    rays: Rays,
    leaf: "mi.UInt32",
    u: "mi.Float",
    v: "mi.Float",
    s: "mi.Float | float" = 0.3,
    t: "mi.Float | float" = 0.6,
    gaps: bool = True,
) -> "mi.Bool":
    """Are patch points (u, v) of leaves covered (Bool [n])? s, t: uniform numbers that select directions of rays.

    A point is covered if it lies under another face of its plane, or if rays along the normal and in two more
    directions all hit the inside of solids, or with ``gaps`` the far side of a narrow gap (`Rays.meets_solid`). Points
    of emitters are tested for neither.
    """
    patch = dr.gather(mi.UInt32, elements.patch, leaf)
    normal, lamp = dr.gather(mi.Vector3f, elements.patches.normal, patch), dr.max(elements.emission(leaf)) > 0
    origin, aside = rays.leave(patch, u, v, s, t)
    other = cosine_direction(normal, 1 - s, dr.select(t < 0.5, t + 0.5, t - 0.5))

    def inside(direction, active):
        return rays.meets_solid(origin, direction, active, normal if gaps else None)

    return inside(other, inside(aside, inside(normal, ~lamp))) | ~rays.on_top(patch, u, v)


def crossed_leaves(elements: Elements, rays: Rays) -> "mi.UInt32":
    """Leaves that a wall stands across: what crosses a triangle crosses its sides (UInt32 [n])."""
    leaves = elements.leaves
    corners = [node_point(elements, leaves, node) for node in range(3)]
    crossed = dr.full(mi.Bool, False, dr.width(leaves))
    for a, b in zip(corners, corners[1:] + corners[:1]):
        crossed |= rays.blocked(a, b, ~crossed)
    return dr.gather(mi.UInt32, leaves, dr.compress(crossed))


def node_point(elements: Elements, element: "mi.UInt32", node: int) -> "mi.Point3f":
    """Where a node of elements is, just inside of them and above their patch (Point3f [n])."""
    u, v = elements.patch_point(element, *((1 - TUCK) * x + TUCK / 3 for x in NODES[node]))
    return elements.patches.above(dr.gather(mi.UInt32, elements.patch, element), u, v)
