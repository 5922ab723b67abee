"""The element tree: patches split 1→4 into triangles."""

import drjit as dr
import mitsuba as mi

from ..core.points import hash_pair
from ..core.arrays import concat, opaque_index

NODES = (
    (0.0, 0.0),
    (1.0, 0.0),
    (0.0, 1.0),
    (0.5, 0.5),
    (0.0, 0.5),
    (0.5, 0.0),
)  # of an element: corners, and middles opposite them
TUCK = 2.0**-14  # how far inside of its element a node is when something is looked for between it and others
MAX_LEVEL = 14  # below it float32 barycentric coordinates get too coarse; 4 + 2 · 14 bits are a place


class Elements:
    """A forest of triangular elements, one root per patch; element k < patches is the root of patch k.

    An element covers the points (u, v) = (u₀ + s a, v₀ + s b), a, b ≥ 0, a + b ≤ 1, of its patch;
    s = ±2^(−level), negative for the middle child of four, which stands upside down.

    Arrays over elements: ``patch``, ``parent`` (its own number for roots), ``child`` (first of four
    children, 0 for leaves; UInt32), ``place`` (UInt32, where in its patch: the child numbers on the
    way down, two bits each from the top, then the level), ``u0``, ``v0``, ``scale`` (Float), ``area``
    and ``open_area`` (Float, m²; the second without what is covered, see `find_covered`),
    ``reflectance`` (Color3f, the mean over the element), ``divided`` (Bool) and ``across``
    (UInt32, a bit for each of the NODES of a leaf that a wall keeps from its light, see `find_divided`).
    """

    def __init__(self, model):
        n = model.count
        self.model = model
        self.patch = dr.arange(mi.UInt32, n)
        self.parent = dr.arange(mi.UInt32, n)
        self.child = dr.zeros(mi.UInt32, n)
        self.place = dr.zeros(mi.UInt32, n)
        self.u0, self.v0 = dr.zeros(mi.Float, n), dr.zeros(mi.Float, n)
        self.scale = dr.full(mi.Float, 1, n)
        self.area = self.open_area = mi.Float(model.area)
        self.reflectance = mi.Color3f(model.reflectance)
        self.divided, self.across = dr.zeros(mi.Bool, n), dr.zeros(mi.UInt32, n)
        self.leaves = n

    def __len__(self):
        return dr.width(self.patch)

    def leaf_indices(self):
        """Numbers of the leaves (UInt32 [leaves]), neighbours after neighbours, whichever was split first."""
        leaves = dr.compress(self.child == 0)
        patch, place = dr.gather(mi.UInt32, self.patch, leaves), dr.gather(mi.UInt32, self.place, leaves)
        return dr.gather(mi.UInt32, leaves, dr.argsort((mi.UInt64(patch) << 32) | mi.UInt64(place)))

    def key(self, element):
        """What random numbers of elements are drawn by: the same whatever else was split (UInt32 [n])."""
        return hash_pair(dr.gather(mi.UInt32, self.patch, element), dr.gather(mi.UInt32, self.place, element))

    def split(self, chosen):
        """Split the leaves ``chosen`` (UInt32 [n], no number twice)."""
        count = dr.width(chosen)
        if count == 0:
            return
        first = opaque_index(len(self)) + 4 * dr.arange(mi.UInt32, count)
        dr.scatter(self.child, first, chosen)
        k = dr.arange(mi.UInt32, 4 * count)
        parent, which = dr.gather(mi.UInt32, chosen, k // 4), k % 4
        patch = dr.gather(mi.UInt32, self.patch, parent)
        half = dr.gather(mi.Float, self.scale, parent) * 0.5
        u0 = dr.gather(mi.Float, self.u0, parent) + dr.select((which == 1) | (which == 3), half, 0)
        v0 = dr.gather(mi.Float, self.v0, parent) + dr.select(which >= 2, half, 0)
        scale = dr.select(which == 3, -half, half)
        reflectance = dr.gather(mi.Color3f, self.reflectance, parent)
        if self.model.textured:
            reflectance = self._mean_reflectance(patch, u0, v0, scale)
        self.patch = concat(self.patch, patch)
        self.parent = concat(self.parent, parent)
        self.child = concat(self.child, dr.zeros(mi.UInt32, 4 * count))
        place = dr.gather(mi.UInt32, self.place, parent)
        self.place = concat(self.place, place + 1 + (which << (2 + 2 * (MAX_LEVEL - (place & 15)))))
        self.u0, self.v0 = concat(self.u0, u0), concat(self.v0, v0)
        self.scale = concat(self.scale, scale)
        self.area = self.open_area = concat(self.area, dr.gather(mi.Float, self.area, parent) * 0.25)
        self.reflectance = concat(self.reflectance, reflectance)
        self.leaves += 3 * count
        dr.eval(
            self.patch, self.parent, self.child, self.place, self.u0, self.v0, self.scale, self.area, self.reflectance
        )

    def _mean_reflectance(self, patch, u0, v0, scale):
        """ρ averaged over four points of each element (Color3f)."""
        face, back = dr.gather(mi.UInt32, self.model.face, patch), dr.gather(mi.Bool, self.model.back, patch)
        total = mi.Color3f(0)
        for a, b in ((1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3), (1 / 3, 1 / 3)):
            total += self.model.faces.reflectance_at(face, u0 + scale * a, v0 + scale * b, back)
        return total / 4

    def locate(self, element, u, v):
        """Child number 0…3 of ``element`` that holds the patch point (u, v) (UInt32 [n])."""
        scale = dr.gather(mi.Float, self.scale, element)
        a = (u - dr.gather(mi.Float, self.u0, element)) / scale
        b = (v - dr.gather(mi.Float, self.v0, element)) / scale
        return child_at(a, b)

    @dr.syntax
    def leaf_at(self, element, u, v, active=True):
        """The leaf below ``element`` that holds the patch point (u, v) (UInt32 [n])."""
        element = mi.UInt32(element)
        child = dr.gather(mi.UInt32, self.child, element, active)
        while child != 0:
            element = child + self.locate(element, u, v)
            child = dr.gather(mi.UInt32, self.child, element)
        return element

    @dr.syntax
    def add_to_ancestors(self, sums, leaves, power):
        """Add values of leaves (three Float64) to themselves and to all their ancestors in ColorSums."""
        element = mi.UInt32(leaves)
        climbing = dr.full(mi.Bool, True, dr.width(leaves))
        while climbing:
            sums.add(power, element, climbing)
            parent = dr.gather(mi.UInt32, self.parent, element)
            climbing = parent != element
            element = parent

    @dr.syntax
    def mark_ancestors(self, marks, elements):
        """Set ``marks`` (Bool [elements]) of elements and of all their ancestors."""
        element = mi.UInt32(elements)
        climbing = dr.full(mi.Bool, True, dr.width(elements))
        while climbing:
            dr.scatter(marks, True, element, climbing)
            parent = dr.gather(mi.UInt32, self.parent, element)
            climbing = parent != element
            element = parent

    def node_point(self, element, a, b):
        """Patch coordinates (u, v) of a node (a, b) of elements: just off the walls that stand along their sides."""
        return self.patch_point(element, *((1 - TUCK) * x + TUCK / 3 for x in (a, b)))

    def in_sight(self, element, u, v, a, b, active=True):
        """Is nothing between patch points (u, v) of elements and their nodes (a, b) (Bool [n])?"""
        return ~self.model.walled(
            dr.gather(mi.UInt32, self.patch, element, active), u, v, *self.node_point(element, a, b), active
        )

    def patch_point(self, element, a, b):
        """Patch coordinates (u, v) of the element's own coordinates (a, b)."""
        scale = dr.gather(mi.Float, self.scale, element)
        return dr.gather(mi.Float, self.u0, element) + scale * a, dr.gather(mi.Float, self.v0, element) + scale * b


def child_at(a, b):
    """Which child holds a point (a, b) of an element; 3 is the middle one."""
    return dr.select(
        a >= 0.5, mi.UInt32(1), dr.select(b >= 0.5, mi.UInt32(2), dr.select(a + b <= 0.5, mi.UInt32(0), mi.UInt32(3)))
    )
