import mi_radiosity  # chooses LLVM before drjit loads
from mi_radiosity.mesh.exposure import is_covered

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

mi.set_variant("llvm_ad_rgb")
mi.set_log_level(mi.LogLevel.Error)


ORACLES = [
    mi_radiosity.KS(),
    mi_radiosity.MI(),
    mi_radiosity.GMI(0.5),
    mi_radiosity.GMI(1.5),
    mi_radiosity.Power(),
    mi_radiosity.Uniform(),
]


@pytest.fixture(scope="session")
def cornell():
    return mi.load_dict(mi.cornell_box())


def scene(optimize=True, **shapes):
    """A scene of shapes given as dictionaries, with a small camera; ``optimize`` merges those that share a BSDF."""
    camera = {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb"},
    }
    return mi.load_dict({"type": "scene", "camera": camera, **shapes}, optimize=optimize)


def diffuse(reflectance=0.5, two_sided=False):
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}
    return {"type": "twosided", "bsdf": bsdf} if two_sided else bsdf


def lamp(exitance=1.0):
    """An area emitter of E = ``exitance`` W/m² per channel."""
    return {"type": "area", "radiance": {"type": "rgb", "value": exitance / np.pi}}


def rectangle(to_world=None, **parts):
    return {"type": "rectangle", "to_world": to_world or mi.ScalarTransform4f(), **parts}


def leaf_values(solution, name="radiosity"):
    """(values [leaves, 3], open areas [leaves], patches [leaves]) of a solution's leaves as NumPy arrays."""
    leaves = np.array(solution.elements.leaves)
    values = getattr(solution, name)
    values = np.array(values() if callable(values) else values).reshape(3, -1).T[leaves]
    return values, np.array(solution.exposure.open_area)[leaves], np.array(solution.elements.patch)[leaves]


def partition(solution):
    """The area of the leaves of every patch [patches]."""
    child, area, patch = (np.array(getattr(solution.elements, name)) for name in ("child", "area", "patch"))
    return np.bincount(patch[child == 0], weights=area[child == 0], minlength=solution.model.patches.count)


