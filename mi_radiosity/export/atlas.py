"""A texture atlas of a scene's lit sides: where on them every texel lies."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned, runs
from ..core.errors import RadiosityError
from ..core.extras import optional
from ..scene import Model

GAP = 2  # texels between charts, beside those of bilinear filtering
TRIES = 12  # at fitting charts into the texture
SHRINK = 0.97  # at least, from one try to the next
CHUNK = 1 << 20  # texels looked at in one go
SPOTS = np.array([[-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])  # of a texel that are sampled
TUCK, MOST_TUCK = 0.1, 0.25  # of a texel, and of a triangle: points stay off its sides, where a neighbour stands


@dataclass(frozen=True)
class Pieces:
    """Triangles of patches, whole ones or parts; NumPy arrays, one row each."""

    patch: np.ndarray  # [pieces]
    uv: np.ndarray  # [pieces, 3, 2] barycentric coordinates of the corners on the patch
    group: np.ndarray  # [pieces] only pieces of one group may share a chart

    def points(self, model: Model) -> np.ndarray:
        """Corners in the coordinates of the scene [pieces, 3, 3]."""
        faces, face = model.faces, face_of(model, self.patch)[:, None]
        return faces.corners[face, 0] + self.uv[..., :1] * faces.e1[face] + self.uv[..., 1:] * faces.e2[face]

    def normals(self, model: Model) -> np.ndarray:
        """Shading normals at the corners, unit, towards the side [pieces, 3, 3]."""
        face = owned(mi.UInt32, np.repeat(face_of(model, self.patch), 3))
        si = model.faces.surface(face, *(owned(mi.Float, x) for x in self.uv.reshape(-1, 2).T))
        normal = np.array(si.sh_frame.n, dtype=np.float64).reshape(3, -1).T.reshape(-1, 3, 3)
        return np.where(is_back(model, self.patch)[:, None, None], -normal, normal)


@dataclass(frozen=True)
class Atlas:
    """Charts of pieces in a square texture; coordinates count texels from the first one's outer corner."""

    size: int
    pieces: Pieces
    place: np.ndarray  # [pieces, 3, 2] where the corners lie in the texture
    chart: np.ndarray  # [pieces] number of the chart, −1 for none
    per_metre: float  # texels, about: charts are stretched to whole texels

    def tuck(self) -> np.ndarray:
        """How far points are drawn to the middle of their piece, of the way [pieces]."""
        sides = self.place - np.roll(self.place, 1, axis=1)
        around = np.linalg.norm(sides, axis=2).sum(axis=1)
        radius = np.abs(_cross(sides[:, 1], sides[:, 2])) / np.maximum(around, 1e-30)  # of the circle within
        return np.minimum(TUCK / np.maximum(radius, 1e-30), MOST_TUCK)

    def texel_area(self, model: Model) -> np.ndarray:
        """How much of a piece a texel shows, m² [pieces]."""
        points, place = self.pieces.points(model), self.place
        area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1)
        texels = np.abs(_cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]))
        return np.divide(area, texels, out=np.zeros(len(area)), where=texels > 0)


@dataclass(frozen=True)
class Spots:
    """Points that texels are sampled at, some for each texel that touches a piece."""

    texel: np.ndarray  # [texels] row · size + column
    chart: np.ndarray  # [texels] the one nearest to its centre
    piece: np.ndarray  # [texels, spots] of the chart, the piece nearest to the spot
    inside: np.ndarray  # [texels, spots] bool: the spot itself lies on the piece, not only the point nearest to it
    weight: np.ndarray  # [texels, spots, 3] barycentric coordinates on the piece


def face_of(model: Model, patch: np.ndarray) -> np.ndarray:
    """Faces of patches [n]."""
    return np.array(model.patches.face, dtype=np.int64)[patch]


def is_back(model: Model, patch: np.ndarray) -> np.ndarray:
    """Which patches are backs of their faces (bool [n])?"""
    return np.array(model.patches.back).astype(bool)[patch]


def whole(model: Model) -> Pieces:
    """Every patch, in one piece, counter-clockwise as seen from its side."""
    patch = np.arange(model.patches.count)
    turned = is_back(model, patch) ^ model.faces.flipped[face_of(model, patch)]
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    uv = np.where(turned[:, None, None], corners[::-1], corners)
    return Pieces(patch, uv, is_back(model, patch).astype(np.int64))


def unwrap(model: Model, pieces: Pieces, size: int) -> Atlas:
    """Lay out pieces in a texture of size × size texels, all to one scale. Raises RadiosityError if they do not fit."""
    points = pieces.points(model)
    area = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1).sum() / 2
    scale = size / np.sqrt(area)
    for _ in range(TRIES):
        atlas = _pack(points, pieces.group, scale)
        largest = max(atlas.width, atlas.height)
        if largest <= size and atlas.atlas_count == 1:
            place, chart = _places(atlas, pieces.group)
            return Atlas(size, pieces, place, chart, scale)
        scale *= min(size / largest, SHRINK)
    raise RadiosityError(
        f"{atlas.chart_count:,} charts do not fit into {size} × {size} texels: give --lightmap a larger size"
    )


def _pack(points, group, scale):
    xatlas: Any = optional("xatlas", "a lightmap", "export")
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    middle = points.reshape(-1, 3).mean(axis=0)
    for number in np.unique(group):
        corners, index = np.unique(points[group == number].reshape(-1, 3) - middle, axis=0, return_inverse=True)
        atlas.add_mesh(corners.astype(np.float32), index.reshape(-1, 3).astype(np.uint32))
    pack.texels_per_unit, pack.padding, pack.bilinear = scale, GAP, True
    atlas.generate(pack_options=pack)
    return atlas


