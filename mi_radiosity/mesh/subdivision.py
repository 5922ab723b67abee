"""The 1→4 rule: how a triangle splits into four, once.

Children 0, 1, 2 keep the corner of their number; child 3 is the middle one and stands upside down. Own coordinates
(a, b) of an element have its corners at (0, 0), (1, 0), (0, 1).
"""

import drjit as dr
import mitsuba as mi

# Nodes of an element: its corners, and the middles of the sides opposite them.
NODES = ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.5, 0.5), (0.0, 0.5), (0.5, 0.0))
# Corners of every child, as nodes of its parent.
CHILD_CORNERS = ((0, 5, 4), (5, 1, 3), (4, 3, 2), (3, 4, 5))
# The sides of an element from corner to middle to corner, all around.
HALF_SIDES = ((0, 5), (5, 1), (1, 3), (3, 2), (2, 4), (4, 0))


def child_at(a: "mi.Float", b: "mi.Float") -> "mi.UInt32":
    """Which child holds a point (a, b) of an element (UInt32 [n])."""
    outer = dr.select(b >= 0.5, mi.UInt32(2), dr.select(a + b <= 0.5, mi.UInt32(0), mi.UInt32(3)))
    return dr.select(a >= 0.5, mi.UInt32(1), outer)


def child_frame(
    which: "mi.UInt32", u0: "mi.Float", v0: "mi.Float", scale: "mi.Float"
) -> "tuple[mi.Float, mi.Float, mi.Float]":
    """Origin and scale (u₀, v₀, s) of the child of a number in its parent's patch, from the parent's."""
    half = 0.5 * scale
    u0 = u0 + dr.select((which == 1) | (which == 3), half, 0)
    v0 = v0 + dr.select(which >= 2, half, 0)
    return u0, v0, dr.select(which == 3, -half, half)


def child_point(which: "mi.UInt32", a: "mi.Float", b: "mi.Float") -> "tuple[mi.Float, mi.Float]":
    """Own coordinates in the child of a point (a, b) of its parent (two Float [n])."""
    middle = which == 3
    a = dr.select(middle, 1 - 2 * a, 2 * a - dr.select(which == 1, 1.0, 0.0))
    b = dr.select(middle, 1 - 2 * b, 2 * b - dr.select(which == 2, 1.0, 0.0))
    return a, b


def child_corner(which: "mi.UInt32", corner: int) -> "mi.UInt32":
    """The parent's node that is a corner of the child of a number (UInt32 [n])."""
    node = mi.UInt32(CHILD_CORNERS[3][corner])
    for child in range(3):
        node = dr.select(which == child, mi.UInt32(CHILD_CORNERS[child][corner]), node)
    return node