def mesh(vertices, faces, bsdf=None, emitter=None, name=""):
    """A triangle mesh of vertices [n, 3] and faces [m, 3] without vertex normals; normals follow the right hand."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf or diffuse())
    if emitter:
        properties["emitter"] = mi.load_dict(emitter)
    shape = mi.Mesh(name, len(vertices), len(faces), props=properties)
    params = mi.traverse(shape)
    params["vertex_positions"] = np.asarray(vertices, dtype=np.float32).ravel()
    params["faces"] = np.asarray(faces, dtype=np.uint32).ravel()
    params.update()
    return shape


def quad(corners, **parts):
    """Two triangles over four corners, counter-clockwise as seen from the side they face."""
    return mesh(corners, [[0, 1, 2], [0, 2, 3]], **parts)


def icosphere(subdivisions, inwards=True):
    """(vertices, faces) of a unit sphere made of 20 · 4^subdivisions triangles."""
    g = (1 + 5**0.5) / 2
    vertices = [
        (-1, g, 0),
        (1, g, 0),
        (-1, -g, 0),
        (1, -g, 0),
        (0, -1, g),
        (0, 1, g),
        (0, -1, -g),
        (0, 1, -g),
        (g, 0, -1),
        (g, 0, 1),
        (-g, 0, -1),
        (-g, 0, 1),
    ]
    faces = [
        (0, 11, 5),
        (0, 5, 1),
        (0, 1, 7),
        (0, 7, 10),
        (0, 10, 11),
        (1, 5, 9),
        (5, 11, 4),
        (11, 10, 2),
        (10, 7, 6),
        (7, 1, 8),
        (3, 9, 4),
        (3, 4, 2),
        (3, 2, 6),
        (3, 6, 8),
        (3, 8, 9),
        (4, 9, 5),
        (2, 4, 11),
        (6, 2, 10),
        (8, 6, 7),
        (9, 8, 1),
    ]
    corners = np.array(vertices)[np.array(faces)] / np.sqrt(1 + g * g)
    for _ in range(subdivisions):
        a, b, c = corners.transpose(1, 0, 2)
        ab, bc, ca = (x / np.linalg.norm(x, axis=1)[:, None] for x in (a + b, b + c, c + a))
        corners = np.concatenate([np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    vertices, index = np.unique(corners.reshape(-1, 3).round(12), axis=0, return_inverse=True)
    faces = index.reshape(-1, 3)
    return vertices, faces[:, ::-1] if inwards else faces


def group(model, reflectance):
    """Numbers of the patches with a reflectance (UInt32 NumPy array): how tests tell surfaces apart."""
    return np.flatnonzero(np.isclose(np.array(model.patches.reflectance)[0], reflectance, atol=1e-6)).astype(np.uint32)


def balance(solution):
    """Power accounted for over power emitted; 1 if none is lost."""
    power = solution.stats["power"]
    return (power["absorbed"] + power["escaped"] + power["unshot"]) / power["emitted"]


def leaf_corners(solution):
    """Corners of the leaves in the coordinates of the scene [leaves, 3, 3]."""
    return solution.leaves().vertices


def border_values(solution):
    """Field values on the borders of all leaves, at dyadic points that are shown.

    Positions [n, 3], normals [n, 3], values [n, 3] and shapes [n].
    """
    e, model = solution.elements, solution.model
    leaves = np.array(e.leaves)
    level = np.round(-np.log2(np.abs(np.array(e.scale)[leaves]))).astype(int)
    finest = min(level.max(), 9)
    steps = 2 ** np.maximum(finest - level, 0)
    leaf = np.repeat(leaves, 3 * steps)
    start = np.repeat(np.cumsum(3 * steps) - 3 * steps, 3 * steps)
    number, step = np.arange(len(leaf)) - start, np.repeat(steps, 3 * steps)
    side, t = number // step, (number % step) / step
    a = np.choose(side, [t, 1 - t, 0 * t]).astype(np.float32)
    b = np.choose(side, [0 * t, t, 1 - t]).astype(np.float32)
    index = mi.UInt32(leaf)
    u, v = e.patch_point(index, mi.Float(a), mi.Float(b))
    patch = dr.gather(mi.UInt32, e.patch, index)
    shown = ~np.array(is_covered(e, model.rays, index, u, v)).astype(bool)
    found = (
        mi_radiosity.solver.Field(solution).at(index, u, v),
        model.patches.point(patch, u, v),
        dr.gather(mi.Vector3f, model.patches.normal, patch),
    )
    values, points, normals = (np.array(x).T[shown] for x in found)
    return points, normals, values, model.faces.shape[np.array(dr.gather(mi.UInt32, model.patches.face, patch))[shown]]


def gaps_between_leaves(solution):
    """Differences, relative to the brightest value, between leaves where they meet on one shape [places]."""
    points, normals, values, shapes = border_values(solution)
    key = np.round(np.column_stack([points * 2**14, normals * 100, shapes])).astype(np.int64)
    _, group = np.unique(key, axis=0, return_inverse=True)
    low, high = np.full((group.max() + 1, 3), np.inf), np.full((group.max() + 1, 3), -np.inf)
    np.minimum.at(low, group.ravel(), values)
    np.maximum.at(high, group.ravel(), values)
    return (high - low).max(axis=1)[np.bincount(group.ravel()) > 1] / max(values.max(), 1e-30)


def wall_means(solution):
    """Mean radiosity of every wall {number: [3]}; what lies inside solids counts as dark, as it does for others."""
    values, areas, patches = leaf_values(solution)
    walls, whole = names_of_walls(solution.model), np.array(solution.model.patches.area)
    return {
        wall: areas[walls[patches] == wall] @ values[walls[patches] == wall] / whole[walls == wall].sum()
        for wall in np.unique(walls)
    }


def names_of_walls(model):
    """One number per patch, the same for patches of one reflectance in one plane."""
    normal, point = np.array(model.patches.normal).T, np.array(model.patches.p0).T
    key = np.column_stack([normal, (normal * point).sum(axis=1), np.array(model.patches.reflectance).T]).round(2) + 0.0
    return np.unique(key, axis=0, return_inverse=True)[1].ravel()
