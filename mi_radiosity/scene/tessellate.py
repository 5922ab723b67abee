"""Triangle meshes in the place of shapes that are not meshes: one mesher per class of Mitsuba's shapes."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby, product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned_vectors
from ..core.plugins import Registry
from .meshes import build_mesh, placed, repaired, unit

FEWEST, MOST = 12, 72  # segments around a shape
OUTLINE = 1 / 2000  # of the size of the scene: by how much a silhouette may miss
MESHERS = Registry("shape")
UNMESHED = {  # classes of Mitsuba's shapes that there is no mesher for
    "BSplineCurve": "curves",
    "LinearCurve": "curves",
    "SDFGrid": "signed distance fields",
    "Ellipsoids": "ellipsoids",
    "EllipsoidsMesh": "ellipsoids",
}


def mesher(shape_class: str) -> Callable:
    """Decorator: the function makes an mi.Mesh of a shape whose ``class_name()`` this is.

    It is called with the shape and its share of the size of the scene (0 to 1), by which it may choose how fine the
    mesh is.
    """

    def register(function):
        MESHERS.add(shape_class, function)
        return function

    return register


# ---- The shapes of a scene -------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """A shape that is traced: one of the scene's, or a member of the shape group that an instance places."""

    shape: Any  # Mitsuba's
    number: int  # in scene.shapes(), of the shape or of the instance
    name: str  # for messages
    to_world: np.ndarray | None = None  # [4, 4], of the instance

    @property
    def can_mesh(self) -> bool:
        """Is it a mesh, or is there a mesher for it?"""
        kind = self.shape.class_name()
        return kind in MESHERS or (isinstance(self.shape, mi.Mesh) and kind not in UNMESHED)


def label(shape: "mi.Shape", index: int) -> str:
    """How a shape is called in messages: its id, or its place in the scene."""
    return f"shape '{shape.id()}'" if shape.id() else f"shape {index}"


def parts(scene: "mi.Scene") -> list[Part]:
    """The shapes of a scene; instances come apart into the members of their group. Those whose group cannot be found
    stay whole."""
    groups, found = None, []
    for number, shape in enumerate(scene.shapes()):
        part = Part(shape, number, label(shape, number))
        if shape.class_name() != "Instance":
            found.append(part)
            continue
        if groups is None:
            groups = {child.id(): child for child in children(scene) if child.class_name().startswith("ShapeGroup")}
        # Mitsuba's Python side tells an instance's group only where it prints it.
        name = re.search(r'name = "(.*)"', str(shape))
        members = children(groups[name[1]]) if name and name[1] in groups else []
        matrix = transform_of(shape)
        for k, member in enumerate(m for m in members if isinstance(m, mi.Shape)):
            found.append(
                Part(member, number, f"{label(member, k)} of {part.name.replace('shape', 'instance', 1)}", matrix)
            )
        if not members:
            found.append(part)
    return found


def transform_of(shape: "mi.Shape") -> np.ndarray:
    """The transform of a shape (float64 [4, 4])."""
    return np.array(mi.traverse(shape)["to_world"].matrix, dtype=np.float64).reshape(4, 4)


def children(thing: "mi.Object") -> list:
    """The Mitsuba objects that ``thing`` is made of."""

    class Collect(mi.TraversalCallback):
        found = ()

        def put(self, name, value, *_):
            if hasattr(value, "class_name"):
                self.found += (value,)

    callback = Collect()
    thing.traverse(callback)
    return list(callback.found)


