"""Vertex normals without a direction: solutions and pictures as with normals of faces, and a warning."""

import mi_radiosity as mr
from mi_radiosity.scene import Model

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, icosphere, lamp, rectangle, scene

AT = mi.ScalarTransform4f
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.8, np.array([[0, 1, 2], [0, 2, 3]])
UP = np.tile([0.0, 0.0, 1.0], (4, 1))


def smooth(vertices, faces, normals=None, uv=None, reflectance=None, flipped=False, **attributes):
    """A mesh called "plate" with vertex normals, as they are given."""
    properties = mi.Properties()
    reflectance = reflectance or {"type": "rgb", "value": 0.5}
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": reflectance})
    properties["flip_normals"] = flipped
    given = {"has_vertex_normals": normals is not None, "has_vertex_texcoords": uv is not None}
    shape = mi.Mesh("plate", len(vertices), len(faces), props=properties, **given)
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, dtype=np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, dtype=np.uint32).ravel())
    if uv is not None:
        params["vertex_texcoords"] = mi.Float(np.asarray(uv, dtype=np.float32).ravel())
    params.update()
    if normals is not None:
        params["vertex_normals"] = mi.Float(np.asarray(normals, dtype=np.float32).ravel())
        params.update()
    for name, values in attributes.items():
        shape.add_attribute(name, 3, np.asarray(values, dtype=np.float32).ravel())
    return shape


def room(plate, **more):
    look = AT().look_at([0, -0.95, 0.6], [0, 0.2, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    shapes = {
        "camera": {"type": "perspective", "fov": 80, "to_world": look, "film": film},
        "room": {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.6)},
        "lamp": rectangle(AT().translate([0, 0, 0.9]).rotate([1, 0, 0], 180).scale(0.3), emitter=lamp(8)),
        "plate": plate,
    }
    return mi.load_dict({"type": "scene", **shapes, **more}, optimize=False)


def light(scene, warned):
    """Leaves' irradiance, and a picture, both of numbers only; the plate is named in a warning, if it is ``warned``."""
    solution = mr.solve(scene, elements=600, rays=60_000)
    said = [line for line in solution.model.warnings if "vertex normals" in line]
    assert said == (["shape 'plate': vertex normals that are zero or no numbers are replaced by face normals"] * warned)
    picture, values = np.array(solution.render(spp=16)), np.array(solution.radiosity())
    assert np.isfinite(picture).all() and np.isfinite(values).all()
    return values, picture


def changed(normals, rows, value):
    normals = np.array(normals, dtype=float)
    normals[rows] = value
    return normals


BAD = {
    "one zero": changed(UP, 0, 0),
    "one NaN": changed(UP, 2, np.nan),
    "one infinite": changed(UP, 1, [0, np.inf, 1]),
    "too short for float32": changed(UP, 3, 1e-30),
    "a zero and a NaN": changed(changed(UP, 0, 0), 2, np.nan),
    "unnormalised, one zero": changed(7 * UP, 1, 0),
}


@pytest.mark.parametrize("name", BAD)
def test_some_normals_without_direction(name):
    """A flat plate whose other normals point up is a flat plate: its solution is the same to rounding."""
    want, picture = light(room(smooth(*SQUARE, UP)), warned=False)
    found, shown = light(room(smooth(*SQUARE, BAD[name])), warned=True)
    np.testing.assert_allclose(found, want, rtol=1e-5)
    np.testing.assert_allclose(shown, picture, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("value", [0, np.nan])
@pytest.mark.parametrize("flipped", [False, True])
def test_no_normal_with_direction(value, flipped):
    """As the same mesh without vertex normals, to the bit."""
    want, picture = light(room(smooth(*SQUARE, flipped=flipped)), warned=False)
    found, shown = light(room(smooth(*SQUARE, np.full((4, 3), value), flipped=flipped)), warned=True)
    np.testing.assert_array_equal(found, want)
    np.testing.assert_allclose(shown, picture, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("flipped", [False, True])
def test_normals_against_the_order_of_corners(flipped):
    """The side where the other normals point is the front, also of faces that have no other normal."""
    vertices, faces = np.vstack([SQUARE[0], SQUARE[0] + [0, 0, 0.3]]), np.vstack([SQUARE[1], SQUARE[1] + 4])
    down = np.tile([0.0, 0.0, -1.0], (8, 1))
    want, _ = light(room(smooth(vertices, faces, down, flipped=flipped)), warned=False)
    found, _ = light(
        room(smooth(vertices, faces, changed(down, [0, 4, 5, 6, 7], np.nan), flipped=flipped)), warned=True
    )
    np.testing.assert_allclose(found, want, rtol=1e-5)


def test_unnormalised_normals_are_left_alone():
    want, _ = light(room(smooth(*SQUARE, UP)), warned=False)
    found, _ = light(room(smooth(*SQUARE, UP * [[0.1], [5], [1], [30]])), warned=False)
    np.testing.assert_allclose(found, want, rtol=1e-5)


def test_a_ball_with_holes_in_its_normals():
    """Every tenth normal of a ball is NaN: the picture is that of the whole ball, but near these vertices."""
    vertices, faces = icosphere(2, inwards=False)
    ball = 0.4 * vertices, faces
    _, picture = light(room(smooth(*ball, vertices)), warned=False)
    _, shown = light(room(smooth(*ball, changed(vertices, slice(None, None, 10), np.nan))), warned=True)
    assert shown.mean() == pytest.approx(picture.mean(), rel=0.01)


def test_instances_textures_and_attributes_are_kept():
    """The repaired mesh has the colours of the mesh, where an instance places it as well."""
    colors = np.array([[0.2, 0.4, 0.6], [0.8, 0.4, 0.6], [0.8, 0.1, 0.6], [0.2, 0.4, 0.1]])
    by_vertex = {"type": "mesh_attribute", "name": "vertex_color"}
    pixels = mi.Bitmap(np.array([[[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]]], dtype=np.float32))
    by_texture = {"type": "bitmap", "raw": True, "bitmap": pixels}
    uv = [[0, 0], [1, 0], [1, 1], [0, 1]]
    for reflectance, more in ((by_vertex, {"vertex_color": colors}), (by_texture, {"uv": uv})):
        found = []
        for normals in (UP, changed(UP, 1, np.nan)):
            plate = smooth(*SQUARE, normals, reflectance=reflectance, **more)
            group = {"type": "shapegroup", "id": "group", "plate": plate}
            at = AT().translate([0, 0, -0.2]).rotate([0, 0, 1], 30)
            instance = {"type": "instance", "to_world": at, "group": {"type": "ref", "id": "group"}}
            above = rectangle(AT().translate([0, 0, 2]).rotate([1, 0, 0], 180), emitter=lamp())
            model = Model(scene(optimize=False, group=group, copy=instance, above=above))
            found.append(np.array(model.patches.reflectance))
            assert any("vertex normals" in line and "plate" in line for line in model.warnings) == (normals is not UP)
        np.testing.assert_array_equal(*found)
        assert np.ptp(found[0], axis=1).max() > 0.01
