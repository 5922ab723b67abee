"""Elements: triangles that patches are split into, 1→4."""

from functools import cached_property

import drjit as dr
import mitsuba as mi

from ..core.arrays import concat, opaque_index
from ..core.points import hash_pair
from .subdivision import child_at, child_frame

MAX_LEVEL = 14  # below it float32 barycentric coordinates get too coarse; 4 + 2 · 14 bits are a place
ARRAYS = ("patch", "parent", "child", "place", "u0", "v0", "scale", "area", "reflectance")


class Elements:
    """A forest of triangular elements, one root per patch; element k < patches is the root of patch k.

    An element covers the points (u, v) = (u₀ + s a, v₀ + s b), a, b ≥ 0, a + b ≤ 1, of its patch;
    s = ±2^(−level), negative for the middle child of four, which stands upside down.

    Arrays over elements: ``patch``, ``parent`` (its own number for roots), ``child`` (first of four
    children, 0 for leaves; UInt32), ``place`` (UInt32, where in its patch: the child numbers on the
    way down, two bits each from the top, then the level), ``u0``, ``v0``, ``scale``, ``area`` (Float, m²) and
    ``reflectance`` (Color3f, the mean over the element). `Tree` grows; what its `freeze` returns never changes.
    """

    patch: "mi.UInt32"
    parent: "mi.UInt32"
    child: "mi.UInt32"
    place: "mi.UInt32"
    u0: "mi.Float"
    v0: "mi.Float"
    scale: "mi.Float"
    area: "mi.Float"
    reflectance: "mi.Color3f"

    def __init__(self, patches, arrays):
        self.patches = patches
        for name in ARRAYS:
            setattr(self, name, arrays[name])

    def __len__(self):
        return dr.width(self.patch)

    def __setattr__(self, name, value):
        if "_frozen" in vars(self):
            raise AttributeError("a frozen mesh does not change: split its tree and freeze it again")
        super().__setattr__(name, value)

    @cached_property
    def leaves(self):
        """Numbers of the leaves (UInt32 [leaves]), neighbours after neighbours, whichever was split first."""
        leaves = dr.compress(self.child == 0)
        patch, place = dr.gather(mi.UInt32, self.patch, leaves), dr.gather(mi.UInt32, self.place, leaves)
        return dr.gather(mi.UInt32, leaves, dr.argsort((mi.UInt64(patch) << 32) | mi.UInt64(place)))

    def with_patches(self, patches) -> "Elements":
        """The same elements, frozen, of patches that differ in their light only."""
        self.leaves  # noqa: B018  sorted once for all
        other = object.__new__(Elements)
        other.__dict__.update(self.__dict__ | {"patches": patches})
        return other

    def level(self, element):
        """How often the patch was split (UInt32 [n])."""
        return dr.gather(mi.UInt32, self.place, element) & 15

    def key(self, element):
        """What random numbers of elements are drawn by: the same whatever else was split (UInt32 [n])."""
        return hash_pair(dr.gather(mi.UInt32, self.patch, element), dr.gather(mi.UInt32, self.place, element))

    def emission(self, element):
        """E (Color3f [n])."""
        return dr.gather(mi.Color3f, self.patches.emission, dr.gather(mi.UInt32, self.patch, element))

    def patch_point(self, element, a, b):
        """Patch coordinates (u, v) of the element's own coordinates (a, b)."""
        scale = dr.gather(mi.Float, self.scale, element)
        return dr.gather(mi.Float, self.u0, element) + scale * a, dr.gather(mi.Float, self.v0, element) + scale * b

    def own_point(self, element, u, v, active=True):
        """The element's own coordinates (a, b) of the patch point (u, v)."""
        scale = dr.select(active, dr.gather(mi.Float, self.scale, element, active), 1)
        a = (u - dr.gather(mi.Float, self.u0, element, active)) / scale
        return a, (v - dr.gather(mi.Float, self.v0, element, active)) / scale

    def locate(self, element, u, v):
        """Child number 0…3 of ``element`` that holds the patch point (u, v) (UInt32 [n])."""
        return child_at(*self.own_point(element, u, v))

    @dr.syntax
    def leaf_at(self, element, u, v, active=True):
        """The leaf below ``element`` that holds the patch point (u, v) (UInt32 [n])."""
        element = mi.UInt32(element)
        child = dr.gather(mi.UInt32, self.child, element, active)
        while child != 0:
            element = child + self.locate(element, u, v)
            child = dr.gather(mi.UInt32, self.child, element)
        return element


class Tree(Elements):
    """Elements that still split. ``leaf_count`` is the number of leaves."""

    def __init__(self, patches, materials):
        n = patches.count
        every = dr.arange(mi.UInt32, n)
        zero, nought = dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n)
        arrays = (every, every, zero, zero, nought, nought, dr.full(mi.Float, 1, n), patches.area, patches.reflectance)
        super().__init__(patches, {name: type(array)(array) for name, array in zip(ARRAYS, arrays)})
        self._materials, self.leaf_count = materials, n

    @property
    def leaves(self):
        raise AttributeError("a tree still grows: freeze it first")

    def freeze(self) -> Elements:
        """The elements as they are now; what the tree does later leaves them alone."""
        elements = Elements(self.patches, {name: type(value)(value) for name, value in self._arrays().items()})
        elements._frozen = True
        return elements

    def _arrays(self):
        return {name: getattr(self, name) for name in ARRAYS}

    def split(self, chosen):
        """Split the leaves ``chosen`` (UInt32 [n], no number twice)."""
        count = dr.width(chosen)
        if count == 0:
            return
        first = opaque_index(len(self)) + 4 * dr.arange(mi.UInt32, count)
        dr.scatter(self.child, first, chosen)
        k = dr.arange(mi.UInt32, 4 * count)
        new = self._children(dr.gather(mi.UInt32, chosen, k // 4), k % 4)
        for name in ARRAYS:
            setattr(self, name, concat(getattr(self, name), new[name]))
        self.leaf_count += 3 * count
        dr.eval(*self._arrays().values())

    def _children(self, parent, which):
        """Arrays of the children ``which`` of elements."""
        patch, place = dr.gather(mi.UInt32, self.patch, parent), dr.gather(mi.UInt32, self.place, parent)
        frame = child_frame(which, *(dr.gather(mi.Float, x, parent) for x in (self.u0, self.v0, self.scale)))
        reflectance = dr.gather(mi.Color3f, self.reflectance, parent)
        if self._materials.textured:
            reflectance = self._mean_reflectance(patch, *frame)
        return {
            "patch": patch,
            "parent": parent,
            "child": dr.zeros(mi.UInt32, dr.width(parent)),
            "place": place + 1 + (which << (2 + 2 * (MAX_LEVEL - (place & 15)))),
            "u0": frame[0],
            "v0": frame[1],
            "scale": frame[2],
            "area": dr.gather(mi.Float, self.area, parent) * 0.25,
            "reflectance": reflectance,
        }

    def _mean_reflectance(self, patch, u0, v0, scale):
        """ρ averaged over four points of each element (Color3f)."""
        face, back = dr.gather(mi.UInt32, self.patches.face, patch), dr.gather(mi.Bool, self.patches.back, patch)
        total = mi.Color3f(0)
        for a, b in ((1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3), (1 / 3, 1 / 3)):
            total += self._materials.reflectance_at(face, u0 + scale * a, v0 + scale * b, back)
        return total / 4
