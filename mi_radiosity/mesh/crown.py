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

    labels: of the patches, the same for those of one cluster, the largest clusters first (int [patches] each).
    Source: Willmott, Heckbert, Garland: "Face cluster radiosity", 1999.
    """

    def __init__(self, patches: Patches, labels: Sequence[np.ndarray]) -> None:
        n = patches.count
        self._patches = n
        member = np.lexsort(labels[::-1])
        area = np.array(patches.area, dtype=np.float64)[member]
        clusters, links, ways = [], [], np.zeros((len(labels) + 1, n), dtype=np.uint32)
        name, size, depth, count = np.full(n, -1), np.full(n, n + 1), np.zeros(n, dtype=np.int64), 0
        for label in [*labels, np.arange(n)]:
            start = np.flatnonzero(np.diff(label[member], prepend=-1))
            width = np.diff(start, append=n)
            new, single = width < size[start], width == 1  # a cluster that is all of another is left out
            made = new & ~single
            here = np.where(single, member[start], np.where(made, n + count + np.cumsum(made) - 1, name[start]))
            count += int(made.sum())
            above = new & (name[start] >= 0)
            parent = name[start[above]]
            run = np.flatnonzero(np.diff(parent, prepend=-1))  # parts of one are side by side
            order = np.arange(len(parent)) - np.repeat(run, np.diff(run, append=len(parent)))
            links.append(np.column_stack([parent, order, here[above]]))
            each, inside = width[above], np.repeat(above, width)
            ways[depth[inside] - 1, np.flatnonzero(inside)] = np.repeat(order, each)
            clusters.append(np.column_stack([start, start + width, depth[start]])[made])
            depth += np.repeat(made, width)
            name, size = np.repeat(here, width), np.repeat(width, width)
            if label is labels[0]:
                roots, root_of = here, np.repeat(np.arange(len(here)), width)
        start, end, depth = np.concatenate(clusters).T
        parent, order, part = np.concatenate(links).T
        rows = np.lexsort([order, parent])
        parts = np.bincount(parent - n, minlength=count)
        until = np.concatenate([[0], np.cumsum(area)])
        self.area = until[end] - until[start]
        self.start, self.end, self.depth = (owned(mi.UInt32, x) for x in (start, end, depth))
        self.first, self.parts, self.part = (owned(mi.UInt32, x) for x in (np.cumsum(parts) - parts, parts, part[rows]))
        self.roots, self.member = owned(mi.UInt32, roots), owned(mi.UInt32, member)
        self.root_of, self._ways = (np.empty(n), np.empty_like(ways))
        self.root_of[member], self._ways[:, member] = root_of, ways
        self.root_of, self._ways = owned(mi.UInt32, self.root_of), owned(mi.UInt32, self._ways.ravel())
        self._until = owned(mi.Float64, until)
        self._sum_area, self._member, self._ends = area, member, (start, end)

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
        until = np.concatenate([np.zeros((1, 3)), np.cumsum(values[self._member] * self._sum_area[:, None], axis=0)])
        start, end = self._ends
        return (until[end] - until[start]) / self.area[:, None]
