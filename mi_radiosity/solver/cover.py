"""Parts of elements that nothing reaches: behind a skirting board, under the leg of a chair, under a rug."""
import drjit as dr
import mitsuba as mi

from ..scene.model import NONE
from ..scene.sampling import cosine_direction, kronecker, triangle
from .arrays import ColorSums, opaque_index

INSET = 2.0 ** -12          # of an element: how far from its sides it is searched for walls
GLANCE, LOOK = 8, 64        # points per leaf: of all leaves, and of those with a covered point
LEAST = 1 / 128             # no open share is smaller, so that nothing divides by zero


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
    """Set ``elements.divided``: does a wall stand across a leaf, or across one below an element (Bool [elements])?

    What crosses a triangle crosses two of its sides, so lines just above the sides find it.
    """
    model, leaves = elements.model, elements.leaf_indices()
    patch = dr.gather(mi.UInt32, elements.patch, leaves)
    lift = dr.gather(mi.Vector3f, model.normal, patch) * model.offset
    corners = [model.point(patch, *elements.patch_point(leaves, a, b)) + lift
               for a, b in ((INSET, INSET), (1 - 2 * INSET, INSET), (INSET, 1 - 2 * INSET))]
    divided = dr.full(mi.Bool, False, dr.width(leaves))
    for a, b in zip(corners, corners[1:] + corners[:1]):
        ray = mi.Ray3f(a + model.origin, b - a)
        ray.maxt = 1
        divided |= model.blocked(ray, ~divided)
    elements.divided = dr.zeros(mi.Bool, len(elements))
    elements.mark_ancestors(elements.divided, dr.gather(mi.UInt32, leaves, dr.compress(divided)))


def _covered_share(elements, leaves, points, seed):
    """Share of ``points`` points of each leaf that are covered (Float [leaves])."""
    model, each = elements.model, opaque_index(points)
    k = dr.arange(mi.UInt32, dr.width(leaves) * points)
    leaf = dr.gather(mi.UInt32, leaves, k // each)
    x0, x1, s, t = kronecker(k % each, elements.key(leaves), opaque_index(seed ^ 0xC0), k // each)
    patch, (u, v) = dr.gather(mi.UInt32, elements.patch, leaf), elements.patch_point(leaf, *triangle(x0, x1))
    normal, lamp = dr.gather(mi.Vector3f, model.normal, patch), dr.max(dr.gather(mi.Color3f, model.emission, patch)) > 0
    origin, aside = model.leave(patch, u, v, s, t)
    other = cosine_direction(normal, 1 - s, dr.select(t < .5, t + .5, t - .5))

    def inside(direction, active):
        hit = model.trace(origin, direction, active)
        return active & hit.valid & (hit.patch == NONE)

    covered = inside(other, inside(aside, inside(normal, ~lamp))) | ~model.owns(patch, u, v)
    return mi.Float(dr.block_sum(dr.select(covered, mi.UInt32(1), 0), points)) / mi.Float(each)