def tracing_scene(scene: "mi.Scene") -> "tuple[mi.Scene, list[Part], list[str]]":
    """The scene itself, or one in which every shape is a mesh whose normals have a direction; its parts in Mitsuba's
    order; and the names of those whose normals were replaced."""
    found = parts(scene)
    sound = {part.shape.ptr: repaired(part.shape) for part in found if isinstance(part.shape, mi.Mesh)}
    mended = [part.name for part in found if sound.get(part.shape.ptr) is not None]
    if not mended and all(part.to_world is None and isinstance(part.shape, mi.Mesh) for part in found):
        return scene, found, mended
    size = _size(found)
    meshes = [as_mesh(part, size, sound.get(part.shape.ptr) or part.shape) for part in found]
    names = [part.shape.id() for part in found]
    tracing = mi.load_dict({"type": "scene"} | {f"shape_{i}": mesh for i, mesh in enumerate(meshes)}, optimize=False)
    for part, name in zip(found, names):
        part.shape.set_id(name)  # load_dict has given those that are in both scenes another
    by_pointer = {mesh.ptr: part for mesh, part in zip(meshes, found)}
    return tracing, [by_pointer[shape.ptr] for shape in tracing.shapes()], mended


def _size(found):
    """Length of the diagonal of the box around parts, m. Mitsuba's own boxes are wrong for meshes that Mitsuba 3.9.1
    has merged (docs/mitsuba_issues.md), so the box of a mesh is that of its vertices."""
    boxes = []
    for _, members in groupby(found, key=lambda part: part.number):
        first, *others = members
        corners = np.concatenate([_points(part.shape) for part in (first, *others)])
        if first.to_world is not None and len(corners):  # as Mitsuba bounds an instance: by its group's box
            corners = np.array(list(product(*zip(corners.min(axis=0), corners.max(axis=0)))))
            corners = corners @ first.to_world[:3, :3].T + first.to_world[:3, 3]
        boxes.append(corners)
    corners = np.concatenate(boxes)
    return float(np.linalg.norm(np.ptp(corners, axis=0))) if len(corners) else 0.0


def _points(shape):
    """The finite vertices of a mesh, or two corners of the box around another shape (float64 [n, 3])."""
    if isinstance(shape, mi.Mesh):
        vertices = np.array(shape.vertex_positions_buffer(), dtype=np.float64).reshape(-1, 3)
        return vertices[np.isfinite(vertices).all(axis=1)]
    return np.array([shape.bbox().min, shape.bbox().max], dtype=np.float64).reshape(2, 3)


def as_mesh(part: Part, scene_size: float, shape: "mi.Shape") -> "mi.Mesh":
    """The mesh of a part where it stands: ``shape``, its own or a copy with other normals, if that is a mesh."""
    if not isinstance(shape, mi.Mesh):
        box = shape.bbox()
        extent = np.linalg.norm(np.array(box.max) - np.array(box.min))
        if part.to_world is not None:
            extent *= np.linalg.norm(part.to_world[:3, :3], 2)  # the direction that the instance stretches most
        shape = MESHERS.find(shape.class_name())(shape, min(float(extent) / max(scene_size, 1e-30), 1.0))
    return shape if part.to_world is None else placed(shape, part.to_world)


# ---- Meshers ---------------------------------------------------------------------------------------


def segments(share: float) -> int:
    """Segments around a round shape, a multiple of 4: few, yet a silhouette misses by no more than OUTLINE of the size
    of the scene, half a pixel where a picture of all of it has 1000."""
    wanted = np.pi * np.sqrt(share / (4 * OUTLINE) / 2)  # r (1 − cos(π/n)), half of it inwards and half outwards
    return 4 * int(np.ceil(np.clip(wanted, FEWEST, MOST) / 4))


