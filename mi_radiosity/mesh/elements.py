"""Elements: triangles that patches are split into, 1→4."""

from functools import cached_property

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import concat, opaque_index, owned, owned_vectors, totals
from ..core.points import hash_pair, triangle
from ..scene.lights import Lights
from ..scene.materials import WHITEST, Materials
from ..scene.patches import Patches
from .crown import Crown
from .subdivision import child_at, child_frame, child_point

MAX_LEVEL = 14  # below it float32 barycentric coordinates get too coarse; 4 + 2 · 14 bits are a place
ARRAYS = ("patch", "parent", "child", "place", "u0", "v0", "scale", "area", "reflectance")


class Elements:
    """A forest of triangular elements, one root per patch; element k < patches is the root of patch k. The next are the
    clusters of a `Crown`, if there is one: elements above patches, which no leaf of the mesh is.

    An element covers the points (u, v) = (u₀ + s a, v₀ + s b), a, b ≥ 0, a + b ≤ 1, of its patch;
    s = ±2^(−level), negative for the middle child of four, which stands upside down.

    Arrays over elements: ``patch``, ``parent`` (its own number for roots), ``child`` (first of four
    children, 0 for leaves; UInt32), ``place`` (UInt32, where in its patch: the child numbers on the
    way down, two bits each from the top, then the level), ``u0``, ``v0``, ``scale``, ``area`` (Float, m²) and
    ``reflectance`` (Color3f, the mean over the element). ``exitance`` (Color3f, the same of E) is there only in scenes
    with textured lamps, None in others. `Tree` grows; what its `freeze` returns never changes.
    """

    patches: Patches
    patch: "mi.UInt32"
    parent: "mi.UInt32"
    child: "mi.UInt32"
    place: "mi.UInt32"
    u0: "mi.Float"
    v0: "mi.Float"
    scale: "mi.Float"
    area: "mi.Float"
    reflectance: "mi.Color3f"
    exitance: "mi.Color3f | None"
    crown: Crown | None

    def __init__(
        self,
        patches: Patches,
        arrays: "dict[str, dr.ArrayBase]",
        exitance: "mi.Color3f | None" = None,
        crown: Crown | None = None,
    ) -> None:
        vars(self).update({name: arrays[name] for name in ARRAYS}, patches=patches, exitance=exitance, crown=crown)

    def __len__(self) -> int:
        return dr.width(self.patch)

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("a frozen mesh does not change: split its tree and freeze it again")

    @cached_property
    def leaves(self) -> "mi.UInt32":
        """Numbers of the leaves (UInt32 [leaves]), neighbours after neighbours, whichever was split first."""
        is_leaf = self.child == 0
        if self.crown:
            is_leaf &= ~self.crown.holds(dr.arange(mi.UInt32, len(self)))
        leaves = dr.compress(is_leaf)
        patch, place = dr.gather(mi.UInt32, self.patch, leaves), dr.gather(mi.UInt32, self.place, leaves)
        return dr.gather(mi.UInt32, leaves, dr.argsort((mi.UInt64(patch) << 32) | mi.UInt64(place)))

    def with_light(self, patches: Patches, exitance: "mi.Color3f | None") -> "Elements":
        """The same elements of patches that differ in their emission only."""
        other = Elements(patches, {name: getattr(self, name) for name in ARRAYS}, exitance, self.crown)
        vars(other)["leaves"] = self.leaves  # sorted once for all
        return other

    def level(self, element: "mi.UInt32") -> "mi.UInt32":
        """How often the patch was split (UInt32 [n])."""
        return dr.gather(mi.UInt32, self.place, element) & 15

    def key(self, element: "mi.UInt32") -> "mi.UInt32":
        """What random numbers of elements are drawn by: the same whatever else was split (UInt32 [n])."""
        return hash_pair(dr.gather(mi.UInt32, self.patch, element), dr.gather(mi.UInt32, self.place, element))

    def emission(self, element: "mi.UInt32") -> "mi.Color3f":
        """E, the mean over elements (Color3f [n])."""
        if self.exitance is not None:
            return dr.gather(mi.Color3f, self.exitance, element)
        return dr.gather(mi.Color3f, self.patches.emission, dr.gather(mi.UInt32, self.patch, element))

    def albedo(self, element: "mi.UInt32") -> "mi.Color3f":
        """ρ + τ, the share of the irradiance of elements that leaves diffusely on either side (Color3f [n])."""
        rho = dr.gather(mi.Color3f, self.reflectance, element)
        if self.patches.twin is None:
            return rho
        patch = dr.gather(mi.UInt32, self.patch, element)
        return rho + dr.gather(mi.Color3f, self.patches.transmittance, patch)

    def averaged_over_clusters(self, values: "mi.Color3f") -> "mi.Color3f":
        """``values`` of all elements, those of clusters replaced by area averages over their patches (Color3f
        [elements])."""
        if self.crown:
            patches = np.array(values).T[: self.patches.count].astype(np.float64)
            above = dr.arange(mi.UInt32, len(self.crown)) + opaque_index(self.patches.count)
            dr.scatter(values, owned_vectors(mi.Color3f, self.crown.means(patches)), above)
        return values

    def patch_point(self, element: "mi.UInt32", a: "mi.Float", b: "mi.Float") -> "tuple[mi.Float, mi.Float]":
        """Patch coordinates (u, v) of the element's own coordinates (a, b)."""
        scale = dr.gather(mi.Float, self.scale, element)
        return dr.gather(mi.Float, self.u0, element) + scale * a, dr.gather(mi.Float, self.v0, element) + scale * b

    def own_point(
        self, element: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool" = True
    ) -> "tuple[mi.Float, mi.Float]":
        """The element's own coordinates (a, b) of the patch point (u, v)."""
        scale = dr.select(active, dr.gather(mi.Float, self.scale, element, active), 1)
        a = (u - dr.gather(mi.Float, self.u0, element, active)) / scale
        return a, (v - dr.gather(mi.Float, self.v0, element, active)) / scale

    def locate(self, element: "mi.UInt32", u: "mi.Float", v: "mi.Float") -> "mi.UInt32":
        """Child number 0…3 of ``element`` that holds the patch point (u, v) (UInt32 [n])."""
        return child_at(*self.own_point(element, u, v))

    # ---- Elements of patches and clusters ------------------------------------------------------

    def root(self, patch: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.UInt32":
        """The number of the element that nothing is above, among all such (UInt32 [n])."""
        return patch if self.crown is None else dr.gather(mi.UInt32, self.crown.root_of, patch, active)

    def root_element(self, number: "mi.UInt32") -> "mi.UInt32":
        """The elements of these numbers (UInt32 [n])."""
        return number if self.crown is None else dr.gather(mi.UInt32, self.crown.roots, number)

    @property
    def roots(self) -> int:
        """How many elements nothing is above."""
        return self.patches.count if self.crown is None else dr.width(self.crown.roots)

    def points(self, element: "mi.UInt32", x0: "mi.Float", x1: "mi.Float") -> "tuple[mi.UInt32, mi.Float, mi.Float]":
        """Uniform points of elements from uniform numbers: patch, u, v (UInt32, two Float [n])."""
        patch = dr.gather(mi.UInt32, self.patch, element)
        if self.crown:
            above = self.crown.holds(element)
            member, rest = self.crown.pick(element, x0, above)
            patch, x0 = dr.select(above, member, patch), dr.select(above, rest, x0)
        return patch, *self.patch_point(element, *triangle(x0, x1))

    def part_at(self, element: "mi.UInt32", patch: "mi.UInt32", u: "mi.Float", v: "mi.Float") -> "mi.UInt32":
        """Which child of elements holds points of patches (UInt32 [n])."""
        if self.crown is None:
            return self.locate(element, u, v)
        above = self.crown.holds(element)
        return dr.select(above, self.crown.locate(element, patch, above), self.locate(element, u, v))

    def part(self, element: "mi.UInt32", number: "mi.UInt32") -> "mi.UInt32":
        """The child of split elements that has a number (UInt32 [n])."""
        child = dr.gather(mi.UInt32, self.child, element) + number
        if self.crown is None:
            return child
        above = self.crown.holds(element)
        return dr.select(above, self.crown.child(element, number, above), child)

    def parts(self, element: "mi.UInt32") -> "mi.UInt32":
        """How many children elements have once they are split (UInt32 [n])."""
        if self.crown is None:
            return dr.full(mi.UInt32, 4, dr.width(element))
        above = self.crown.holds(element)
        return dr.select(above, self.crown.children(element, above), 4)

    def top(self, patch: "mi.UInt32") -> "mi.UInt32":
        """The cluster that was not split above patches, or themselves where there is none (UInt32 [n])."""
        return patch if self.crown is None else self._top(self.crown, patch)

    @dr.syntax
    def _top(self, crown, patch):
        element = self.root_element(self.root(patch))
        above = crown.holds(element) & (dr.gather(mi.UInt32, self.child, element) != 0)
        while above:
            element = crown.child(element, crown.locate(element, patch, above), above)
            above = crown.holds(element) & (dr.gather(mi.UInt32, self.child, element) != 0)
        return element

    def leaf_at(self, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool" = True) -> "mi.UInt32":
        """The leaf that holds the point (u, v) of patches (UInt32 [n])."""
        return self._descend(patch, u, v, active)

    def leaf_below(
        self, element: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool" = True
    ) -> "mi.UInt32":
        """The leaf below ``element`` that holds the patch point (u, v) (UInt32 [n])."""
        return self._descend(element, *self.own_point(element, u, v, active), active)

    @dr.syntax
    def _descend(self, element: "mi.UInt32", a: "mi.Float", b: "mi.Float", active: "mi.Bool | bool") -> "mi.UInt32":
        """The leaf below ``element`` that holds its own point (a, b)."""
        element, a, b = mi.UInt32(element), mi.Float(a), mi.Float(b)
        child = dr.gather(mi.UInt32, self.child, element, active)
        while child != 0:
            which = child_at(a, b)
            a, b = child_point(which, a, b)
            element = child + which
            child = dr.gather(mi.UInt32, self.child, element)
        return element


class Tree(Elements):
    """Elements that still split. ``leaf_count`` is the number of those that have not; of patches below a cluster that
    has not, the cluster counts."""

    __setattr__ = object.__setattr__  # type: ignore[assignment]

    def __init__(
        self, patches: Patches, materials: Materials, lights: Lights, labels: "list[np.ndarray] | None" = None
    ) -> None:
        n = patches.count
        every = dr.arange(mi.UInt32, n)
        zero, nought = dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n)
        arrays = (every, every, zero, zero, nought, nought, dr.full(mi.Float, 1, n), patches.area, patches.reflectance)
        super().__init__(patches, {name: type(array)(array) for name, array in zip(ARRAYS, arrays)})
        self._materials, self._lights, self.leaf_count = materials, lights, n
        self._colored = n  # so many know their own ρ, the others that of their parent
        if lights.textured:
            self.exitance = mi.Color3f(patches.emission)
        crown = Crown(patches, labels) if labels else ()
        if len(crown):
            self._put_on(crown)

    def _put_on(self, crown):
        """Put clusters above the patches."""
        n, m = self.patches.count, len(crown)
        first = dr.gather(mi.UInt32, crown.member, crown.start)
        new = {name: dr.zeros(type(getattr(self, name)), m) for name in ARRAYS} | {
            "patch": first,
            "parent": opaque_index(n) + dr.arange(mi.UInt32, m),
            "place": (1 + crown.depth) << 4,  # no other element of the patch has it
            "scale": dr.full(mi.Float, 1, m),
            "area": owned(mi.Float, crown.area),
            "reflectance": owned_vectors(mi.Color3f, crown.means(np.array(self.reflectance).T)),
        }
        for name in ARRAYS:
            setattr(self, name, concat(getattr(self, name), new[name]))
        if self.exitance is not None:
            self.exitance = concat(self.exitance, dr.gather(mi.Color3f, self.exitance, first))
        self.crown, self.leaf_count, self._colored = crown, dr.width(crown.roots), n + m
        dr.eval(*self._arrays().values())

    @property
    def leaves(self) -> "mi.UInt32":
        raise AttributeError("a tree still grows: freeze it first")

    def freeze(self) -> Elements:
        """The elements as they are now; what the tree does later leaves them alone."""
        if self._materials.textured:
            self._color()
        arrays = {name: type(value)(value) for name, value in self._arrays().items()}
        exitance = None if self.exitance is None else mi.Color3f(self.exitance)
        return Elements(self.patches, arrays, exitance, self.crown)

    def _arrays(self):
        return {name: getattr(self, name) for name in ARRAYS}

    def split(self, chosen: "mi.UInt32") -> None:
        """Split the leaves ``chosen`` (UInt32 [n], no number twice)."""
        if self.crown:
            chosen = self._split_clusters(chosen)
        count = dr.width(chosen)
        if count == 0:
            return
        first = opaque_index(len(self)) + 4 * dr.arange(mi.UInt32, count)
        dr.scatter(self.child, first, chosen)
        k = dr.arange(mi.UInt32, 4 * count)
        new = self._children(dr.gather(mi.UInt32, chosen, k // 4), k % 4)
        for name in ARRAYS:
            setattr(self, name, concat(getattr(self, name), new[name]))
        if self._lights.textured:
            frame = (new[name] for name in ("patch", "u0", "v0", "scale"))
            self.exitance = concat(self.exitance, mean_exitance(self.patches, self._lights, *frame))
        self.leaf_count += 3 * count
        dr.eval(*self._arrays().values())

    def _split_clusters(self, chosen):
        """Split those of elements that are clusters; returns the others."""
        above = self.crown.holds(chosen)
        clusters = dr.gather(mi.UInt32, chosen, dr.compress(above))
        if dr.width(clusters):
            dr.scatter(self.child, mi.UInt32(1), clusters)
            self.leaf_count += int(totals([self.parts(clusters)])[0]) - dr.width(clusters)
        return dr.gather(mi.UInt32, chosen, dr.compress(~above))

    def _children(self, parent, which):
        """Arrays of the children ``which`` of elements."""
        patch, place = dr.gather(mi.UInt32, self.patch, parent), dr.gather(mi.UInt32, self.place, parent)
        frame = child_frame(which, *(dr.gather(mi.Float, x, parent) for x in (self.u0, self.v0, self.scale)))
        return {
            "patch": patch,
            "parent": parent,
            "child": dr.zeros(mi.UInt32, dr.width(parent)),
            "place": place + 1 + (which << (2 + 2 * (MAX_LEVEL - (place & 15)))),
            "u0": frame[0],
            "v0": frame[1],
            "scale": frame[2],
            "area": dr.gather(mi.Float, self.area, parent) * 0.25,
            "reflectance": dr.gather(mi.Color3f, self.reflectance, parent),
        }

    def _color(self):
        """Give new elements the ρ of their part of textures, all in one go. The others have that of their patch."""
        count = len(self) - self._colored
        if count:
            new = opaque_index(self._colored) + dr.arange(mi.UInt32, count)
            face = dr.gather(mi.UInt32, self.patches.face, dr.gather(mi.UInt32, self.patch, new))
            new = dr.gather(mi.UInt32, new, dr.compress(dr.gather(mi.UInt32, self._materials.varies, face) != 0))
        if count and dr.width(new):
            patch, *frame = (dr.gather(type(x), x, new) for x in (self.patch, self.u0, self.v0, self.scale))
            face, back = dr.gather(mi.UInt32, self.patches.face, patch), dr.gather(mi.Bool, self.patches.back, patch)
            rho = self._materials.mean_reflectance(face, back, *frame)
            dr.scatter(self.reflectance, dr.minimum(rho, WHITEST), new)
            dr.eval(self.reflectance)
        self._colored = len(self)


def mean_exitance(
    patches: Patches, lights: Lights, patch: "mi.UInt32", u0: "mi.Float", v0: "mi.Float", scale: "mi.Float"
) -> "mi.Color3f":
    """E averaged over triangles (u0 + scale a, v0 + scale b) of patches (Color3f [n])."""
    exitance = dr.zeros(mi.Color3f, dr.width(patch))
    shining = dr.compress(dr.max(dr.gather(mi.Color3f, patches.emission, patch)) > 0)
    if dr.width(shining):
        patch, u0, v0, scale = (dr.gather(type(x), x, shining) for x in (patch, u0, v0, scale))
        mean = lights.mean_exitance(dr.gather(mi.UInt32, patches.face, patch), u0, v0, scale)
        dr.scatter(exitance, mean, shining)
    dr.eval(exitance)
    return exitance
