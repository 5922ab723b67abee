"""The lit mesh: welded triangles of a solution, for whoever shows them without this package."""

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, owned
from ..display import Field
from ..mesh.subdivision import NODES
from ..scene.materials import is_textured
from ..solver import Solution


@dataclass(frozen=True)
class LitMesh:
    """Triangles with the Gouraud field of a solution at their vertices; NumPy arrays, one row each.

    A leaf is one triangle, or is cut at the vertices that hang on its sides, so that triangles of one surface meet
    along whole sides. Vertices are shared within a side of a shape, where they share a shading normal and a texture's
    coordinates. Triangles are counter-clockwise as seen from the side that is lit.
    """

    vertices: np.ndarray  # [vertices, 3] m, in the coordinates of the scene
    triangles: np.ndarray  # [triangles, 3] numbers of vertices
    direct: np.ndarray  # [vertices, 3] irradiance from the lamps' first flight, W/m²
    indirect: np.ndarray  # [vertices, 3] from all later ones
    reflectance: np.ndarray  # [vertices, 3] ρ, the mean over the leaves around
    emission: np.ndarray  # [vertices, 3] E, W/m²
    uv: np.ndarray  # [vertices, 2] coordinates of the shape's texture, NaN where it has none
    leaf: np.ndarray  # [triangles] number of the leaf among the leaves of the solution
    shape: np.ndarray  # [triangles] number of the shape in scene.shapes()
    back: np.ndarray  # [triangles] bool: the back of the shape

    @property
    def irradiance(self) -> np.ndarray:
        """H, W/m² [vertices, 3]."""
        return self.direct + self.indirect

    @property
    def radiosity(self) -> np.ndarray:
        """B = E + ρ H, W/m² [vertices, 3]."""
        return self.emission + self.reflectance * self.irradiance

    def areas(self) -> np.ndarray:
        """Areas of the triangles, m² [triangles]."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def lit_mesh(solution: Solution) -> LitMesh:
    """The triangles of a solution, with the values of its Gouraud picture."""
    field = Field(solution)
    total = _known(solution, field, field.flat)
    first = replace(solution, indirect=dr.zeros(mi.Color3f, len(solution.elements)))
    direct = np.minimum(_known(solution, Field(first), solution.direct), total)
    vertices, elements, model = field.vertices, solution.elements, solution.model
    leaves = np.array(elements.leaves)
    corner = np.array(vertices.corner).reshape(3, -1).T
    triangles, leaf = cut(corner[leaves], _sides(vertices, elements))
    patch = np.array(elements.patch)[leaves[leaf]]
    face, back = np.array(model.patches.face)[patch], np.array(model.patches.back).astype(bool)[patch]
    shape, points = model.faces.shape[face], _points(model, elements, corner, vertices.count)
    uv = _texture_coordinates(model, face, points[triangles])

    key = np.column_stack([triangles.ravel(), np.repeat(2 * shape + back, 3), _rounded(uv)])
    _, first_of, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
    old, number = triangles.ravel()[first_of], number.reshape(-1, 3)
    turned = (back ^ model.faces.flipped[face])[:, None]
    rho, emission = _rows(elements.reflectance)[leaves[leaf]], _rows(model.patches.emission)[patch]
    return LitMesh(
        vertices=points[old],
        triangles=np.where(turned, number[:, ::-1], number),
        direct=direct[old],
        indirect=total[old] - direct[old],
        reflectance=_around(number, rho, len(old)),
        emission=_around(number, emission, len(old)),
        uv=uv.reshape(-1, 2)[first_of],
        leaf=leaf,
        shape=shape,
        back=back,
    )


def cut(triangles: np.ndarray, sides: "Sides") -> tuple[np.ndarray, np.ndarray]:
    """Cut triangles until no side has a vertex in its middle: the pieces [n, 3] and which triangle each is of [n].

    What a triangle becomes depends on its sides alone, so neighbours fit.
    """
    done, of = [], []
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
    done, of = np.concatenate(done), np.concatenate(of)
    order = np.argsort(of, kind="stable")
    return done[order], of[order]


# Pieces of a triangle by how many of its sides have a middle, as nodes: corners 0 to 2, middles opposite them 3 to 5.
PIECES = {
    1: ([0, 1, 3], [0, 3, 2]),
    2: ([0, 5, 4], [5, 1, 2], [5, 2, 4]),
    3: ([0, 5, 4], [5, 1, 3], [4, 3, 2], [3, 4, 5]),
}


class Sides:
    """The vertex in the middle of a side, by the two at its ends."""

    def __init__(self, low, high, middle):
        self._keys, first = np.unique(_side_keys(low, high), return_index=True)
        self._middle = middle[first]

    def middle(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Numbers of vertices, NONE where there is none [n]."""
        if not len(self._keys):
            return np.full(len(a), NONE)
        key = _side_keys(a, b)
        at = np.minimum(np.searchsorted(self._keys, key), len(self._keys) - 1)
        return np.where(self._keys[at] == key, self._middle[at], NONE)


