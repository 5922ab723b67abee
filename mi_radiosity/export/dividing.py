"""Surfaces of an atlas cut where walls stand on them that are thinner than texels, and dark on one side."""

from typing import Any

import numpy as np

from ..scene.overlap import surfaces
from ..solver import Solution
from .atlas import Atlas, Pieces, Spots, face_of, is_back, on_surface
from .visible import blocked, first_faces, hidden, on_top

REACH = 3  # texels, across which a wall is thin
SAMPLES = 64  # that tell how bright it is on either side of a wall
CONTRAST = 0.9  # relative difference above which a surface is cut: one side is dark
LEAST_PAIRS = 8  # of texels, below which a wall is only a leg
MOST_CUTS = 16  # of a surface
PARALLEL = 0.98  # cosine between a wall and a surface, above which it does not stand on it
NEAR = 1e-3  # of a texel, within which planes are one and corners lie on them


def cut_at_walls(solution: Solution, atlas: Atlas, where: Spots) -> Pieces | None:
    """The pieces of an atlas cut along the walls, each side in a group of its own; None if there is nothing to cut.

    A filter mixes neighbouring texels, so light would leak through a wall without thickness: no chart may hold both of
    its sides. Texels of one chart that are close to each other, but do not see each other, show where.
    """
    model = solution.model
    first, second, points, normals = _apart(model, atlas, where)
    asked = np.zeros(len(points), dtype=bool)
    asked[first] = asked[second] = True
    light = np.zeros(len(points))
    found: Any = solution.irradiance(points[asked], normals[asked], samples=SAMPLES)
    light[asked] = found.mean(axis=1)
    asked[hidden(model, points, normals, light, asked)] = False
    a, b = light[first], light[second]
    leaks = (np.abs(a - b) > CONTRAST * np.maximum(a, b)) & asked[first] & asked[second]
    if not leaks.any():
        return None
    a, b = first[leaks], second[leaks]
    walls = [first_faces(model, points[k], points[l], normals[k], normals[l]) for k, l in ((a, b), (b, a))]
    surface = _surface_of(model)
    of = np.tile(surface[atlas.pieces.patch[where.piece[a, 0]]], 2)
    return _cut(model, atlas, surface, *_planes(model, of, np.concatenate(walls), NEAR / atlas.per_metre))


def _apart(model, atlas, where):
    """Pairs of texels of one chart, close to each other, that do not see each other (two int [n], positions in
    ``where``), and a point and a normal of every texel."""
    points, normals, patch, uv = on_surface(model, atlas, where.piece[:, 0], where.weight[:, 0])
    number = np.full((atlas.size, atlas.size), -1)
    free = on_top(model, patch, uv)
    number.ravel()[where.texel[free]] = np.flatnonzero(free)
    pairs = []
    for turned in (number, number.T):
        for distance in range(1, REACH + 1):
            a, b = turned[:, :-distance], turned[:, distance:]
            free = (a >= 0) & (b >= 0)
            pairs.append(np.stack([a[free], b[free]]))
    first, second = np.concatenate(pairs, axis=1)
    one = where.chart[first] == where.chart[second]
    first, second = first[one], second[one]
    apart = blocked(model, points[first], points[second], normals[first], normals[second])
    return first[apart], second[apart], points, normals


def _surface_of(model):
    """A number for the flat surface of every patch, and its side [patches]."""
    every = np.arange(model.patches.count)
    return 2 * surfaces(model.faces.vertex, model.faces.normal)[face_of(model, every)] + is_back(model, every)


def _planes(model, surface, wall, tolerance):
    """Planes that surfaces are cut along, the most frequent ones: surfaces [n], normals [n, 3], offsets [n]."""
    faces = model.faces
    normal = faces.normal[wall]
    # One sign for the two sides of a wall.
    lead = np.take_along_axis(normal, np.abs(normal).argmax(axis=1)[:, None], axis=1)
    normal = normal * np.sign(lead)
    offset = ((faces.corners[wall, 0] - faces.centre) * normal).sum(axis=1)
    key = np.column_stack([surface, np.round(normal * 1e4), np.round(offset / tolerance)]).astype(np.int64)
    _, first, count = np.unique(key, axis=0, return_index=True, return_counts=True)
    order = np.argsort(-count, kind="stable")
    order = first[order[count[order] >= LEAST_PAIRS]]
    rank = np.array([np.count_nonzero(surface[order[:k]] == surface[order[k]]) for k in range(len(order))], dtype=int)
    kept = order[rank < MOST_CUTS]
    return surface[kept], normal[kept], offset[kept], tolerance


def _cut(model, atlas, surface, of, normal, offset, tolerance):
    pieces = atlas.pieces
    patch, uv, group = pieces.patch, pieces.uv, pieces.group
    for number, n, d in zip(of, normal, offset):
        chosen = surface[patch] == number
        part = Pieces(patch[chosen], uv[chosen], group[chosen])
        if np.abs(model.faces.normal[face_of(model, part.patch[:1])] @ n).max(initial=0) > PARALLEL or not chosen.any():
            continue
        height = (part.points(model) - model.faces.centre) @ n - d
        index, corners = split(height, tolerance)
        cut = np.einsum("nkc,ncd->nkd", corners, part.uv[index])
        side = (np.einsum("nkc,nc->nk", corners, height[index]).sum(axis=1) > 0).astype(np.int64)
        label = part.group[index] * 2 + side + (1 + number) * (1 << 40) * (part.group[index] < 1 << 40)
        patch = np.concatenate([patch[~chosen], part.patch[index]])
        uv = np.concatenate([uv[~chosen], cut])
        group = np.concatenate([group[~chosen], label])
    if len(patch) == len(pieces.patch):
        return None
    return Pieces(patch, uv, np.unique(group, return_inverse=True)[1])


def split(height: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Cut triangles where heights of their corners [n, 3] are 0: which triangle each part is of [m], and its corners in
    barycentric coordinates [m, 3, 3]; triangles that do not reach over ``tolerance`` on both sides stay whole."""
    height = np.where(np.abs(height) <= tolerance, 0, height)
    crossing = (height.min(axis=1) < 0) & (height.max(axis=1) > 0)
    whole = np.flatnonzero(~crossing)
    n = np.flatnonzero(crossing)
    h = height[n]
    # The corner that is alone on its side, or the one that faces the corner on the line.
    sign = np.sign(h)
    alone = np.where((sign > 0).sum(axis=1) == 1, (sign > 0).argmax(axis=1), (sign < 0).argmax(axis=1))
    order = (alone[:, None] + np.arange(3)) % 3
    h = np.take_along_axis(h, order, axis=1)
    unit = np.eye(3)[order]
    ends = [
        unit[:, k] * (h[:, 0] / (h[:, 0] - h[:, k]))[:, None] + unit[:, 0] * (h[:, k] / (h[:, k] - h[:, 0]))[:, None]
        for k in (1, 2)
    ]
    parts = [(unit[:, 0], ends[0], ends[1]), (ends[0], unit[:, 1], ends[1]), (unit[:, 1], unit[:, 2], ends[1])]
    kept = [np.ones(len(n), dtype=bool), h[:, 1] != 0, h[:, 2] != 0]
    corners = [np.broadcast_to(np.eye(3), (len(whole), 3, 3)), *(np.stack(p, axis=1)[k] for p, k in zip(parts, kept))]
    return np.concatenate([whole, *(n[k] for k in kept)]), np.concatenate(corners)
