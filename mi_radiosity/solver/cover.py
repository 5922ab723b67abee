"""Parts of elements that lie inside solids: behind a skirting board, under the leg of a chair."""
import drjit as dr
import mitsuba as mi

from ..scene.model import NONE
from ..scene.sampling import cosine_direction, kronecker, triangle
from .arrays import ColorSums, opaque_index

GLANCE, LOOK = 8, 64        # points per leaf: of all leaves, and of those with a covered point
LEAST = 1 / 128             # no open share is smaller, so that nothing divides by zero


def find_covered(elements, seed):
    """Set ``elements.open_area`` to the area that is not inside a solid (leaves, and sums for ancestors).

    A point is covered if rays along its normal and in two more directions all meet sides that take
    no part in light transport: the insides of solids. Such parts are neither lit nor seen, so power
    belongs to the rest; spread over the whole element it would darken the picture wherever two
    objects touch. Lamps are left as they are.
    """
    model = elements.model
    leaves = elements.leaf_indices()
    glance = _covered_share(elements, leaves, GLANCE, seed)
    lamp = dr.max(dr.gather(mi.Color3f, model.emission, dr.gather(mi.UInt32, elements.patch, leaves))) > 0
    doubtful = dr.gather(mi.UInt32, leaves, dr.compress((glance > 0) & ~lamp))
    if dr.width(doubtful) == 0:
        return
    open_share = dr.full(mi.Float, 1, len(elements))
    dr.scatter(open_share, dr.maximum(1 - _covered_share(elements, doubtful, LOOK, seed), LEAST), doubtful)
    area = mi.Float64(dr.gather(mi.Float, elements.area, leaves) * dr.gather(mi.Float, open_share, leaves))
    sums = ColorSums(len(elements), [2 * model.total_area, 1, 1])
    elements.add_to_ancestors(sums, leaves, [area, mi.Float64(0), mi.Float64(0)])
    elements.open_area = mi.Float(sums.gather(dr.arange(mi.UInt32, len(elements)))[0])
    dr.eval(elements.open_area)


def _covered_share(elements, leaves, points, seed):
    """Share of ``points`` points of each leaf that are covered (Float [leaves])."""
    model, each = elements.model, opaque_index(points)
    k = dr.arange(mi.UInt32, dr.width(leaves) * points)
    leaf = dr.gather(mi.UInt32, leaves, k // each)
    x0, x1, s, t = kronecker(k % each, dr.gather(mi.UInt32, elements.key, leaves), opaque_index(seed ^ 0xC0), k // each)
    patch = dr.gather(mi.UInt32, elements.patch, leaf)
    normal = dr.gather(mi.Vector3f, model.normal, patch)
    origin, aside = model.leave(patch, *elements.patch_point(leaf, *triangle(x0, x1)), s, t)
    other = cosine_direction(normal, 1 - s, dr.select(t < .5, t + .5, t - .5))

    def inside(direction, active):
        hit = model.trace(origin, direction, active)
        return active & hit.valid & (hit.patch == NONE)

    covered = inside(normal, dr.full(mi.Bool, True, dr.width(k)))
    covered = inside(other, inside(aside, covered))
    return mi.Float(dr.block_sum(dr.select(covered, mi.UInt32(1), 0), points)) / mi.Float(each)
