"""Meshes made from arrays: of other shapes, under transforms, and without vertex normals that have no direction."""

import drjit as dr
import mitsuba as mi
import numpy as np

TINY = float(np.finfo(np.float32).tiny)  # squared lengths below it, or above the largest float32, have no direction


def build_mesh(
    shape: "mi.Shape",
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None = None,
    uv: np.ndarray | None = None,
    flipped: bool = False,
) -> "mi.Mesh":
    """An ``mi.Mesh`` from vertices [n, 3] and faces [m, 3], with the BSDF of ``shape``; with normals [n, 3] and texture
    coordinates [n, 2] of the vertices, where they are given. ``flipped``: its front is where the normals point away."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = shape.bsdf()
    properties["flip_normals"] = flipped
    given = {"has_vertex_normals": normals is not None, "has_vertex_texcoords": uv is not None}
    mesh = mi.Mesh(shape.id(), len(vertices), len(faces), props=properties, **given)
    params = mi.traverse(mesh)
    params["vertex_positions"] = _flat(mi.Float, vertices)
    params["faces"] = _flat(mi.UInt32, faces)
    if uv is not None:
        params["vertex_texcoords"] = _flat(mi.Float, uv)
    params.update()
    if normals is not None:  # new positions make Mitsuba find normals of its own
        params["vertex_normals"] = _flat(mi.Float, normals)
        params.update()
    dr.eval(params["vertex_positions"])
    return mesh


def _flat(kind, array):
    return kind(np.ascontiguousarray(array, dtype=np.float32 if kind is mi.Float else np.uint32).ravel())


def placed(mesh: "mi.Mesh", to_world: np.ndarray) -> "mi.Mesh":
    """A copy of a mesh under a transform [4, 4]."""
    linear, faces = to_world[:3, :3], _rows(mesh.faces_buffer(), 3)
    vertices = _rows(mesh.vertex_positions_buffer(), 3) @ linear.T + to_world[:3, 3]
    normals = uv = None
    if mesh.has_vertex_normals() and not mesh.has_face_normals():
        normals = unit(_rows(mesh.vertex_normals_buffer(), 3) @ np.linalg.inv(linear))
    if mesh.has_vertex_texcoords():
        uv = _rows(mesh.vertex_texcoords_buffer(), 2)
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]  # normals do not turn round in a mirror
    copy = build_mesh(mesh, vertices, faces, normals, uv, mesh.has_flipped_normals())
    _copy_attributes(mesh, copy)
    return copy


def _rows(array, width):
    return np.array(array, dtype=np.float64).reshape(-1, width)


def _copy_attributes(mesh, copy, again=()):
    """Give a copy a mesh's own attributes, such as colours of its vertices, those of the vertices ``again`` twice."""
    known = {"vertex_positions", "vertex_normals", "vertex_texcoords", "faces"}
    for name in mi.traverse(mesh).keys() - known:
        if name.startswith(("vertex_", "face_")):
            count = mesh.face_count() if name.startswith("face_") else mesh.vertex_count()
            values = np.array(mesh.attribute_buffer(name)).reshape(count, -1)
            if name.startswith("vertex_"):
                values = np.vstack([values, values[np.asarray(again, dtype=np.int64)]])
            copy.add_attribute(name, values.shape[1], values.ravel())


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [n, 3] of unit length; zero stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-30)[:, None]


def repaired(mesh: "mi.Mesh") -> "mi.Mesh | None":
    """A copy of a mesh in which no vertex normal is zero, infinite or NaN; None if there are none in ``mesh``.

    Mitsuba's shading frame is NaN near such normals, and so is all light there. In the copy, corners of faces whose
    vertex has such a normal have the normal of their face, on the side where the other normals of the mesh point.
    """
    if not mesh.has_vertex_normals() or mesh.has_face_normals():
        return None
    normals, faces = _rows(mesh.vertex_normals_buffer(), 3), _rows(mesh.faces_buffer(), 3).astype(np.int64)
    with np.errstate(invalid="ignore", over="ignore"):
        length = (normals.astype(np.float32) ** 2).sum(axis=1)
        bad = ~(np.isfinite(length) & (length >= TINY))[faces]  # by corner [faces, 3]
    if not bad.any():
        return None
    vertices, flipped = _rows(mesh.vertex_positions_buffer(), 3), mesh.has_flipped_normals()
    uv = _rows(mesh.vertex_texcoords_buffer(), 2) if mesh.has_vertex_texcoords() else None
    if bad.all():
        copy = build_mesh(mesh, vertices, faces, None, uv, flipped)
        _copy_attributes(mesh, copy)
        return copy
    vertex = faces[bad]  # gets a copy for its corner
    towards = _face_normals(vertices, faces, np.where(bad[..., None], 0, normals[faces]))
    normals = np.vstack([np.nan_to_num(normals, posinf=0, neginf=0), np.repeat(towards, bad.sum(axis=1), axis=0)])
    corners = faces.copy()
    corners[bad] = len(vertices) + np.arange(len(vertex))
    vertices, uv = np.vstack([vertices, vertices[vertex]]), None if uv is None else np.vstack([uv, uv[vertex]])
    copy = build_mesh(mesh, vertices, corners, normals, uv, flipped)
    _copy_attributes(mesh, copy, vertex)
    return copy


def _face_normals(vertices, faces, normals):
    """Unit normals of faces on the side where the normals of their corners [faces, 3, 3] point; where these are all
    zero, where those of the other faces point in the mean."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    side = np.einsum("fk,fck->f", cross, normals)
    most = -1.0 if side.sum() < 0 else 1.0
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    unit = np.where(length > 0, cross / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
    return unit * np.where(side == 0, most, np.sign(side))[:, None]
