"""Irradiance as a continuous field over each flat or smooth surface (Gouraud)."""

import drjit as dr
import mitsuba as mi

from ..scene.model import NONE
from ..core.arrays import ColorSums, concat, lower_bound, opaque_index, totals, unique
from ..mesh.elements import NODES, child_at

FAINT = 1e-4  # weight below which a node has no say
SHARPEN = 1  # rounds in which vertices make up for what averaging took from the elements


class Field:
    """Irradiance H(x), W/m², piecewise linear and continuous over surfaces.

    Corners of patches that share a position and a shading normal are one vertex: a surface ends at
    the edges of the model. Every edge of an element that is split carries a vertex in its middle,
    known by the two vertices it halves, so neighbours agree on it whoever split first.

    A leaf is shown by six nodes, its corners and the middles of its sides: a side whose neighbour is
    split bends at the middle vertex, another is straight. Where the neighbour is finer still, its
    vertices between the nodes lie on the straight line between them. So no side shows a crack.

    Where a wall stands on a leaf, each side of it is shown by the nodes on that side alone.

    nodes: six Color3f per element, [6 · elements]; 0…2 corners, 3…5 the middles opposite them.
    """

    def __init__(self, solution):
        self.elements = solution.elements
        self.flat = solution.irradiance()
        leaves = self.elements.leaf_indices()
        H = dr.gather(mi.Color3f, self.flat, leaves)
        mesh = _Topology(self.elements, leaves)
        values = mesh.spread(H)
        for _ in range(SHARPEN):
            lost = dr.select(dr.gather(mi.UInt32, self.elements.across, leaves) == 0, H - mesh.mean(values), 0)
            values = dr.maximum(values + mesh.spread(lost), 0)
        values = mesh.straighten(values)
        self.nodes = dr.zeros(mi.Color3f, 6 * len(self.elements))
        for k, color in enumerate(mesh.node_values(values)):
            dr.scatter(self.nodes, color, 6 * leaves + k)
        self.points, self.walled = dr.zeros(mi.Point3f, 6 * len(self.elements)), dr.zeros(mi.Bool, len(self.elements))
        points = mesh.node_points()
        for k, point in enumerate(points):
            dr.scatter(self.points, point, 6 * leaves + k)
        dr.scatter(self.walled, mesh.find_walls(points), leaves)
        dr.eval(self.nodes, self.points, self.walled)

    def at(self, leaf, u, v, active=True):
        """H at patch points (u, v) on leaves (Color3f [n])."""
        e = self.elements
        scale = dr.gather(mi.Float, e.scale, leaf, active)
        scale = dr.select(active, scale, 1)
        a = (u - dr.gather(mi.Float, e.u0, leaf, active)) / scale
        b = (v - dr.gather(mi.Float, e.v0, leaf, active)) / scale
        quarter = child_at(a, b)
        # Nodes and local coordinates of the quarter that holds the point.
        middle = quarter == 3
        a = dr.select(middle, 1 - 2 * a, 2 * a - dr.select(quarter == 1, 1.0, 0.0))
        b = dr.select(middle, 1 - 2 * b, 2 * b - dr.select(quarter == 2, 1.0, 0.0))

        def pick(*nodes):
            return dr.select(
                quarter == 0,
                mi.UInt32(nodes[0]),
                dr.select(
                    quarter == 1, mi.UInt32(nodes[1]), dr.select(quarter == 2, mi.UInt32(nodes[2]), mi.UInt32(nodes[3]))
                ),
            )

        walled = active & dr.gather(mi.Bool, self.walled, leaf, active)
        x = e.model.above(dr.gather(mi.UInt32, e.patch, leaf, active), u, v)
        total, seen, weights = mi.Color3f(0), mi.Color3f(0), mi.Float(0)
        for nodes, weight in (((0, 5, 4, 3), 1 - a - b), ((5, 1, 3, 4), a), ((4, 3, 2, 5), b)):
            node = 6 * leaf + pick(*nodes)
            value = dr.gather(mi.Color3f, self.nodes, node, active)
            hidden = e.model.blocked(x, dr.gather(mi.Point3f, self.points, node, walled), walled)
            total, seen = total + value * weight, seen + dr.select(hidden, 0, value * weight)
            weights += dr.select(hidden, 0, weight)
        return dr.select(walled & (weights > FAINT), seen / weights, total)