def _side_keys(a, b):
    return (np.minimum(a, b).astype(np.uint64) << np.uint64(32)) | np.maximum(a, b).astype(np.uint64)


def _sides(vertices, elements) -> Sides:
    """Every side of the mesh that is split on either side of it."""
    corner, middle = (np.array(x).reshape(3, -1) for x in (vertices.corner, vertices.middle))
    ends = [(corner[k - 2], corner[k - 1], middle[k]) for k in range(3)]
    low, high, vertex = (np.concatenate(parts) for parts in zip(*ends))
    split = vertex != NONE
    return Sides(low[split], high[split], vertex[split])


def _points(model, elements, corner, count):
    """Where vertices are [count, 3], in float64: as the first element has them."""
    patch, faces = np.array(elements.patch), model.faces
    face = np.array(model.patches.face)[patch]
    u0, v0, scale = (np.array(x, dtype=np.float64)[:, None] for x in (elements.u0, elements.v0, elements.scale))
    points = np.empty((count, 3))
    for k, (a, b) in enumerate(NODES[:3]):
        at = faces.corners[face, 0] + (u0 + scale * a) * faces.e1[face] + (v0 + scale * b) * faces.e2[face]
        points[corner[::-1, k]] = at[::-1]
    return points


def _known(solution, field, flat):
    """Values of the vertices [vertices, 3]; where nothing is known of one, the mean of the leaves around."""
    values = _rows(field.values)
    unknown = np.isnan(values[:, 0])
    if unknown.any():
        leaves = np.array(solution.elements.leaves)
        corner = np.array(field.vertices.corner).reshape(3, -1).T[leaves]
        values[unknown] = _around(corner, _rows(flat)[leaves], len(values))[unknown]
    return values


def _around(triangles, values, count):
    """Means, at vertices, of values of the triangles around [count, 3]."""
    sums, index = np.zeros((count, 3)), triangles.ravel()
    for channel in range(3):
        sums[:, channel] = np.bincount(index, np.repeat(values[:, channel], 3), count)
    return sums / np.maximum(np.bincount(index, minlength=count), 1)[:, None]


def _texture_coordinates(model, face, points):
    """UV of corners of triangles on faces, where their shapes are textured [triangles, 3, 2]."""
    faces, uv = model.faces, np.full((len(face), 3, 2), np.nan)
    textured = np.array([is_textured(s.bsdf()) for s in model.scene.shapes()], dtype=bool)
    for number in np.flatnonzero(textured):
        chosen = np.flatnonzero(faces.shape[face] == number)
        f = np.repeat(face[chosen], 3)
        u, v = _barycentric(faces, f, points[chosen].reshape(-1, 3))
        si = faces.surface(owned(mi.UInt32, f), owned(mi.Float, u), owned(mi.Float, v))
        uv[chosen] = np.array(si.uv).T.reshape(-1, 3, 2)
    return uv


def _barycentric(faces, face, points):
    """(u, v) of points in the planes of faces (two float [n])."""
    e1, e2 = faces.e1[face], faces.e2[face]
    x, normal = points - faces.corners[face, 0], np.cross(e1, e2)
    n2 = (normal**2).sum(axis=1)
    return (np.cross(x, e2) * normal).sum(axis=1) / n2, (np.cross(e1, x) * normal).sum(axis=1) / n2


def _rounded(uv):
    return np.round(np.nan_to_num(uv) * 2**16).astype(np.int64).reshape(-1, 2)


def _rows(color):
    """A Color3f as NumPy [n, 3]."""
    return np.array(color, dtype=np.float64).reshape(3, -1).T
