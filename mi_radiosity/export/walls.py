"""Leaves that walls stand on: their light breaks where no vertex is."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned, owned_vectors
from ..core.points import coordinates
from ..mesh.exposure import is_covered
from ..scene.patches import Patches
from ..solver import Solution
from ..solver.field import Field
from .cutting import Sides, cut, keys

ORDER = 4  # samples of a piece along a side
ROUNDS = 3  # how often a piece is cut in four where its light still breaks
BREAK = 0.2  # relative error of a piece, root mean square, at which its light breaks
PULL = 0.02  # of every corner towards the mean, in samples: for pieces of which hardly anything is open


def beside_walls(
    solution: Solution, fields: list[Field], table: np.ndarray, pieces: np.ndarray, of: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Light at the corners of pieces [n, 3, channels], from the vertices, and for pieces ``beside`` walls [n] fitted to
    the field where the piece is open. Where that is too rough, pieces are cut further, with their neighbours.

    table: rows of vertices, position [3] and values [channels]. pieces: [n, 3] vertices, ``of`` leaves [n].
    Returns table, pieces, of, values, beside.
    """
    elements = solution.elements
    leaves = np.array(elements.leaves)
    walled = np.any([np.array(field.walled).astype(bool)[leaves] for field in fields[::2]], axis=0)
    for last in [False] * ROUNDS + [True]:
        beside = walled[of]
        values = table[pieces, 3:]
        if not beside.any():
            break
        chosen = np.flatnonzero(beside)
        values[chosen], breaks = _fit(solution, fields, table, pieces[chosen], leaves[of[chosen]], values[chosen])
        rough = pieces[chosen[breaks]]
        if last or not len(rough):
            break
        key = np.unique(np.concatenate([keys(rough[:, k - 2], rough[:, k - 1]) for k in range(3)]))
        low, high = (key >> np.uint64(32)).astype(np.int64), (key & np.uint64(0xFFFFFFFF)).astype(np.int64)
        sides = Sides(low, high, len(table) + np.arange(len(key)))
        table = np.concatenate([table, (table[low] + table[high]) / 2])
        pieces, kept = cut(pieces, sides)
        of = of[kept]
    return table, pieces, of, values, beside


def _fit(solution, fields, table, pieces, leaf, values):
    """Linear light on pieces [n, 3, channels], by least squares over their open points; which it does not fit [n]."""
    model, elements = solution.model, solution.elements
    i, j = (x.ravel() for x in np.indices((ORDER, ORDER)))
    i, j = i[i + j < ORDER], j[i + j < ORDER]
    a, b = (i + 1 / 3) / ORDER, (j + 1 / 3) / ORDER
    weight = np.column_stack([1 - a - b, a, b])  # [samples, 3]
    of = owned(mi.UInt32, np.repeat(leaf, len(a)))
    points = (weight @ table[pieces, :3]).reshape(-1, 3) - model.faces.centre
    u, v = patch_coordinates(model.patches, dr.gather(mi.UInt32, elements.patch, of), points)
    light = np.concatenate([np.array(f.at(of, u, v)) for f in fields]).T.reshape(len(pieces), len(a), -1)
    shown = ~np.array(is_covered(elements, model.rays, of, u, v)).astype(bool).reshape(len(pieces), -1)
    shown &= np.isfinite(light).all(axis=2)
    w = shown[..., None].astype(float)
    light = np.where(shown[..., None], light, 0)
    mean = light.sum(axis=1) / np.maximum(w.sum(axis=1), 1)  # [n, channels]
    normal = np.einsum("nm,mi,mj->nij", w[..., 0], weight, weight) + PULL * np.eye(3)
    right = np.einsum("mi,nmc->nic", weight, light) + PULL * mean[:, None]
    fitted = np.maximum(np.linalg.solve(normal, right), 0)
    fitted = np.where(shown.any(axis=1)[:, None, None], fitted, values)
    error = (w * (weight @ fitted - light) ** 2).sum(axis=1) / np.maximum(w.sum(axis=1), 1)
    return fitted, (np.sqrt(error) > BREAK * (mean + 0.1 * values.mean(axis=(0, 1)))).any(axis=1)


def patch_coordinates(patches: Patches, patch: "mi.UInt32", points: np.ndarray) -> "tuple[mi.Float, mi.Float]":
    """(u, v) on patches of points [n, 3] relative to their origin (two Float [n])."""
    p0, e1, e2 = (dr.gather(type(x), x, patch) for x in (patches.p0, patches.e1, patches.e2))
    return coordinates(owned_vectors(mi.Vector3f, points) - p0, e1, e2)