def _places(atlas, group):
    """Where the corners of pieces are [pieces, 3, 2], and their charts [pieces]."""
    place, chart, charts = np.zeros((len(group), 3, 2)), np.full(len(group), -1), 0
    for mesh, number in enumerate(np.unique(group)):
        _, triangles, uv = atlas[mesh]
        of_vertex = atlas.get_mesh_vertex_assignment(mesh)[1].astype(np.int64)
        chosen = np.flatnonzero(group == number)
        place[chosen] = (uv * [atlas.width, atlas.height])[triangles]
        # −1, as an unsigned number, stands for no chart.
        chart[chosen] = np.where(of_vertex < 1 << 31, of_vertex + charts, -1)[triangles[:, 0]]
        charts += atlas.get_mesh_chart_count(mesh)
    return place, chart


# ---- Texels ----------------------------------------------------------------------------------------


def spots(atlas: Atlas) -> Spots:
    """Points to sample at, for every texel that touches a piece."""
    texel, piece, away = _touching(atlas)
    order = np.lexsort((piece, away, texel))
    texel, piece = texel[order], piece[order]
    texels, first, row = np.unique(texel, return_index=True, return_inverse=True)
    chart = atlas.chart[piece]
    own = chart == chart[first][row]
    row, piece = row[own], piece[own]
    shape = (len(texels), len(SPOTS))
    owner, inside, weight = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=bool), np.zeros((*shape, 3))
    centre = np.column_stack([texels % atlas.size, texels // atlas.size]) + 0.5
    for k, spot in enumerate(SPOTS):
        point, triangle = centre[row] + spot, atlas.place[piece]
        w, within = nearest(triangle, point)
        distance = np.linalg.norm(np.einsum("nk,nkc->nc", w, triangle) - point, axis=1)
        best = np.lexsort((distance, row))
        best = best[np.unique(row[best], return_index=True)[1]]
        owner[:, k], inside[:, k], weight[:, k] = piece[best], within[best], w[best]
    return Spots(texels, chart[first], owner, inside, weight)


def _touching(atlas):
    """Texels, the pieces that touch them, and how far these are from the texel's centre (three arrays [n])."""
    piece = np.flatnonzero(atlas.chart >= 0)
    low = np.floor(atlas.place[piece].min(axis=1) - 0.5).clip(0, atlas.size - 1).astype(np.int64)
    high = np.ceil(atlas.place[piece].max(axis=1) + 0.5).clip(1, atlas.size).astype(np.int64)
    extent = high - low
    count = extent.prod(axis=1)
    found = []
    for part in np.split(np.arange(len(piece)), np.flatnonzero(np.diff(np.cumsum(count) // CHUNK)) + 1):
        which, k = runs(count[part])
        which = part[which]
        x, y = low[which, 0] + k % extent[which, 0], low[which, 1] + k // extent[which, 0]
        centre = np.column_stack([x, y]) + 0.5
        triangle = atlas.place[piece[which]]
        weight, _ = nearest(triangle, centre)
        away = np.abs(np.einsum("nk,nkc->nc", weight, triangle) - centre)
        touches = away.max(axis=1) <= 0.51  # sides that lie in the middle of texels touch them, or not, as a whole
        found.append((y * atlas.size + x, piece[which], away.max(axis=1), touches))
    texel, owner, away, touches = (np.concatenate(a) for a in zip(*found))
    return texel[touches], owner[touches], away[touches]


def nearest(triangles: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric coordinates [n, 3] of the points of triangles [n, 3, 2] nearest to points [n, 2], and whether these
    lie inside [n]."""
    a, b, x = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0], points - triangles[:, 0]
    area = _cross(a, b)
    area = np.where(area == 0, np.inf, area)
    u, v = _cross(x, b) / area, _cross(a, x) / area
    weight = np.column_stack([1 - u - v, u, v])
    inside = (weight >= 0).all(axis=1) & np.isfinite(area)
    least = np.where(inside, 0.0, np.inf)
    for k in range(3):
        start, end = triangles[:, k], triangles[:, (k + 1) % 3]
        side = end - start
        t = (((points - start) * side).sum(axis=1) / np.maximum((side**2).sum(axis=1), 1e-300)).clip(0, 1)
        distance = ((start + t[:, None] * side - points) ** 2).sum(axis=1)
        nearer = ~inside & (distance < least)
        least[nearer] = distance[nearer]
        edge = np.zeros_like(weight)
        edge[:, k], edge[:, (k + 1) % 3] = 1 - t, t
        weight[nearer] = edge[nearer]
    return weight, inside


def _cross(a, b):
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def on_surface(model: Model, atlas: Atlas, piece: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points [n, 3] of places on pieces, unit shading normals [n, 3], patches [n], and coordinates on these [n, 2]."""
    pieces, tuck = atlas.pieces, atlas.tuck()[piece, None]
    weight = (1 - tuck) * weight + tuck / 3
    points = np.einsum("nk,nkc->nc", weight, pieces.points(model)[piece])
    normals = np.einsum("nk,nkc->nc", weight, pieces.normals(model)[piece])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    return points, normals, pieces.patch[piece], np.einsum("nk,nkc->nc", weight, pieces.uv[piece])


def reflectance(model: Model, patch: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """ρ at points of patches [n, 3]."""
    rho = model.reflectance_at(owned(mi.UInt32, patch), *(owned(mi.Float, x) for x in uv.T))
    return np.array(rho, dtype=np.float64).reshape(3, -1).T


def emission(model: Model, patch: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """E at points of patches, with the textures of emitters, W/m² [n, 3]."""
    u, v = (owned(mi.Float, x) for x in uv.T)
    every = dr.full(mi.Bool, True, len(patch))
    return np.array(model.lights.at(model.patches, owned(mi.UInt32, patch), u, v, every)).reshape(3, -1).T
