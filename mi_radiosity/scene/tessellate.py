"""Triangle meshes in the place of shapes that are not meshes: one mesher per class of Mitsuba's shapes."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..core.plugins import Registry

SEGMENTS = 32
MESHERS = Registry("shape")


def mesher(shape_class: str) -> Callable:
    """Decorator: the function makes an mi.Mesh of a shape whose ``class_name()`` this is."""

    def register(function):
        MESHERS.add(shape_class, function)
        return function

    return register


def can_mesh(shape: "mi.Shape") -> bool:
    return isinstance(shape, mi.Mesh) or shape.class_name() in MESHERS


def as_mesh(shape: "mi.Shape") -> "mi.Mesh":
    """``shape`` itself if it is a mesh, or the mesh its mesher makes."""
    return shape if isinstance(shape, mi.Mesh) else MESHERS.find(shape.class_name())(shape)


def label(shape: "mi.Shape", index: int) -> str:
    """How a shape is called in messages: its id, or its place in the scene."""
    return f"shape '{shape.id()}'" if shape.id() else f"shape {index}"


@mesher("Disk")
def disk_mesh(disk: "mi.Shape") -> "mi.Mesh":
    """A fan of triangles with exactly the area of ``disk``, so that a lamp keeps its power."""
    angle = np.arange(SEGMENTS) / SEGMENTS
    # Half-way out: Mitsuba finds these points by tracing, and rays at the very rim may miss.
    ring = disk.eval_parameterization(mi.Point2f(0.5, mi.Float(angle.astype(np.float32))))
    points = np.array(ring.p, dtype=np.float64).reshape(3, -1).T
    centre = points.mean(axis=0)
    radius = np.sqrt(2 * np.pi / SEGMENTS / np.sin(2 * np.pi / SEGMENTS))
    outer = centre + 2 * radius * (points - centre)
    first = np.arange(SEGMENTS) + 1
    second = first % SEGMENTS + 1
    normal = np.array(ring.sh_frame.n).reshape(3, -1)[:, 0]
    if np.dot(np.cross(outer[0] - centre, outer[1] - centre), normal) < 0:
        first, second = second, first
    faces = np.column_stack([np.zeros(SEGMENTS, int), first, second])
    return build_mesh(disk, np.vstack([centre, outer]), faces)


def build_mesh(shape: "mi.Shape", vertices: ArrayLike, faces: ArrayLike) -> "mi.Mesh":
    """An ``mi.Mesh`` without vertex normals from vertices [n, 3] and faces [m, 3], with the BSDF of ``shape``."""
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    properties = mi.Properties()
    properties["mesh_bsdf"] = shape.bsdf()
    mesh = mi.Mesh(shape.id(), len(vertices), len(faces), props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.ascontiguousarray(vertices, dtype=np.float32).ravel())
    params["faces"] = mi.UInt32(np.ascontiguousarray(faces, dtype=np.uint32).ravel())
    params.update()
    dr.eval(params["vertex_positions"])
    return mesh
