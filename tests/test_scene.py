"""Patches: what is modelled, on which side, and what is refused by name."""

import mi_radiosity as mr
from mi_radiosity.scene import Model

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

pytestmark = pytest.mark.fast


def diffuse_raw(value):
    """A diffuse BSDF whose texture says ``value``, which Mitsuba refuses of colours above 1."""
    data = mi.TensorXf(np.full((2, 2, 3), value, np.float32))
    return {"type": "diffuse", "reflectance": {"type": "bitmap", "raw": True, "data": data}}


def over(floor):
    """``floor`` under a lamp at z = 1."""
    down = mi.ScalarTransform4f().translate([0, 0, 1]).rotate([1, 0, 0], 180)
    return scene(floor=floor, lamp=rectangle(down, bsdf=diffuse(), emitter=lamp()))


def test_back_sides_only_where_light_can_reach():
    one, two = (Model(over(rectangle(bsdf=diffuse(two_sided=t)))) for t in (False, True))
    assert one.patches.count == two.patches.count == 4  # the back of the floor sees nothing
    between = scene(
        a=rectangle(bsdf=diffuse(two_sided=True)),
        lamp=rectangle(
            mi.ScalarTransform4f().translate([0, 0, 1]).rotate([1, 0, 0], 180), bsdf=diffuse(), emitter=lamp()
        ),
        below=rectangle(mi.ScalarTransform4f().translate([1, 0, -1]).scale(2), bsdf=diffuse()),
    )
    assert Model(between).patches.count == 8  # here it sees a floor that the lamp lights


def test_unlit_rooms_cost_nothing():
    lit = {"type": "cube", "flip_normals": True, "bsdf": diffuse(), "emitter": lamp()}
    dark = {
        "type": "cube",
        "flip_normals": True,
        "bsdf": diffuse(),
        "to_world": mi.ScalarTransform4f().translate([5, 0, 0]),
    }
    model = Model(scene(lit=lit, dark=dark))
    assert (model.patches.count, model.unreached) == (12, 12)


def test_patches_have_the_units_of_the_paper():
    model = Model(over(rectangle(bsdf=diffuse(0.3))))
    emission, rho, area = (np.array(x) for x in (model.patches.emission, model.patches.reflectance, model.patches.area))
    assert sorted(set(np.round(emission[0], 5))) == [0, 1]
    assert area.sum() == pytest.approx(8) and rho.min() == pytest.approx(0.3)


def test_disks_keep_their_area():
    model = Model(
        scene(
            lamp={
                "type": "disk",
                "bsdf": diffuse(),
                "emitter": lamp(2),
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 180),
            },
            floor=rectangle(mi.ScalarTransform4f().translate([0, 0, -1]).scale(3), bsdf=diffuse()),
        )
    )
    emission, area = np.array(model.patches.emission)[0], np.array(model.patches.area)
    assert area[emission > 0].sum() == pytest.approx(np.pi, rel=1e-5)
    assert np.array(model.patches.normal)[2][emission > 0] == pytest.approx(-1)


def test_normals_follow_the_shading_side():
    mirrored = mi.ScalarTransform4f().scale([1, 1, -1])
    for to_world in (mi.ScalarTransform4f(), mirrored):
        model = Model(
            scene(
                box={"type": "cube", "flip_normals": True, "to_world": to_world, "bsdf": diffuse(), "emitter": lamp()}
            )
        )
        centroid = np.array(model.patches.p0) + (np.array(model.patches.e1) + np.array(model.patches.e2)) / 3
        assert ((np.array(model.patches.normal) * centroid).sum(axis=0) < 0).all()


def test_textures_give_each_element_its_own_reflectance():
    checker = {
        "type": "diffuse",
        "reflectance": {
            "type": "checkerboard",
            "color0": {"type": "rgb", "value": 0.1},
            "color1": {"type": "rgb", "value": 0.9},
            "to_uv": mi.ScalarTransform4f().scale([2, 2, 1]),
        },
    }
    solution = mr.solve(over(rectangle(bsdf=checker)), mr.Uniform(), elements=1000, rays=20_000)
    rho = np.array(solution.elements.reflectance)[0]
    leaves = (np.array(solution.elements.child) == 0) & (
        np.array(solution.model.patches.normal)[2][np.array(solution.elements.patch)] > 0
    )
    assert rho[leaves].min() == pytest.approx(0.1) and rho[leaves].max() == pytest.approx(0.9)
    assert rho[leaves].mean() == pytest.approx(0.5, abs=0.05)


def test_fingerprint_ignores_the_order_of_shapes():
    floor, small = (
        rectangle(bsdf=diffuse()),
        rectangle(mi.ScalarTransform4f().translate([0, 0, 0.5]).scale(0.1), bsdf=diffuse(0.2)),
    )
    up = rectangle(mi.ScalarTransform4f().translate([0, 0, 1]).rotate([1, 0, 0], 180), bsdf=diffuse(), emitter=lamp())
    a, b = Model(scene(a=floor, b=small, c=up)), Model(scene(a=up, b=floor, c=small))
    assert a.fingerprint == b.fingerprint
    np.testing.assert_array_equal(np.array(a.patches.p0), np.array(b.patches.p0))


@pytest.mark.parametrize(
    "shape, says",
    [
        (rectangle(id="bright", bsdf=diffuse_raw(1.2)), "bright.*less than 1"),
    ],
    ids=["white"],
)
def test_refused_by_name(shape, says):
    bad = over(shape)
    with pytest.raises(mr.RadiosityError, match=says):
        Model(bad)


def test_degenerate_faces_are_left_out_with_a_warning():
    mesh = mi.Mesh("", 4, 2)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [0, 0, 0, 1, 0, 0, 0, 1, 0, 2, 0, 0]
    params["faces"] = [0, 1, 2, 0, 1, 3]
    params.update()
    model = Model(over(mesh))
    assert model.warnings == ["1 faces without area are left out, in shape 'floor'"]


@pytest.mark.parametrize("parts, says", [({}, "no shapes"), ({"floor": rectangle()}, "no light")])
def test_nothing_to_do(parts, says):
    with pytest.raises(mr.RadiosityError, match=says):
        Model(scene(**parts))


def test_vertices_that_are_no_numbers_are_refused():
    mesh = mi.Mesh("", 3, 1)
    params = mi.traverse(mesh)
    params["vertex_positions"] = [0, 0, 0, 1, 0, 0, float("nan"), 1, 0]
    params["faces"] = [0, 1, 2]
    params.update()
    with pytest.raises(mr.RadiosityError, match="floor.*not finite"):
        Model(over(mesh))


def test_white_is_taken_as_nearly_white_and_said():
    """Scenes by others have walls of reflectance 1, which no closed room could be solved with."""
    model = Model(over(rectangle(id="bright", bsdf=diffuse(1.0))))
    assert any("bright" in w and "0.999" in w for w in model.warnings)
    assert model.materials.rho.max() == 0.999
