"""Shading normals, of vertices and of maps, shade as in `path`, seen directly and where gather rays end."""

import mi_radiosity as mr

import mitsuba as mi
import numpy as np
import pytest
from beside_path import compare
from conftest import diffuse, lamp, rectangle

T = mi.ScalarTransform4f
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
FACES = np.uint32(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4]]
    + [[1, 5, 7], [1, 7, 3]]
)


def rounded_box(bsdf):
    """A cube of eight vertices, whose normals are the means of three sides."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("box", 8, 12, has_vertex_normals=True, props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = (0.35 * CORNERS + np.float32([0.3, 0.3, -0.65])).ravel()
    params["faces"] = FACES.ravel()
    params.update()
    params["vertex_normals"] = (CORNERS / np.sqrt(3)).ravel().astype(np.float32)
    params.update()
    return mesh


def room(**parts):
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    look = T().look_at([0, -0.95, 0.1], [0, 1, -0.1], [0, 0, 1])
    panel = rectangle(T().translate([0, 0, 0.97]).rotate([1, 0, 0], 180).scale(0.3), bsdf=diffuse(0), emitter=lamp(25))
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 70, "to_world": look, "film": film},
            "room": {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.6)},
            "panel": panel,
            **parts,
        },
        optimize=False,
    )


def leaning(bsdf):
    """A normal map that leans all normals the same way."""
    data = np.tile(np.float32([0.7, 0.5, 0.9]), (4, 4, 1))
    return {"type": "normalmap", "normalmap": {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(data)}, "bsdf": bsdf}


def block(bsdf):
    return {"type": "cube", "to_world": T().translate([0.3, 0.3, -0.65]).scale(0.35), "bsdf": bsdf}


ROUGH = {"type": "roughplastic", "alpha": 0.2}


@pytest.mark.parametrize("shading", ["gather", "gouraud"])
def test_vertex_normals_far_from_the_faces_shade_as_in_path(shading):
    scene = room(box=rounded_box(diffuse(0.5)))
    assert mr.scene.Model(scene).materials.bent.sum() == 12
    compare(scene, shading=shading, elements=1000, rays=150_000)


@pytest.mark.parametrize("bsdf", [diffuse(0.5), ROUGH], ids=["diffuse", "rough plastic"])
def test_normal_maps_shade_as_in_path(bsdf):
    compare(room(block=block(leaning(bsdf))), elements=1000, rays=150_000)


def test_normals_of_fine_meshes_are_those_of_the_cache():
    """A tessellated sphere is plainly diffuse: no path evaluates its BSDF."""
    ball = {"type": "sphere", "center": [0.3, 0.3, -0.6], "radius": 0.3, "bsdf": diffuse(0.5)}
    assert mr.scene.Model(room(ball=ball)).materials.all_plain
