"""Vertices of a mesh: corners that elements share, and hanging ones in the middle of sides."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, concat, lower_bound, opaque_index, unique
from ..core.points import ROUNDS
from ..scene import Model
from ..scene.patches import CORNERS
from .elements import Elements
from .exposure import node_point
from .subdivision import CHILD_CORNERS

LAST = 0xFFFFFFFFFFFFFFFF  # above all keys of sides


class Vertices:
    """Numbers below ``count`` for every corner of every element, level by level.

    Corners of patches that share a position and a shading normal are one vertex: a surface ends at
    the edges of the model. Every side of an element that is split carries a vertex in its middle,
    known by the two vertices it halves, so neighbours agree on it whoever split first.

    ``corner``[k] (UInt32 [elements]) are the vertices of an element, ``middle``[k] those on the side opposite corner
    k, NONE where no element is split there. Where the neighbour of a leaf is split twice, the vertices between
    corner and middle hang: ``straight`` lists them as (vertex, low, high), each to lie half-way between two others,
    coarse ones first. ``point`` (Point3f [count]): where they are, just inside of the first element that has them.
    """

    def __init__(self, model: Model, elements: Elements) -> None:
        self._elements = elements
        n, roots = len(elements), elements.patches.count
        vertex, self.count = _weld(model)
        self.corner = [dr.full(mi.UInt32, NONE, n) for _ in range(3)]
        self.middle = [dr.full(mi.UInt32, NONE, n) for _ in range(3)]
        self.straight: list[tuple] = []
        level = dr.arange(mi.UInt32, roots)
        for corner, ids in zip(self.corner, vertex):
            dr.scatter(corner, ids, level)
        held = mi.UInt64(LAST)  # sides that must not bend, as sorted keys
        while dr.width(level):
            level, held = self._next_level(level, held)
        self.point = self._points()

    def _points(self):
        e, every = self._elements, dr.arange(mi.UInt32, len(self._elements))
        point, first = dr.zeros(mi.Point3f, self.count), dr.full(mi.UInt32, NONE, self.count)
        for corner in self.corner:  # clusters have none
            dr.scatter_reduce(dr.ReduceOp.Min, first, every, corner, corner != NONE, mode=dr.ReduceMode.Direct)
        for node, corner in enumerate(self.corner):
            owns = (corner != NONE) & (dr.gather(mi.UInt32, first, corner, corner != NONE) == every)
            dr.scatter(point, node_point(e, every, node), corner, owns)
        dr.eval(point)
        return point

    def _next_level(self, level, held):
        """Number the middle vertices of the elements ``level``; returns their children, and the sides held straight."""
        corner = [dr.gather(mi.UInt32, c, level) for c in self.corner]
        child = dr.gather(mi.UInt32, self._elements.child, level)
        parents = dr.compress(child != 0)
        if dr.width(parents) == 0:
            return mi.UInt32(), held
        sides = [(corner[1], corner[2]), (corner[2], corner[0]), (corner[0], corner[1])]
        keys = [_side_keys(a, b) for a, b in sides]
        dr.eval(keys)
        table = unique(concat(*(dr.gather(mi.UInt64, k, parents) for k in keys)))
        middle = []
        for k, key in enumerate(keys):
            at = lower_bound(table, key)
            middle.append(dr.select(dr.gather(mi.UInt64, table, at) == key, opaque_index(self.count) + at, NONE))
            dr.scatter(self.middle[k], middle[k], level)
        dr.eval(middle)
        held = self._hold(table, held, child == 0, middle, sides)
        self.count += dr.width(table)
        return self._number_children(dr.gather(mi.UInt32, child, parents), corner, middle, parents), held

    def _hold(self, table, held, leaf, middle, sides):
        """Note which of the new vertices, on sides ``table``, must stay half-way between the ends of their side;
        returns the sides to be held at the next level: halves of held ones, and halves of bent sides of leaves."""
        number = opaque_index(self.count) + dr.arange(mi.UInt32, dr.width(table))
        halves = []
        on_held = dr.compress(dr.gather(mi.UInt64, held, lower_bound(held, table)) == table)
        if dr.width(on_held):
            ends, vertex = dr.gather(mi.UInt64, table, on_held), dr.gather(mi.UInt32, number, on_held)
            low, high = mi.UInt32(ends >> 32), mi.UInt32(ends)
            dr.eval(low, high, vertex)
            self.straight.append((vertex, low, high))
            halves = [_side_keys(low, vertex), _side_keys(vertex, high)]
        for m, (a, b) in zip(middle, sides):
            bent = dr.compress(leaf & (m != NONE))
            if dr.width(bent):
                m, a, b = (dr.gather(mi.UInt32, x, bent) for x in (m, a, b))
                halves += [_side_keys(a, m), _side_keys(m, b)]
        return unique(concat(*halves)) if halves else mi.UInt64(LAST)

    def _number_children(self, child, corner, middle, parents):
        """Give the children (first of four: ``child``) of elements their corners; returns all children."""
        nodes = [dr.gather(mi.UInt32, x, parents) for x in (*corner, *middle)]
        for which, places in enumerate(CHILD_CORNERS):
            for table, node in zip(self.corner, places):
                dr.scatter(table, nodes[node], child + which)
        dr.eval(self.corner, self.middle)
        j = dr.arange(mi.UInt32, 4 * dr.width(parents))
        return dr.gather(mi.UInt32, child, j // 4) + j % 4

    def nodes(self, table: "dr.ArrayBase", between: Callable) -> "list[dr.ArrayBase]":
        """What ``table`` [vertices] says of the six nodes of the leaves (six of its kind [leaves]).

        Middles of sides that do not bend have no vertex: ``between(low, high, active)`` tells of them.
        """
        leaves = self._elements.leaves
        corner = [dr.gather(mi.UInt32, c, leaves) for c in self.corner]
        nodes = [dr.gather(type(table), table, c) for c in corner]
        for k in range(3):
            index = dr.gather(mi.UInt32, self.middle[k], leaves)
            bent = index != NONE
            straight = between(corner[(k + 1) % 3], corner[(k + 2) % 3], ~bent)
            nodes.append(dr.select(bent, dr.gather(type(table), table, index, bent), straight))
        return nodes


def _side_keys(a, b):
    return (mi.UInt64(dr.minimum(a, b)) << 32) | mi.UInt64(dr.maximum(a, b))


def _weld(model):
    """One vertex number per corner of the patches (three UInt32 [patches]), and how many there are.

    Corners are one vertex if position and shading normal are the same, to the bit and to 1/256.
    """
    patches, keys = model.patches, []
    one = dr.full(mi.Float, 1, patches.count)
    for point, (u, v) in zip(patches.corners, CORNERS):
        normal = model.faces.surface(patches.face, one * u, one * v).sh_frame.n * dr.select(patches.back, -1, 1)
        key = mi.UInt64(0x9E3779B97F4A7C15)
        for x in point:
            key = _mix(key, dr.reinterpret_array(mi.UInt32, x + 0.0))
        for x in normal:
            key = _mix(key, mi.UInt32(mi.Int32(dr.floor(x * 256 + 0.37))))
        keys.append(key)
    dr.eval(keys)
    table = unique(concat(*keys))
    return [lower_bound(table, key) for key in keys], dr.width(table)


def _mix(key, bits):
    return mi.sample_tea_64(mi.UInt32(key) ^ bits, mi.UInt32(key >> 32), ROUNDS)
