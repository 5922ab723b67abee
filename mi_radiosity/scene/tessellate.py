"""Triangle meshes in the place of shapes that are not meshes."""
import drjit as dr
import mitsuba as mi
import numpy as np

SEGMENTS = 32


def disk_mesh(disk):
    """A fan of triangles with exactly the area of ``disk``, so that a lamp keeps its power."""
    angle = np.arange(SEGMENTS) / SEGMENTS
    rim = disk.eval_parameterization(mi.Point2f(1.0, mi.Float(angle.astype(np.float32))))
    middle = disk.eval_parameterization(mi.Point2f(0.0, 0.0))
    centre = np.array(middle.p, dtype=np.float64).reshape(3)
    radius = np.sqrt(2 * np.pi / SEGMENTS / np.sin(2 * np.pi / SEGMENTS))
    outer = centre + radius * (np.array(rim.p, dtype=np.float64).reshape(3, -1).T - centre)
    vertices = np.vstack([centre, outer])
    first = np.arange(SEGMENTS) + 1
    second = first % SEGMENTS + 1
    normal = np.array(middle.sh_frame.n).reshape(3)
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