def _in_world(shape, linear, vertices, faces, uv, normals=None):
    """The mesh of a shape from its object space: vertices [n, 3] and outward normals [n, 3], +z for flat shapes.

    linear: the transform of ``vertices`` without its translation [3, 3]. Faces are oriented along the normals. Mitsuba
    decides which side is the front, because ``flip_normals`` and mirrored transforms combine differently per shape.
    """
    vertices = vertices @ linear.T + transform_of(shape)[:3, 3]
    up = unit((normals if normals is not None else np.array([[0.0, 0.0, 1.0]])) @ np.linalg.inv(linear))
    every = np.broadcast_to(up, vertices.shape)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if (cross * every[faces[:, 0]]).sum() < 0:
        faces = faces[:, ::-1]
    middle = corners.mean(axis=1)  # off the centre of a disk, where its parametrisation is singular
    front = _vectors(surface_at(shape, middle, every[faces[:, 0]]).sh_frame.n)
    flipped = bool((front * every[faces[:, 0]]).sum() < 0)
    return build_mesh(shape, vertices, faces, None if normals is None else up, uv, flipped)


def surface_at(shape: "mi.Shape", points: np.ndarray, normals: np.ndarray) -> "mi.SurfaceInteraction3f":
    """Mitsuba's surface interactions where rays against ``normals`` hit a sphere, a cylinder or a disk at ``points``.

    points, normals: [n, 3], m and unit length, in world space. No ray is traced: the points are taken as hits.
    """
    n = len(points)
    prelim = dr.zeros(mi.PreliminaryIntersection3f, n)
    prelim.valid, prelim.t, prelim.shape = dr.full(mi.Bool, True, n), 0.0, mi.ShapePtr(shape)
    ray = dr.zeros(mi.Ray3f, n)
    ray.o, ray.d = owned_vectors(mi.Point3f, points), owned_vectors(mi.Vector3f, -normals)
    return prelim.compute_surface_interaction(ray, mi.RayFlags.All)


def _vectors(array):
    """A Dr.Jit array of vectors as NumPy rows (float64 [n, 3])."""
    return np.array(array, dtype=np.float64).T


@mesher("Disk")
def disk_mesh(disk: "mi.Shape", share: float) -> "mi.Mesh":
    """Rings of triangles with exactly the area of ``disk``; every ring has twice the segments of the one inside it."""
    n, radius = segments(share), 1.0
    stretch = np.sqrt(np.pi / (n / 2 * np.sin(2 * np.pi / n)))
    rings, wedges, first = [], [], 0
    while True:
        k = np.arange(n + 1)
        rings.append(np.column_stack([np.full(n + 1, radius), k / n]))
        k, inner = k[:-1], first + n + 1
        if n % 2 or n <= 8:
            rings.append(np.column_stack([np.zeros(n), (k + 0.5) / n]))  # the centre, once per segment for the textures
            wedges.append(np.column_stack([inner + k, first + k, first + k + 1]))
            break
        n, radius = n // 2, radius / 2
        k = np.arange(n)
        outer = first + 2 * k
        for triangle in (
            (inner + k, outer, outer + 1),
            (inner + k, outer + 1, inner + k + 1),
            (inner + k + 1, outer + 1, outer + 2),
        ):
            wedges.append(np.column_stack(triangle))
        first = inner
    uv, faces = np.vstack(rings), np.vstack(wedges)
    vertices = stretch * uv[:, :1] * _circle(uv[:, 1])
    return _in_world(disk, transform_of(disk)[:3, :3], np.column_stack([vertices, np.zeros(len(uv))]), faces, uv)


@mesher("Cylinder")
def cylinder_mesh(cylinder: "mi.Shape", share: float) -> "mi.Mesh":
    """A prism with exactly the area of ``cylinder`` (if it is round), and the cylinder's normals."""
    matrix = transform_of(cylinder)
    n, (radius, _, length) = segments(share), np.linalg.norm(matrix[:3, :3], axis=0)
    rows = int(np.clip(np.ceil(length * n / (2 * np.pi * radius) / 4), 1, 16))  # triangles at most four times as long
    i, j = (x.ravel() for x in np.meshgrid(np.arange(n), np.arange(rows)))
    low, high = j * (n + 1) + i, (j + 1) * (n + 1) + i
    faces = np.vstack([np.column_stack([low, low + 1, high + 1]), np.column_stack([low, high + 1, high])])
    u, v = (x.ravel() for x in np.meshgrid(np.arange(n + 1) / n, np.arange(rows + 1) / rows))
    around = _circle(u)
    stretch = np.pi / (n * np.sin(np.pi / n))
    normals = np.column_stack([around, np.zeros(len(u))])
    vertices = np.column_stack([stretch * around, v])
    return _in_world(cylinder, matrix[:3, :3], vertices, faces, np.column_stack([u, v]), normals)


