"""Elements above the faces: where faces are smaller than what the light needs, clusters of them are elements, too."""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import lower_bound_within, opaque_index, owned
from ..scene.patches import Patches


class Crown:
    """Clusters of patches inside of larger clusters, as elements above those of the patches. Immutable.

    Cluster c is element ``patches.count`` + c. Its patches are those at places ``start`` to ``end`` of ``member``; its
    parts, clusters and patches, are ``parts`` of them from ``first`` on in ``part`` (all UInt32). ``area`` (float64
    [clusters], m²). ``roots`` (UInt32): elements that no cluster is above, and ``root_of`` (UInt32 [patches]) their
    number.

    labels: of the patches, the same for those of one cluster, the largest clusters first (int [patches] each); kept.
    Source: Willmott, Heckbert, Garland: "Face cluster radiosity", 1999.
    """

    def __init__(self, patches: Patches, labels: Sequence[np.ndarray]) -> None:
        self._patches, self.labels, nest = patches.count, labels, _Nest(labels)
        self._area = np.array(patches.area, dtype=np.float64)[nest.member]
        until = np.concatenate([[0], np.cumsum(self._area)])
        start, end, depth = nest.clusters.T
        parent, order, part = nest.parts.T
        parts = np.bincount(parent - patches.count, minlength=len(start))
        self.area = until[end] - until[start]
        self.start, self.end, self.depth = (owned(mi.UInt32, x) for x in (start, end, depth))
        self.first, self.parts = owned(mi.UInt32, np.cumsum(parts) - parts), owned(mi.UInt32, parts)
        self.part = owned(mi.UInt32, part[np.lexsort([order, parent])])
        self.member, self.roots = owned(mi.UInt32, nest.member), owned(mi.UInt32, nest.roots)
        back = np.argsort(nest.member)  # from places to patches
        self.root_of, self._ways = owned(mi.UInt32, nest.root_of[back]), owned(mi.UInt32, nest.ways[:, back].ravel())
        self._until, self._rows = owned(mi.Float64, until), (nest.member, start, end)

    def __len__(self) -> int:
        return dr.width(self.start)

    def holds(self, element: "mi.UInt32") -> "mi.Bool":
        """Are elements clusters (Bool [n])?"""
        return element - opaque_index(self._patches) < opaque_index(len(self))  # others are below, and wrap around

    def locate(self, element: "mi.UInt32", patch: "mi.UInt32", active: "mi.Bool") -> "mi.UInt32":
        """Which part of clusters ``element`` patches are in (UInt32 [n])."""
        depth = dr.gather(mi.UInt32, self.depth, element - opaque_index(self._patches), active)
        return dr.gather(mi.UInt32, self._ways, depth * opaque_index(self._patches) + patch, active)

    def child(self, element: "mi.UInt32", number: "mi.UInt32", active: "mi.Bool") -> "mi.UInt32":
        """The part of clusters that has a number (UInt32 [n])."""
        first = dr.gather(mi.UInt32, self.first, element - opaque_index(self._patches), active)
        return dr.gather(mi.UInt32, self.part, first + number, active)

    def children(self, element: "mi.UInt32", active: "mi.Bool") -> "mi.UInt32":
        """How many parts clusters have (UInt32 [n])."""
        return dr.gather(mi.UInt32, self.parts, element - opaque_index(self._patches), active)

    def pick(self, element: "mi.UInt32", lot: "mi.Float", active: "mi.Bool") -> "tuple[mi.UInt32, mi.Float]":
        """A patch of clusters, drawn by area with ``lot`` in [0, 1) and what is left of the lot (UInt32, Float [n])."""
        cluster = element - opaque_index(self._patches)
        start, end = (dr.gather(mi.UInt32, x, cluster, active) for x in (self.start, self.end))
        low, high = (dr.gather(mi.Float64, self._until, x, active) for x in (start, end))
        place = low + mi.Float64(lot) * (high - low)
        at = lower_bound_within(self._until, place, start + 1, end, active) - 1
        below, above = (dr.gather(mi.Float64, self._until, at + k, active) for k in (0, 1))
        rest = dr.clip(mi.Float((place - below) / dr.maximum(above - below, 1e-300)), 0, 1 - 2.0**-24)
        return dr.gather(mi.UInt32, self.member, at, active), rest

    def means(self, values: np.ndarray) -> np.ndarray:
        """Values of patches averaged over clusters by area [patches, 3] ─► [clusters, 3]."""
        member, start, end = self._rows
        until = np.concatenate([np.zeros((1, 3)), np.cumsum(values[member] * self._area[:, None], axis=0)])
        return (until[end] - until[start]) / self.area[:, None]


class _Nest:
    """Patches in an order in which every cluster is a run of places: ``member`` [places].

    Per cluster: where it starts and ends, and how many clusters it is in (``clusters`` [n, 3]). Per part: the cluster,
    its number there, and the element that it is (``parts`` [n, 3]). Per place: the number of the part it is in of the
    k-th cluster that it is in (``ways`` [k, places]), and of the root (``root_of``) among ``roots``.
    """

    def __init__(self, labels: Sequence[np.ndarray]) -> None:
        n = len(labels[0])
        self.member = np.lexsort(labels[::-1])
        self.ways = np.zeros((len(labels) + 1, n), dtype=np.uint32)
        element, size, depth = np.full(n, -1), np.full(n, n + 1), np.zeros(n, dtype=np.int64)  # by place, so far
        clusters: list[np.ndarray] = []
        parts: list[np.ndarray] = []
        count = 0
        for label in [*labels, np.arange(n)]:
            start = np.flatnonzero(np.diff(label[self.member], prepend=-1))
            width = np.diff(start, append=n)
            new, single = width < size[start], width == 1  # what is all of a larger one is that
            made = new & ~single
            here = np.where(single, self.member[start], np.where(made, n + count + np.cumsum(made) - 1, element[start]))
            count += int(made.sum())
            if not clusters:
                self.roots, self.root_of = here, np.repeat(np.arange(len(here)), width)
            is_part = new & (element[start] >= 0)
            parent, inside = element[start[is_part]], np.repeat(is_part, width)
            order = _numbers_in_runs(parent)
            parts.append(np.column_stack([parent, order, here[is_part]]))
            self.ways[depth[inside] - 1, np.flatnonzero(inside)] = np.repeat(order, width[is_part])
            clusters.append(np.column_stack([start, start + width, depth[start]])[made])
            element, size, depth = np.repeat(here, width), np.repeat(width, width), depth + np.repeat(made, width)
        self.clusters, self.parts = np.concatenate(clusters), np.concatenate(parts)


def _numbers_in_runs(values):
    """0, 1, 2, … for neighbours of the same value (int [n])."""
    start = np.flatnonzero(np.diff(values, prepend=-1))
    return np.arange(len(values)) - np.repeat(start, np.diff(start, append=len(values)))
