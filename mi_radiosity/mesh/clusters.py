"""Clusters of faces: where faces are smaller than what the light needs, neighbours share one irradiance."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import ColorSums, components, lower_bound_within, owned, row_keys, totals
from ..scene.faces import Faces
from ..scene.patches import Patches
from .elements import Elements

BINS = 2.0  # per unit of a normal's coordinates: normals of a cluster are within some 25° of each other
ROUNDS = 10  # of the search for a size
LEVELS = 3  # of clusters above each other, each twice as large
NEARLY = 0.85  # of the clusters wanted are enough of them


@dataclass(frozen=True)
class Clusters:
    """Leaves that share one irradiance, in the order of ``elements.leaves``. Immutable.

    Those of one cluster of a `Crown` that was not split do; leaves of divided patches stand alone. ``of`` (UInt32
    [leaves]): the cluster of each leaf; there are ``count``. ``member`` (UInt32 [leaves]): rows of leaves, cluster
    after cluster, beginning at ``start`` (UInt32 [count + 1]); ``until`` (Float64 [leaves]): their areas up to and with
    each, from the first of all on, m². Source: Willmott, Heckbert, Garland: "Face cluster radiosity", 1999.
    """

    count: int
    of: "mi.UInt32"
    member: "mi.UInt32"
    start: "mi.UInt32"
    until: "mi.Float64"

    @staticmethod
    def of_leaves(elements: Elements) -> "Clusters":
        """Those of elements with a `Crown`."""
        patch = dr.gather(mi.UInt32, elements.patch, elements.leaves)
        lone = elements.level(elements.leaves) > 0
        label = np.array(dr.select(lone, elements.leaves, elements.top(patch)))
        return Clusters._from_labels(
            label, np.array(dr.gather(mi.Float, elements.area, elements.leaves), dtype=np.float64)
        )

    @staticmethod
    def _from_labels(label: np.ndarray, area: np.ndarray) -> "Clusters":
        _, first, of = np.unique(label, return_index=True, return_inverse=True)
        of = np.argsort(np.argsort(first))[of]  # in an order that Mitsuba's order of shapes does not decide
        member = np.argsort(of, kind="stable")
        start = np.searchsorted(of[member], np.arange(of.max() + 2))
        until = owned(mi.Float64, np.cumsum(area[member]))
        of, member, start = (owned(mi.UInt32, x) for x in (of, member, start))
        return Clusters(dr.width(start) - 1, of, member, start, until)

    def pick(self, cluster: "mi.UInt32", lot: "mi.Float") -> "tuple[mi.UInt32, mi.Float]":
        """A leaf of clusters, drawn by area with ``lot`` in [0, 1): its row, and what is left of the lot, as uniform
        (UInt32, Float [n])."""
        first, end = (dr.gather(mi.UInt32, self.start, cluster + k) for k in (0, 1))
        low = dr.select(first > 0, dr.gather(mi.Float64, self.until, dr.maximum(first, 1) - 1), 0)
        high = dr.gather(mi.Float64, self.until, end - 1)
        place = low + mi.Float64(lot) * (high - low)
        at = lower_bound_within(self.until, place, first, end - 1)
        below = dr.select(at > 0, dr.gather(mi.Float64, self.until, dr.maximum(at, 1) - 1), 0)
        width = dr.gather(mi.Float64, self.until, at) - below
        rest = dr.clip(mi.Float((place - below) / dr.maximum(width, 1e-300)), 0, 1 - 2.0**-24)
        return dr.gather(mi.UInt32, self.member, at), rest

    def sums(self, values: "list[mi.Float64]") -> "list[mi.Float64]":
        """Sums over clusters of values ≥ 0 of the leaves (3 Float64 [leaves] ─► [count])."""
        sums = ColorSums(self.count, [2 * t for t in totals(values)])
        sums.add(values, self.of)
        return sums.gather(dr.arange(mi.UInt32, self.count))

    def spread(self, values: "list[mi.Float64]") -> "list[mi.Float64]":
        """Values of clusters, for each of their leaves (3 Float64 [count] ─► [leaves])."""
        return [dr.gather(mi.Float64, v, self.of) for v in values]

    def means(self, values: "list[mi.Float64]", area: "mi.Float64") -> "list[mi.Float64]":
        """Values of the leaves averaged over clusters by ``area``, for each of their leaves (3 Float64 [leaves])."""
        whole = self.sums([area, area, area])[0]
        return self.spread([s / whole for s in self.sums([v * area for v in values])])


def cluster_labels(
    faces: Faces, patches: Patches, crossed: np.ndarray, wanted: int, levels: int = LEVELS
) -> list[np.ndarray]:
    """Clusters inside of larger ones, the largest first: labels of the patches (int [patches] each).

    A cluster is a connected part of one side of one shape, flat to BINS, that fits into a cube; patches that walls
    cross (bool [patches]) stand alone. The largest cubes are those for which there are no more than ``wanted``
    clusters; where parts that are connected do not get so few, parts of one cube need not be, nor keep clear of walls.
    The next have cubes half as large each, as long as they are less than the patches.
    """
    face, back = np.array(patches.face), np.array(patches.back).astype(np.int64)
    corners = faces.corners[face]
    centre = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3 - faces.low
    bins = np.round(faces.normal[face] * np.where(back, -1, 1)[:, None] * BINS).astype(np.int64)
    kind = row_keys(np.column_stack([faces.shape[face], back, bins]))
    a, b = _neighbours(faces, face, back, ~crossed)
    a, b = (ends[kind[a] == kind[b]] for ends in (a, b))

    def connected(size):
        cell = row_keys(np.floor(centre / size).astype(np.int64))
        joined = cell[a] == cell[b]
        return components(len(face), a[joined], b[joined])

    def near(size):
        cell = np.floor(centre / size).astype(np.int64)
        return first_of(row_keys(np.column_stack([kind, cell])))

    size = np.sqrt(faces.area[face].sum() / max(wanted, 1))
    for label_of in (connected, near):
        label, count, size = _search(label_of, size, wanted)
        if count <= wanted:
            break
    found = [label]
    while len(found) < levels and count < len(face):
        size /= 2
        label = connected(size)
        count = count_of(label)
        found.append(label)
    return found


def count_of(label: np.ndarray) -> int:
    """How many there are of labels, each the place of the first thing that has it."""
    return int(np.count_nonzero(label == np.arange(len(label))))


def first_of(keys: np.ndarray) -> np.ndarray:
    """For each key the place of the first that is the same (int [n])."""
    _, first, of = np.unique(keys, return_index=True, return_inverse=True)
    return first[of]


def _search(label_of, size, wanted):
    """Labels at the size of cubes that has nearly ``wanted`` of them, or the fewest found; how many, and the size."""
    low, high, best, last = 0.0, None, (None, np.inf, size), np.inf
    for _ in range(ROUNDS):
        label = label_of(size)
        count = count_of(label)
        if count <= wanted or (high is None and count < best[1]):
            best = label, count, size
        if NEARLY * wanted < count <= wanted or (high is None and wanted < 0.98 * last < count):
            break
        last = count
        low, high = (low, size) if count <= wanted else (size, high)
        size = 2 * size if high is None else (low + high) / 2
    return best


def _neighbours(faces, face, back, chosen):
    """Pairs of ``chosen`` rows whose faces, on one side, share an edge (two int [links])."""
    rows = np.flatnonzero(chosen)
    vertex = faces.vertex[face[rows]]
    ends = np.stack([vertex, np.roll(vertex, -1, axis=1)]).reshape(2, -1)
    key = (ends.min(axis=0) << 32 | ends.max(axis=0)) * 2 + np.repeat(back[rows], 3)
    owner = np.repeat(rows, 3)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    return owner[order[:-1][same]], owner[order[1:][same]]
