"""Triangles cut where vertices hang on their sides, so that neighbours meet along whole sides."""

import numpy as np

from ..core.arrays import NONE
from ..mesh import Elements
from ..mesh.vertices import Vertices

# Pieces of a triangle by how many of its sides have a middle, as nodes: corners 0 to 2, middles opposite them 3 to 5.
PIECES = {
    1: ([0, 1, 3], [0, 3, 2]),
    2: ([0, 5, 4], [5, 1, 2], [5, 2, 4]),
    3: ([0, 5, 4], [5, 1, 3], [4, 3, 2], [3, 4, 5]),
}


class Sides:
    """The vertex in the middle of a side, known by the two at its ends (int [n] each)."""

    def __init__(self, low: np.ndarray, high: np.ndarray, middle: np.ndarray):
        self._keys, first = np.unique(keys(low, high), return_index=True)
        self._middle = np.asarray(middle)[first]

    def middle(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Numbers of vertices, NONE where there is none [n]."""
        if not len(self._keys):
            return np.full(len(a), NONE)
        key = keys(a, b)
        at = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        return np.where(self._keys[at] == key, self._middle[at], NONE)


def keys(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """One number per side, whichever way it runs (uint64 [n])."""
    return (np.minimum(a, b).astype(np.uint64) << np.uint64(32)) | np.maximum(a, b).astype(np.uint64)


def sides_of(vertices: Vertices, elements: Elements) -> Sides:
    """The sides of a mesh that are split on one side of them or the other."""
    corner, middle = (np.array(x).reshape(3, -1) for x in (vertices.corner, vertices.middle))
    ends = [(corner[k - 2], corner[k - 1], middle[k]) for k in range(3)]
    low, high, vertex = (np.concatenate(parts) for parts in zip(*ends))
    split = vertex != NONE
    return Sides(low[split], high[split], vertex[split])


def cut(triangles: np.ndarray, sides: Sides) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangles until no side has a vertex in its middle: the pieces [n, 3] and which triangle each is of [n].

    What a side becomes does not depend on the triangle, so neighbours fit.
    """
    done, of = [np.zeros((0, 3), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    number = np.arange(len(triangles))
    while len(triangles):
        middle = np.stack([sides.middle(triangles[:, k - 2], triangles[:, k - 1]) for k in range(3)], axis=1)
        bent = middle != NONE
        count = bent.sum(axis=1)
        # Turn them, so that the only bent side is opposite corner 0, or the only straight one.
        turn = np.where(count == 1, bent.argmax(axis=1), np.where(count == 2, (~bent).argmax(axis=1), 0))
        order = (np.arange(3) + turn[:, None]) % 3
        nodes = np.concatenate([np.take_along_axis(x, order, axis=1) for x in (triangles, middle)], axis=1)
        done.append(triangles[count == 0])
        of.append(number[count == 0])
        pieces = [(nodes[count == n][:, piece], number[count == n]) for n in PIECES for piece in PIECES[n]]
        triangles, number = (np.concatenate(parts) for parts in zip(*pieces))
    order = np.argsort(np.concatenate(of), kind="stable")
    return np.concatenate(done)[order], np.concatenate(of)[order]
