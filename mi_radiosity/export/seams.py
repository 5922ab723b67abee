"""Seams of an atlas: where a smooth surface lies in two places, both show the same light."""

from typing import Any

import numpy as np

from ..core.arrays import runs
from ..core.extras import optional
from ..scene import Model
from .atlas import TUCK, Atlas, on_surface
from .visible import blocked

SMOOTH = 0.99  # cosine between shading normals, above which a surface goes on
STIFF = 100.0  # weight of a seam's texels being equal, against those of staying as gathered
LOOSE = 0.01  # weight of texels that were only filled
PER_TEXEL = 2  # places along a seam


def level_seams(model: Model, atlas: Atlas, irradiance: np.ndarray, gathered: np.ndarray) -> np.ndarray:
    """The irradiance nearest to the given [size, size, 3] that is equal on both sides of seams.

    min Σ w (H − H₀)² + STIFF Σ (H_a − H_b)², over all texels, and over places along the seams. gathered: which texels
    were not only filled [size, size].
    """
    a, b = seam_samples(model, atlas)
    if not len(a[0]):
        return irradiance
    sparse: Any = optional("scipy.sparse", "a lightmap", "export")
    linalg: Any = optional("scipy.sparse.linalg", "a lightmap", "export")
    n = len(a[0])
    row = np.repeat(np.arange(n), 4)
    matrices = [sparse.csr_matrix((w.ravel(), (row, i.ravel())), shape=(n, atlas.size**2)) for i, w in (a, b)]
    difference = matrices[0] - matrices[1]
    involved = np.unique(difference.indices)
    D = difference[:, involved]
    weight = np.where(gathered.ravel()[involved], 1.0, LOOSE)
    system = (sparse.diags(weight) + STIFF * D.T @ D).tocsr()
    result = irradiance.reshape(-1, 3).copy()
    for c in range(3):
        start = result[involved, c]
        found, _ = linalg.cg(system, weight * start, x0=start, rtol=1e-6, maxiter=1000)
        result[involved, c] = np.maximum(found, 0)
    return result.reshape(irradiance.shape)


def seam_samples(model: Model, atlas: Atlas) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Places along seams, on both sides: the four texels that are filtered there, and their weights ([n, 4] each)."""
    first, second, flipped = _pairs(model, atlas)
    length = np.linalg.norm(_end(atlas, first, 1) - _end(atlas, first, 0), axis=1)
    each = np.ceil(PER_TEXEL * length).astype(int) + 1
    which, k = runs(each)
    t = k / np.maximum(each[which] - 1, 1)
    weights = [_along(side, which, s) for side, s in ((first, t), (second, np.where(flipped[which], 1 - t, t)))]
    ends = [on_surface(model, atlas, side[0][which], w)[:2] for side, w in zip((first, second), weights)]
    # Over the edge between two facets, but through anything that stands on it.
    apart = blocked(model, ends[0][0], ends[1][0], ends[0][1], ends[1][1], TUCK / atlas.per_metre)
    places = [
        np.einsum("nk,nkc->nc", w, atlas.place[side[0][which]])[~apart] for side, w in zip((first, second), weights)
    ]
    return bilinear(places[0], atlas.size), bilinear(places[1], atlas.size)


def bilinear(place: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """The texels that a filter looks at, at places [n, 2] of a texture, and their weights ([n, 4] each)."""
    corner = np.floor(place - 0.5)
    f = place - 0.5 - corner
    texels, weights = [], []
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = ((corner[:, k] + d).clip(0, size - 1).astype(np.int64) for k, d in ((0, dx), (1, dy)))
        texels.append(y * size + x)
        weights.append((f[:, 0] if dx else 1 - f[:, 0]) * (f[:, 1] if dy else 1 - f[:, 1]))
    return np.stack(texels, axis=1), np.stack(weights, axis=1)


def _pairs(model, atlas):
    """Sides of pieces (piece, side) that are one in space and two in the texture; do they run opposite ways?"""
    piece = np.repeat(np.flatnonzero(atlas.chart >= 0), 3)
    side = np.tile(np.arange(3), len(piece) // 3)
    points, normals = atlas.pieces.points(model), atlas.pieces.normals(model)
    step = 1e-6 * max(np.ptp(points.reshape(-1, 3), axis=0).max(), 1e-30)
    _, vertex = np.unique(np.round(points.reshape(-1, 3) / step), axis=0, return_inverse=True)
    vertex = vertex.reshape(-1, 3)
    start, end = vertex[piece, side], vertex[piece, (side + 1) % 3]
    key = np.minimum(start, end) << 32 | np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    a, b = _within_runs(key[order])
    a, b = order[a], order[b]
    flipped = start[a] != start[b]
    first, second = (piece[a], side[a]), (piece[b], side[b])
    same = np.ones(len(a), dtype=bool)
    smooth = np.ones(len(a), dtype=bool)
    for k in range(2):
        other = np.where(flipped, 1 - k, k)
        corner_a, corner_b = (first[1] + k) % 3, (second[1] + other) % 3
        same &= np.abs(atlas.place[first[0], corner_a] - atlas.place[second[0], corner_b]).max(axis=1) < 1e-3
        smooth &= (normals[first[0], corner_a] * normals[second[0], corner_b]).sum(axis=1) > SMOOTH
    kept = smooth & ~same
    return (first[0][kept], first[1][kept]), (second[0][kept], second[1][kept]), flipped[kept]


def _within_runs(key):
    """Positions of neighbours of one key, in a sorted list."""
    a = np.flatnonzero(key[1:] == key[:-1])
    return a, a + 1


def _end(atlas, side, which):
    return atlas.place[side[0], (side[1] + which) % 3]


def _along(side, which, t):
    """Barycentric coordinates at t along sides [n, 3]."""
    weight, rows, k = np.zeros((len(which), 3)), np.arange(len(which)), side[1][which]
    weight[rows, k], weight[rows, (k + 1) % 3] = 1 - t, t
    return weight