@mesher("Sphere")
def sphere_mesh(sphere: "mi.Shape", share: float) -> "mi.Mesh":
    """Eight octants of equal triangles with exactly the area of ``sphere``, and its normals.

    Twice as fine as other shapes: lamps that cameras see are spheres more often, and their outlines bright.
    """
    n = segments(share) // 2
    j, i = (x[np.tril_indices(n + 1)] for x in np.indices((n + 1, n + 1)))  # from the pole down, and around
    at = lambda j, i: j * (j + 1) // 2 + i
    rows, k = j[j < n], i[j < n]
    up = np.column_stack([at(rows, k), at(rows + 1, k), at(rows + 1, k + 1)])
    below = k < rows
    down = np.column_stack([at(rows, k), at(rows + 1, k + 1), at(rows, k + 1)])[below]
    octant, count = np.vstack([up, down]), len(j)
    grids: list[np.ndarray] = []
    octants: list[np.ndarray] = []
    for quarter in range(4):
        around = np.where(j > 0, (quarter + i / np.maximum(j, 1)) / 4, (quarter + 0.5) / 4)
        for south in (False, True):
            octants.append((octant[:, ::-1] if south else octant) + len(grids) * count)
            grids.append(np.column_stack([around, (1 - j / (2 * n)) if south else j / (2 * n)]))
    uv, faces = np.vstack(grids), np.vstack(octants)
    height = np.where(uv[:, 1] == 0.5, 0, np.cos(np.pi * uv[:, 1]))
    across = np.where(np.isin(uv[:, 1], (0, 1)), 0, np.sin(np.pi * np.minimum(uv[:, 1], 1 - uv[:, 1])))
    normals = np.column_stack([across[:, None] * _circle(uv[:, 0]), height])
    corners = normals[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    linear = transform_of(sphere)[:3, :3]
    left, scales, right = np.linalg.svd(linear)
    # Mitsuba traces a round sphere whatever its transform.
    radius = np.sqrt(float(np.array(sphere.surface_area()).item()) / (4 * np.pi))
    if not np.allclose(scales, radius, rtol=1e-5):
        turn = left @ right
        linear, uv = radius * turn, _texture_of_stretched(sphere, radius, normals @ turn.T, uv)
    return _in_world(sphere, linear, np.sqrt(4 * np.pi / area) * normals, faces, uv, normals)


def _texture_of_stretched(sphere, radius, normals, uv):
    """Texture coordinates that Mitsuba gives the points of a sphere whose transform is not a similarity [n, 2].

    Mitsuba computes them by the inverse of the transform, and finds no latitude (NaN) at some points: those keep
    ``uv``, as do the poles, where the longitude is undefined. Longitudes stay within half a turn of ``uv``, so that
    no triangle spans the seam.
    """
    points = transform_of(sphere)[:3, 3] + radius * normals
    found = np.array(surface_at(sphere, points, normals).uv, dtype=np.float64).T
    found[:, 0] = uv[:, 0] + (found[:, 0] - uv[:, 0] + 0.5) % 1 - 0.5
    pole = np.isin(uv[:, 1:], (0, 1))
    return np.where(np.isfinite(found) & ~pole, found, uv)


def _circle(turn):
    """Points of the unit circle (NumPy [n, 2]), where it closes the same to the bit."""
    angle = 2 * np.pi * np.where(turn == 1, 0, turn)
    return np.column_stack([np.cos(angle), np.sin(angle)])
