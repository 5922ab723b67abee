"""Irradiance as a continuous field over each flat or smooth surface (Gouraud)."""

from typing import Any  # a Solution has a Field

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, ColorSums, totals
from ..mesh.exposure import node_point
from ..mesh.subdivision import HALF_SIDES, child_at, child_corner, child_point
from ..mesh.vertices import Vertices

FAINT = 1e-4  # weight below which a node has no say


class Field:
    """Irradiance H(x), W/m², piecewise linear and continuous over surfaces, of a Solution.

    A leaf is shown by six nodes, its corners and the middles of its sides: a side whose neighbour is
    split bends at the middle vertex, another is straight. Where the neighbour is finer still, its
    vertices between the nodes lie on the straight line between them. So no side shows a crack.

    Where a wall stands on a leaf, each side of it is shown by the nodes on that side that light came down in sight
    of; and where there is none, by the leaf's own value if light came down in sight of the point itself.

    irradiance: of the elements (Color3f [elements]), by default all of the solution's.
    walled: which leaves a wall stands on (Bool [elements]). vertices: the Vertices of the mesh, with values
    (Color3f [vertices]). nodes: six Color3f per element, [6 · elements]. NaN for those that nothing is known of.
    """

    def __init__(self, solution: Any, irradiance: "mi.Color3f | None" = None) -> None:
        self._landings, self._elements = solution.landings, solution.elements
        self._rays, self._exposure = solution.model.rays, solution.exposure
        self.flat = solution.direct + solution.indirect if irradiance is None else irradiance
        leaves = self._elements.leaves
        H = self.of_leaves
        self.vertices = Vertices(solution.model, self._elements)
        self._dark_nodes = self._nodes_away_from_light(leaves, dr.max(H) > 0) | self._nodes_behind_walls(leaves)
        values = self._spread(H)
        lost = dr.select(self._dark_nodes == 0, H - self._mean(values), 0)  # by averaging
        self.values = self._straightened(dr.maximum(values + self._spread(lost), 0))
        self._store(self.values)

    def _store(self, values):
        n, leaves = len(self._elements), self._elements.leaves
        self.nodes, self._points = dr.full(mi.Color3f, dr.nan, 6 * n), dr.zeros(mi.Point3f, 6 * n)
        points = self.vertices.nodes(self.vertices.point, self._half_way)
        for k, (color, point) in enumerate(zip(self._lit_alone(self._node_values(values)), points)):
            dr.scatter(self.nodes, color, 6 * leaves + k)
            dr.scatter(self._points, point, 6 * leaves + k)
        self.walled = dr.zeros(mi.Bool, n)
        walled = dr.full(mi.Bool, False, dr.width(leaves))
        for a, b in HALF_SIDES:  # both leaves of a side find the same
            walled |= self._rays.blocked(points[a], points[b], ~walled)
        dr.scatter(self.walled, walled | (self._dark_nodes != 0), leaves)
        dr.eval(self.nodes, self._points, self.walled)

    def _lit_alone(self, nodes):
        """``nodes`` of leaves, the middles of straight sides borrowed from no end that is away from the leaf's light:
        from the other one, or from the leaf itself (six Color3f [leaves])."""
        leaves = self._elements.leaves
        own = self.of_leaves
        dark = [(self._dark_nodes & (1 << k)) != 0 for k in range(6)]
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            lit = ~dark[k + 3] & (dr.gather(mi.UInt32, self.vertices.middle[k], leaves) == NONE)
            ends = dr.select(dark[a], dr.select(dark[b], own, nodes[b]), nodes[a])
            nodes[k + 3] = dr.select(lit & (dark[a] | dark[b]), ends, nodes[k + 3])
        return nodes

    @property
    def of_leaves(self) -> "mi.Color3f":
        """H of the leaves themselves (Color3f [leaves])."""
        return dr.gather(mi.Color3f, self.flat, self._elements.leaves)

    # ---- Looking up ----------------------------------------------------------------------------

    def at(self, leaf: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool" = True) -> "mi.Color3f":
        """H at patch points (u, v) on leaves (Color3f [n])."""
        e = self._elements
        a, b = e.own_point(leaf, u, v, active)
        quarter = child_at(a, b)
        a, b = child_point(quarter, a, b)
        walled = active & dr.gather(mi.Bool, self.walled, leaf, active)
        x = e.patches.above(dr.gather(mi.UInt32, e.patch, leaf, active), u, v)
        total, seen, weights, unknown = mi.Color3f(0), mi.Color3f(0), mi.Float(0), mi.Float(0)
        for corner, weight in enumerate((1 - a - b, a, b)):
            node = 6 * leaf + child_corner(quarter, corner)
            value = dr.gather(mi.Color3f, self.nodes, node, active)
            known = ~dr.isnan(value.x)
            value = dr.select(known, value, 0)
            hidden = ~known | self._rays.blocked(x, dr.gather(mi.Point3f, self._points, node, walled), walled & known)
            total, seen = total + value * weight, seen + dr.select(hidden, 0, value * weight)
            weights, unknown = weights + dr.select(hidden, 0, weight), unknown + dr.select(known, 0, weight)
        alone = walled & (weights <= FAINT)
        lost = alone & (unknown > FAINT)
        total = dr.select(lost, self._without_nodes(leaf, x, total, lost), total)
        return dr.select(walled & ~alone, seen / weights, total)

    def _without_nodes(self, leaf, x, total, active):
        """H at points x of walled leaves that see no node, and know nothing of some: the leaf's own if light came down
        in sight, nothing if it came down elsewhere, and ``total`` where that is not known (Color3f [n])."""
        landings = self._landings
        if landings.slots == 0:
            return total
        slot = dr.gather(mi.UInt32, self._exposure.slot, leaf, active)
        own = dr.gather(mi.Color3f, self.flat, leaf, active)
        landed = landings.any_on(slot, active)
        seen = landings.in_sight(self._elements, self._rays, leaf, slot, x, landed)
        return dr.select(seen, own, dr.select(landed, 0, total))

    # ---- Building ------------------------------------------------------------------------------

    def _nodes_away_from_light(self, leaves, lit):
        """Nodes of crossed leaves that no light came down in sight of, a bit for each (UInt32 [leaves])."""
        dark, landings = dr.zeros(mi.UInt32, dr.width(leaves)), self._landings
        if landings.slots == 0:
            return dark
        chosen = dr.compress(landings.any_on(dr.gather(mi.UInt32, self._exposure.slot, leaves), lit))
        if dr.width(chosen) == 0:
            return dark
        leaf, bits = dr.gather(mi.UInt32, leaves, chosen), mi.UInt32(0)
        slot, every = dr.gather(mi.UInt32, self._exposure.slot, leaf), dr.full(mi.Bool, True, dr.width(leaf))
        for node in range(6):
            point = node_point(self._elements, leaf, node)
            seen = landings.in_sight(self._elements, self._rays, leaf, slot, point, every)
            bits |= dr.select(seen, mi.UInt32(0), 1 << node)
        dr.scatter(dark, bits, chosen)
        dr.eval(dark)
        return dark

    def _nodes_behind_walls(self, leaves):
        """Nodes of leaves whose vertex stands on the other side of a wall, where leaves of one plane meet, a bit for
        each (UInt32 [leaves])."""
        patches, bits = self._elements.patches, dr.zeros(mi.UInt32, dr.width(leaves))
        normal = dr.gather(mi.Vector3f, patches.normal, dr.gather(mi.UInt32, self._elements.patch, leaves))
        for node, vertex in enumerate((*self.vertices.corner, *self.vertices.middle)):
            index = dr.gather(mi.UInt32, vertex, leaves)
            there = dr.gather(mi.Point3f, self.vertices.point, index, index != NONE)
            here = node_point(self._elements, leaves, node)
            level = (index != NONE) & (dr.abs(dr.dot(there - here, normal)) < 0.25 * patches.lift)
            hidden = self._rays.blocked(here, there, level)
            bits |= dr.select(hidden, mi.UInt32(1 << node), 0)
        dr.eval(bits)
        return bits

    def _spread(self, H):
        """Vertex values from leaf values: averages over the leaves around (Color3f [vertices]).

        A leaf counts by its angle at the vertex over its size, which is right for linear fields next
        to a hanging vertex, and by the share of it that is open; not at all at vertices away from its light.
        """
        e, v = self._elements, self.vertices
        area = dr.gather(mi.Float, e.area, e.leaves)
        size, share = dr.sqrt(area), self._exposure.open_share(e, e.leaves)
        bound = [2 * t for t in totals([mi.Float64(dr.abs(h)) / mi.Float64(size) * 16 for h in H])]
        sums = ColorSums(v.count, bound)
        weights = ColorSums(v.count, 3 * [20 * totals([1 / mi.Float64(size)])[0]])
        angles = _angles(e)
        for node, vertex in enumerate((*v.corner, *v.middle)):
            weight = (angles[node] if node < 3 else dr.pi) / size * share
            index = dr.gather(mi.UInt32, vertex, e.leaves)
            counts = (index != NONE) & ((self._dark_nodes & (1 << node)) == 0)
            sums.add([h * weight for h in H], index, counts)
            weights.add([weight, mi.Float(0), mi.Float(0)], index, counts)
        every = dr.arange(mi.UInt32, v.count)
        weight = weights.gather(every)[0]
        result = mi.Color3f(*(mi.Float(dr.select(weight > 0, s / weight, dr.nan)) for s in sums.gather(every)))
        dr.eval(result)
        return result

    def _straightened(self, values):
        """``values`` with hanging vertices on the line between the ends of their side."""
        for vertex, low, high in self.vertices.straight:
            dr.scatter(values, self._between(values, low, high, True), vertex)
            dr.eval(values)
        return values

    def _between(self, values, low, high, active):
        """The value in the middle of straight sides: the mean of the ends, or that of the one that is in sight, and
        known of (Color3f [n])."""
        a, b = (dr.gather(mi.Color3f, values, end) for end in (low, high))
        start, end = (dr.gather(mi.Point3f, self.vertices.point, k) for k in (low, high))
        middle = 0.5 * (start + end)
        no_a, no_b = (self._rays.blocked(middle, x, active) for x in (start, end))
        # NaN where the only end in sight is one that nothing is known of.
        return dr.select(no_a & ~no_b, b, dr.select(no_b & ~no_a, a, _mean_of_known(a, b)))

    def _half_way(self, low, high, active):
        return 0.5 * (
            dr.gather(mi.Point3f, self.vertices.point, low) + dr.gather(mi.Point3f, self.vertices.point, high)
        )

    def _node_values(self, values):
        """The six node values of every leaf (six Color3f [leaves])."""
        return self.vertices.nodes(values, lambda low, high, active: self._between(values, low, high, active))

    def _mean(self, values):
        """Mean of the displayed field over each leaf (Color3f [leaves])."""
        n = [dr.select(dr.isnan(value.x), 0, value) for value in self._node_values(values)]
        return (n[0] + n[1] + n[2]) / 12 + (n[3] + n[4] + n[5]) / 4


def _mean_of_known(a, b):
    return 0.5 * (dr.select(dr.isnan(a.x), b, a) + dr.select(dr.isnan(b.x), a, b))


def _angles(elements):
    """Angles of the leaves at their corners (three Float [leaves])."""
    patch = dr.gather(mi.UInt32, elements.patch, elements.leaves)
    e1, e2 = (dr.gather(mi.Vector3f, e, patch) for e in (elements.patches.e1, elements.patches.e2))
    sides = (e1, e2), (e2 - e1, -e1), (-e2, e1 - e2)
    return [dr.atan2(dr.norm(dr.cross(a, b)), dr.dot(a, b)) for a, b in sides]
