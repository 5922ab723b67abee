"""The lit mesh: welded triangles of a solution, for whoever shows them without this package."""

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, owned
from ..mesh.exposure import TUCK
from ..mesh.subdivision import NODES
from ..scene import Model
from ..scene.materials import is_diffuse, is_textured, varies_over_uv
from ..scene.tessellate import Part
from ..solver import Solution
from ..solver.field import Field
from .cutting import cut, sides_of
from .walls import beside_walls, patch_coordinates

APART = 0.02  # how far, relatively, a value beside a wall may be from that of its vertex and still be welded to it

RAISE = 1e-4  # of the diagonal of its box: how far apart a mesh has sides in one plane on screens


@dataclass(frozen=True)
class LitMesh:
    """Triangles with the Gouraud field of a solution at their vertices; NumPy arrays, one row each.

    A leaf is one triangle, or is cut at the vertices that hang on its sides, so that triangles of one surface meet
    along whole sides. Vertices are shared within a side of a shape, where they share a shading normal, a texture's
    coordinates or a colour of vertices and, beside walls, their light. Triangles are counter-clockwise as seen from the
    side that is lit.
    """

    vertices: np.ndarray  # [vertices, 3] m, in the coordinates of the scene
    triangles: np.ndarray  # [triangles, 3] numbers of vertices
    direct: np.ndarray  # [vertices, 3] irradiance from the lamps' first flight, W/m²
    indirect: np.ndarray  # [vertices, 3] from all later ones
    reflectance: np.ndarray  # [vertices, 3] ρ, the mean over the leaves around; of colours of vertices and faces ρ here
    emission: np.ndarray  # [vertices, 3] E, W/m²
    uv: np.ndarray  # [vertices, 2] coordinates of the shape's texture, NaN where it has none over (u, v)
    leaf: np.ndarray  # [triangles] number of the leaf among the leaves of the solution, −1 where no light comes
    shape: np.ndarray  # [triangles] number of the shape among the parts of the scene, model.faces.parts
    back: np.ndarray  # [triangles] bool: the back of the shape
    above: np.ndarray  # [triangles] how many lit sides lie in the same plane below it
    lamps: np.ndarray  # [vertices, lamps, 2, 3] direct and indirect by lamp, if asked for; else there are 0 lamps
    # [vertices, 1 + lamps, 2, 3] τ H of the other side of faces that transmit, W/m²: from all emitters, then by lamp;
    # direct and indirect
    through: np.ndarray

    @property
    def irradiance(self) -> np.ndarray:
        """H, W/m² [vertices, 3]."""
        return self.direct + self.indirect

    @property
    def radiosity(self) -> np.ndarray:
        """B = E + ρ H, W/m² [vertices, 3]; where faces transmit, τ H of the other side is added."""
        return self.emission + self.reflectance * self.irradiance + self.through[:, 0].sum(axis=1)

    @property
    def size(self) -> float:
        """The diagonal of the box around it, m."""
        return float(np.linalg.norm(np.ptp(self.vertices, axis=0)))

    def raised(self, by: float) -> np.ndarray:
        """``vertices``, those of triangles ``above`` others lifted off the plane, m for each [vertices, 3]."""
        chosen = self.above > 0
        corner, above = self.triangles[chosen], self.above[chosen]
        a, b, c = (self.vertices[corner[:, k]] for k in range(3))
        normal, height = np.zeros_like(self.vertices), np.zeros(len(self.vertices))
        for k in range(3):
            np.add.at(normal, corner[:, k], np.cross(b - a, c - a))
            np.maximum.at(height, corner[:, k], above)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return self.vertices + by * height[:, None] * normal / np.where(length > 0, length, 1)

    def areas(self) -> np.ndarray:
        """Areas of the triangles, m² [triangles]."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def lit_mesh(solution: Solution, by_lamp: bool = False) -> LitMesh:
    """The triangles of a solution, with the values of its Gouraud picture, and the opaque faces that no light reaches.

    by_lamp: also the light of every lamp by itself as the scene has it, of a solution with layers.
    Mirrors and glass, as far as they have no diffuse lobe, are left out or black: nothing can be baked of them.
    """
    mesh, dark = _lit(solution, by_lamp), dark_faces(solution.model)
    n, corners = len(dark), solution.model.faces.corners[dark].reshape(-1, 3)
    black = np.zeros((3 * n, 3))
    more = LitMesh(
        corners,
        np.arange(3 * n).reshape(n, 3) + len(mesh.vertices),
        black,
        black,
        black,
        black,
        np.full((3 * n, 2), np.nan),
        np.full(n, -1),
        solution.model.faces.shape[dark],
        np.zeros(n, dtype=bool),
        np.zeros(n, dtype=np.int64),
        np.zeros((3 * n, *mesh.lamps.shape[1:])),
        np.zeros((3 * n, *mesh.through.shape[1:])),
    )
    return LitMesh(*(np.concatenate([getattr(m, field.name) for m in (mesh, more)]) for field in fields(LitMesh)))


def name_of(parts: list[Part], number: int) -> str:
    """How files call a part of a scene."""
    return parts[number].shape.id() or f"shape-{number}"


def dark_faces(model: Model) -> np.ndarray:
    """Numbers of opaque faces neither side of which is a patch or lies under one."""
    faces, known = model.faces, np.zeros(len(model.faces), dtype=bool)
    known[np.array(model.patches.face)] = True
    if model.rays.overlaps:
        known[model.rays.overlaps.under // 2] = True
    through = int(mi.BSDFFlags.Transmission) & ~int(mi.BSDFFlags.DiffuseTransmission)
    clear = [bool(int(part.shape.bsdf().flags()) & through) for part in faces.parts]
    return np.flatnonzero(~known & ~faces.degenerate & ~np.array(clear)[faces.shape])


def _lit(solution, by_lamp):
    elements, model = solution.elements, solution.model
    lights = [solution]
    if by_lamp:
        every = range(len(solution.layers.names))
        lights += [solution.relight({other: float(other == lamp) for other in every}) for lamp in every]
    layers = [field for light in lights for field in (light.field, Field(light, light.direct))]
    vertices, leaves = layers[0].vertices, np.array(elements.leaves)
    corner = np.array(vertices.corner).reshape(3, -1).T
    pieces, of = cut(corner[leaves].astype(np.int64), sides_of(vertices, elements))
    table = np.hstack([_points(model, elements, corner, vertices.count), *(_known(f, corner[leaves]) for f in layers)])
    table, pieces, of, values, beside = beside_walls(solution, layers, table, pieces, of)
    values = _with_direct_below(values, pieces.shape).reshape(*pieces.shape, -1)
    mean = values.mean(axis=(0, 1)) + 1e-30

    patch = np.array(elements.patch)[leaves[of]]
    face, back = np.array(model.patches.face)[patch], np.array(model.patches.back).astype(bool)[patch]
    shape = model.faces.shape[face]
    uv = _texture_coordinates(model, face, table[pieces, :3])
    colors = _colors(model, face, back, table[pieces, :3])
    own = beside[:, None] & (np.abs(values - table[pieces, 3:]) > APART * (values + mean)).any(axis=2)
    step = np.round(np.log(values + mean / 100) / APART).astype(np.int64)
    apart = np.where(own[..., None], step, np.iinfo(np.int64).max).reshape(len(own) * 3, -1)
    key = [pieces.ravel(), np.repeat(2 * shape + back, 3), *apart.T, *_rounded(uv)]
    if colors is not None:
        key += _rounded(colors, 2**12)
    first, number = _unique(key)
    number, values = number.reshape(-1, 3), values.reshape(len(own) * 3, -1, 2, 3)[first]
    turned = (back ^ model.faces.flipped[face])[:, None]
    rho, emission = _rows(elements.reflectance)[leaves[of]], _rows(elements.emission(elements.leaves))[of]
    reflectance = _around(number, rho, len(first))
    if colors is not None:
        colors = colors.reshape(-1, 3)[first]
        reflectance = np.where(np.isnan(colors), reflectance, colors)
    return LitMesh(
        vertices=table[pieces.ravel()[first], :3],
        triangles=np.where(turned, number[:, ::-1], number),
        direct=values[:, 0, 1],
        indirect=values[:, 0, 0] - values[:, 0, 1],
        reflectance=reflectance,
        emission=_around(number, emission, len(first)),
        uv=uv.reshape(-1, 2)[first],
        leaf=of,
        shape=shape,
        back=back,
        above=sides_below(model, face, back),
        lamps=_direct_and_indirect(values[:, 1:]),
        through=_through(solution, layers, patch, table[pieces, :3], number, len(first)),
    )


def _with_direct_below(values, shape):
    """Light of all emitters and of each, in all and direct, which is no more [*shape, lights, 2, 3]."""
    values = values.reshape(*shape, -1, 2, 3)
    values[..., 1, :] = np.minimum(values[..., 1, :], values[..., 0, :])
    return values


def _direct_and_indirect(values):
    """Direct and indirect light from light in all and direct [vertices, lights, 2, 3]."""
    return np.stack([values[:, :, 1], values[:, :, 0] - values[:, :, 1]], axis=2)


def _through(solution, fields, patch, points, number, count):
    """τ H of the other side at vertices, direct and indirect [count, lights, 2, 3]: means over the corners of pieces
    of patches, ``points`` [pieces, 3, 3], whose vertices are ``number`` [pieces, 3]."""
    patches, lights = solution.model.patches, len(fields) // 2
    found = np.zeros((count, 3 * len(fields)))
    if patches.twin is None:
        return found.reshape(count, lights, 2, 3)
    chosen = np.flatnonzero(patches.twin[patch] != NONE)
    inside = (1 - TUCK) * points[chosen] + TUCK * points[chosen].mean(axis=1, keepdims=True)
    here = owned(mi.UInt32, np.repeat(patch[chosen], 3))
    u, v = patch_coordinates(patches, here, inside.reshape(-1, 3) - solution.model.faces.centre)
    twin, tau, there = patches.behind(here)
    leaf = solution.elements.leaf_at(twin, u, v, there)
    light = np.concatenate([np.array(tau * dr.select(there, field.at(leaf, u, v, there), 0)) for field in fields]).T
    for at, column in zip(found.T, light.T):
        at += np.bincount(number[chosen].ravel(), column, count)
    found /= np.maximum(np.bincount(number[chosen].ravel(), minlength=count), 1)[:, None]
    return _direct_and_indirect(_with_direct_below(found, (count,)))


def sides_below(model: Model, face: np.ndarray, back: np.ndarray) -> np.ndarray:
    """How many patches sides of faces lie on; a back lies on its own front."""
    height, known = np.zeros(2 * len(model.faces), dtype=np.int64), np.zeros(2 * len(model.faces), dtype=bool)
    known[2 * np.array(model.patches.face) + np.array(model.patches.back).astype(np.int64)] = True
    height[1::2] = known[::2] & known[1::2]
    overlaps, before = model.rays.overlaps, None
    while overlaps and (before is None or (before != height).any()):
        before, on_patch = height.copy(), known[overlaps.under]
        np.maximum.at(height, overlaps.over[on_patch], before[overlaps.under[on_patch]] + 1)
    return height[2 * face + back]


def _points(model, elements, corner, count):
    """Where vertices are [count, 3], in float64: as the first element has them."""
    chosen, faces = corner[:, 0] != NONE, model.faces  # clusters have no corners
    corner, patch = corner[chosen], np.array(elements.patch)[chosen]
    face = np.array(model.patches.face)[patch]
    u0, v0, scale = (np.array(x, dtype=np.float64)[chosen, None] for x in (elements.u0, elements.v0, elements.scale))
    points = np.empty((count, 3))
    for k, (a, b) in enumerate(NODES[:3]):
        at = faces.corners[face, 0] + (u0 + scale * a) * faces.e1[face] + (v0 + scale * b) * faces.e2[face]
        points[corner[::-1, k]] = at[::-1]
    return points


def _known(field, leaf_corners):
    """Values of the vertices [vertices, 3]; where nothing is known of one, the mean of the leaves around."""
    values = _rows(field.values)
    unknown = np.isnan(values[:, 0])
    if unknown.any():
        values[unknown] = _around(leaf_corners, _rows(field.of_leaves), len(values))[unknown]
    return values


def _around(triangles, values, count):
    """Means, at vertices, of values of the triangles around [count, 3]."""
    index = triangles.ravel()
    sums = [np.bincount(index, np.repeat(column, 3), count) for column in values.T]
    return np.column_stack(sums) / np.maximum(np.bincount(index, minlength=count), 1)[:, None]


def _texture_coordinates(model, face, points):
    """UV of the corners of pieces of faces, where their shapes have textures over (u, v) [pieces, 3, 2]."""
    faces, uv = model.faces, np.full((len(face), 3, 2), np.nan)
    textured = [varies_over_uv(p.shape.bsdf()) and is_diffuse(p.shape.bsdf()) for p in faces.parts]
    for number in np.flatnonzero(textured):
        chosen = np.flatnonzero(faces.shape[face] == number)
        si = faces.surface(*_on_faces(faces, face[chosen], points[chosen]))
        uv[chosen] = np.array(si.uv).T.reshape(-1, 3, 2)
    return uv


def _colors(model, face, back, points):
    """ρ at the corners of pieces of faces, where it varies with more than (u, v), as colours of vertices and faces do
    [pieces, 3, 3]; NaN elsewhere, and None if that is everywhere."""
    faces, bsdfs = model.faces, [part.shape.bsdf() for part in model.faces.parts]
    varied = np.array([is_diffuse(b) and is_textured(b) and not varies_over_uv(b) for b in bsdfs])
    chosen = np.flatnonzero(varied[faces.shape[face]])
    if not len(chosen):
        return None
    colors = np.full((len(face), 3, 3), np.nan)
    behind = owned(mi.UInt32, np.repeat(back[chosen], 3)) == 1
    rho = model.materials.reflectance_at(*_on_faces(faces, face[chosen], points[chosen]), behind)
    colors[chosen] = np.array(rho, dtype=np.float64).reshape(3, -1).T.reshape(-1, 3, 3)
    return colors


def _on_faces(faces, face, points):
    """Faces and barycentric coordinates of points on them [pieces, 3, 3] (UInt32, Float, Float [3 pieces])."""
    of = np.repeat(face, 3)
    u, v = barycentric(faces.corners[of], points.reshape(-1, 3))
    return owned(mi.UInt32, of), owned(mi.Float, u), owned(mi.Float, v)


def barycentric(corners: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(u, v) of points [n, 3] in triangles [n, 3, 3] (two float [n])."""
    e1, e2, x = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], points - corners[:, 0]
    normal = np.cross(e1, e2)
    n2 = (normal**2).sum(axis=1)
    return (np.cross(x, e2) * normal).sum(axis=1) / n2, (np.cross(e1, x) * normal).sum(axis=1) / n2


def _unique(columns):
    """The first row of each kind, in order, and the kind of every row, of a table of integers given by columns."""
    order = np.lexsort(columns)
    new = np.ones(len(order), dtype=bool)
    new[1:] = np.any([column[order][1:] != column[order][:-1] for column in columns], axis=0)
    first, number = order[new], np.empty(len(order), dtype=np.int64)
    place = np.argsort(np.argsort(first))
    number[order] = place[np.cumsum(new) - 1]
    return np.sort(first), number


def _rounded(values, steps=2**16):
    """Columns of values [..., k] in so many steps per unit, 0 for NaN."""
    return list(np.round(np.nan_to_num(values) * steps).astype(np.int64).reshape(-1, values.shape[-1]).T)


def _rows(color):
    """A Color3f as NumPy [n, 3]."""
    return np.array(color, dtype=np.float64).reshape(3, -1).T