class _Topology:
    """Vertices of the mesh of leaves, level by level.

    Vertices are numbers below ``count``; corner[k] (UInt32 [elements]) are the vertices of an
    element, middle[k] (UInt32 [elements]) those on the side opposite corner k, NONE where no element
    is split there.
    """

    def __init__(self, elements, leaves):
        self.elements, self.leaves = elements, leaves
        n, roots = len(elements), elements.model.count
        vertex, self.count = _weld(elements.model)
        self.corner = [dr.full(mi.UInt32, NONE, n) for _ in range(3)]
        self.middle = [dr.full(mi.UInt32, NONE, n) for _ in range(3)]
        self.halved = []  # per level: vertices in the middle of straight sides, and the ends of those
        level = dr.arange(mi.UInt32, roots)
        for corner, ids in zip(self.corner, vertex):
            dr.scatter(corner, ids, level)
        straight = mi.UInt64(0xFFFFFFFFFFFFFFFF)  # sides that must not bend, as sorted keys
        while dr.width(level):
            level, straight = self._next_level(level, straight)
        self._place_vertices()

    def _place_vertices(self):
        """Where vertices are, just inside of the first element that has them (Point3f [vertices])."""
        e, every = self.elements, dr.arange(mi.UInt32, len(self.elements))
        self._point, first = dr.zeros(mi.Point3f, self.count), dr.full(mi.UInt32, NONE, self.count)
        for corner in self.corner:
            dr.scatter_reduce(dr.ReduceOp.Min, first, every, corner, mode=dr.ReduceMode.Direct)
        for corner, place in zip(self.corner, NODES):
            point = e.model.above(e.patch, *e.node_point(every, *place))
            dr.scatter(self._point, point, corner, dr.gather(mi.UInt32, first, corner) == every)
        dr.eval(self._point)

    def _next_level(self, level, straight):
        """Number the middle vertices of the elements ``level``; returns their children and straight sides."""
        corner = [dr.gather(mi.UInt32, c, level) for c in self.corner]
        sides = [(corner[1], corner[2]), (corner[2], corner[0]), (corner[0], corner[1])]
        keys = [_side_keys(a, b) for a, b in sides]
        dr.eval(keys)
        child = dr.gather(mi.UInt32, self.elements.child, level)
        parents = dr.compress(child != 0)
        if dr.width(parents) == 0:
            return mi.UInt32(), straight
        table = unique(concat(*(dr.gather(mi.UInt64, k, parents) for k in keys)))
        middle = []
        for k, key in enumerate(keys):
            at = lower_bound(table, key)
            middle.append(dr.select(dr.gather(mi.UInt64, table, at) == key, opaque_index(self.count) + at, NONE))
            dr.scatter(self.middle[k], middle[k], level)
        dr.eval(middle)

        # ---- Sides that must stay straight: those already so, and halves of bent sides of leaves ----
        number = opaque_index(self.count) + dr.arange(mi.UInt32, dr.width(table))
        at = lower_bound(straight, table)
        held = dr.compress(dr.gather(mi.UInt64, straight, at) == table)
        halves = []
        if dr.width(held):
            ends, held = dr.gather(mi.UInt64, table, held), dr.gather(mi.UInt32, number, held)
            low, high = mi.UInt32(ends >> 32), mi.UInt32(ends)
            dr.eval(low, high, held)
            self.halved.append((held, low, high))
            halves = [_side_keys(low, held), _side_keys(held, high)]
        for m, (a, b) in zip(middle, sides):
            bent = dr.compress((child == 0) & (m != NONE))
            if dr.width(bent):
                m, a, b = (dr.gather(mi.UInt32, x, bent) for x in (m, a, b))
                halves += [_side_keys(a, m), _side_keys(m, b)]
        straight = unique(concat(*halves)) if halves else mi.UInt64(0xFFFFFFFFFFFFFFFF)
        self.count += dr.width(table)

        # ---- Corners of the children ----
        child, c, m = (
            dr.gather(mi.UInt32, child, parents),
            [dr.gather(mi.UInt32, x, parents) for x in corner],
            [dr.gather(mi.UInt32, x, parents) for x in middle],
        )
        for k, vertices in enumerate(((c[0], m[2], m[1]), (m[2], c[1], m[0]), (m[1], m[0], c[2]), (m[0], m[1], m[2]))):
            for corner, ids in zip(self.corner, vertices):
                dr.scatter(corner, ids, child + k)
        dr.eval(self.corner, self.middle)
        j = dr.arange(mi.UInt32, 4 * dr.width(parents))
        return dr.gather(mi.UInt32, child, j // 4) + j % 4, straight

    def spread(self, H):
        """Vertex values from leaf values: averages over the leaves around (Color3f [vertices]).

        A leaf counts by its angle at the vertex over its size, which is right for linear fields next
        to a hanging vertex, and by the share of it that can be seen; not at all at vertices across a wall.
        """
        e = self.elements
        patch = dr.gather(mi.UInt32, e.patch, self.leaves)
        e1, e2 = dr.gather(mi.Vector3f, e.model.e1, patch), dr.gather(mi.Vector3f, e.model.e2, patch)
        sides = (e1, e2), (e2 - e1, -e1), (-e2, e1 - e2)
        area = dr.gather(mi.Float, e.area, self.leaves)
        size, seen = dr.sqrt(area), dr.gather(mi.Float, e.open_area, self.leaves) / area
        across = dr.gather(mi.UInt32, e.across, self.leaves)
        bound = [2 * t for t in totals([mi.Float64(dr.abs(h)) / mi.Float64(size) * 16 for h in H])]
        sums, weights = (
            ColorSums(self.count, bound),
            ColorSums(self.count, 3 * [20 * totals([1 / mi.Float64(size)])[0]]),
        )
        for k, (a, b) in enumerate(sides):
            weight = dr.atan2(dr.norm(dr.cross(a, b)), dr.dot(a, b)) / size * seen
            for node, vertex, w in ((k, self.corner[k], weight), (k + 3, self.middle[k], dr.pi / size * seen)):
                index = dr.select((across & (1 << node)) == 0, dr.gather(mi.UInt32, vertex, self.leaves), NONE)
                sums.add([h * w for h in H], index, index != NONE)
                weights.add([w, mi.Float(0), mi.Float(0)], index, index != NONE)
        every = dr.arange(mi.UInt32, self.count)
        weight = weights.gather(every)[0]
        result = mi.Color3f(*(mi.Float(dr.select(weight > 0, s / weight, 0)) for s in sums.gather(every)))
        dr.eval(result)
        return result

    def straighten(self, values):
        """Put vertices in the middle of straight sides on the line between their ends."""
        for vertex, low, high in self.halved:
            dr.scatter(values, self._between(values, low, high), vertex)
            dr.eval(values)
        return values

    def _between(self, values, low, high, active=True):
        """The value in the middle of straight sides: the mean of the ends, or that of the one a wall leaves in sight (Color3f [n])."""
        a, b = (dr.gather(mi.Color3f, values, end) for end in (low, high))
        start, end = (dr.gather(mi.Point3f, self._point, k) for k in (low, high))
        no_a, no_b = (self.elements.model.blocked(0.5 * (start + end), x, active) for x in (start, end))
        return dr.select(no_a & ~no_b, b, dr.select(no_b & ~no_a, a, 0.5 * (a + b)))

    def node_points(self):
        """Where the nodes of leaves are (six Point3f [leaves])."""

        def halfway(low, high, active):
            return 0.5 * (dr.gather(mi.Point3f, self._point, low) + dr.gather(mi.Point3f, self._point, high))

        nodes = self._nodes(self._point, halfway)
        dr.eval(nodes)
        return nodes

    def find_walls(self, nodes):
        """Does a wall stand on a side of a leaf (Bool [leaves])? Both leaves of a side find the same."""
        walled = dr.full(mi.Bool, False, dr.width(self.leaves))
        for a, b in ((0, 5), (5, 1), (1, 3), (3, 2), (2, 4), (4, 0)):
            walled |= self.elements.model.blocked(nodes[a], nodes[b], ~walled)
        return walled

    def node_values(self, values):
        """The six node values of every leaf (six Color3f [leaves])."""
        return self._nodes(values, lambda low, high, active: self._between(values, low, high, active))

    def _nodes(self, table, straight):
        """What ``table`` says of the nodes of leaves, ``straight`` being asked for the middles of straight sides (six of its kind [leaves])."""
        corner = [dr.gather(mi.UInt32, c, self.leaves) for c in self.corner]
        nodes = [dr.gather(type(table), table, c) for c in corner]
        for k in range(3):
            index = dr.gather(mi.UInt32, self.middle[k], self.leaves)
            bent = index != NONE
            nodes.append(
                dr.select(
                    bent,
                    dr.gather(type(table), table, index, bent),
                    straight(corner[(k + 1) % 3], corner[(k + 2) % 3], ~bent),
                )
            )
        return nodes

    def mean(self, values):
        """Mean of the displayed field over each leaf (Color3f [leaves])."""
        n = self.node_values(values)
        return (n[0] + n[1] + n[2]) / 12 + (n[3] + n[4] + n[5]) / 4


def _side_keys(a, b):
    return (mi.UInt64(dr.minimum(a, b)) << 32) | mi.UInt64(dr.maximum(a, b))


def _weld(model):
    """One vertex number per corner of the patches (three UInt32 [patches]), and how many there are.

    Corners are one vertex if position and shading normal are the same, to the bit and to 1/256.
    """
    face, back = model.face, model.back
    keys = []
    for k, (u, v) in enumerate(NODES[:3]):
        one = dr.full(mi.Float, 1, model.count)
        point = model.corner(k)
        normal = model.faces.surface(face, one * u, one * v).sh_frame.n * dr.select(back, -1, 1)
        key = mi.UInt64(0x9E3779B97F4A7C15)
        for x in point:
            key = _mix(key ^ mi.UInt64(dr.reinterpret_array(mi.UInt32, x + 0.0)))
        for x in normal:
            key = _mix(key ^ mi.UInt64(mi.UInt32(mi.Int32(dr.floor(x * 256 + 0.37)))))
        keys.append(key)
    dr.eval(keys)
    table = unique(concat(*keys))
    return [lower_bound(table, key) for key in keys], dr.width(table)


def _mix(key):
    """Finaliser of SplitMix64 (Steele, Lea, Flood 2014): every bit of the key reaches every other."""
    key = (key ^ (key >> 30)) * mi.UInt64(0xBF58476D1CE4E5B9)
    key = (key ^ (key >> 27)) * mi.UInt64(0x94D049BB133111EB)
    return key ^ (key >> 31)
