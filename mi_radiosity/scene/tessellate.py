"""Triangle meshes in the place of shapes that are not meshes."""

import drjit as dr
import mitsuba as mi
import numpy as np

SEGMENTS = 32


def disk_mesh(disk):
    """A fan of triangles with exactly the area of ``disk``, so that a lamp keeps its power."""
    angle = np.arange(SEGMENTS) / SEGMENTS
    # Half-way out: Mitsuba finds these points by tracing, and rays at the very rim may miss.
    ring = disk.eval_parameterization(mi.Point2f(0.5, mi.Float(angle.astype(np.float32))))
    points = np.array(ring.p, dtype=np.float64).reshape(3, -1).T
    centre = points.mean(axis=0)
    radius = np.sqrt(2 * np.pi / SEGMENTS / np.sin(2 * np.pi / SEGMENTS))
    outer = centre + 2 * radius * (points - centre)
    vertices = np.vstack([centre, outer])
    first = np.arange(SEGMENTS) + 1
    second = first % SEGMENTS + 1
    normal = np.array(ring.sh_frame.n).reshape(3, -1)[:, 0]
    if np.dot(np.cross(outer[0] - centre, outer[1] - centre), normal) < 0:
        first, second = second, first
    faces = np.column_stack([np.zeros(SEGMENTS, int), first, second])
    return build_mesh(disk.id(), vertices, faces, disk.bsdf())


def build_mesh(name, vertices, faces, bsdf):
    """An ``mi.Mesh`` without vertex normals from vertices [n, 3], faces [m, 3] and a BSDF."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    mesh = mi.Mesh(name, len(vertices), len(faces), props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.ascontiguousarray(vertices, dtype=np.float32).ravel())
    params["faces"] = mi.UInt32(np.ascontiguousarray(faces, dtype=np.uint32).ravel())
    params.update()
    dr.eval(params["vertex_positions"])
    return mesh
