"""Surfaces that are diffuse and let light through: what lies behind is lit, and as bright as in closed form."""

import mi_radiosity as mr
from mi_radiosity.scene import Model

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
ROOM, BULB = 1.0, 0.5  # radii, m


def mask(opacity, rho=0.5, two_sided=True):
    return {"type": "mask", "opacity": opacity, "bsdf": diffuse(rho, two_sided)}


def blend(other):
    return {"type": "blendbsdf", "weight": 0.9, "a": other, "b": diffuse(0.5, True)}


def shells(bsdfs, kind="sphere", rho=0.0):
    """A bulb in nested closed shells in a room."""
    closed = {}
    for k, bsdf in enumerate(bsdfs):
        radius = BULB + 0.1 * (k + 1)
        if kind == "sphere":
            closed[f"shell{k}"] = {"type": "sphere", "radius": radius, "bsdf": bsdf}
        else:
            closed[f"shell{k}"] = {"type": "cube", "to_world": T().scale(radius), "bsdf": bsdf}
    bulb = {"type": "sphere", "radius": BULB, "emitter": lamp(1.0), "bsdf": diffuse(0.0)}
    size = ROOM if kind == "sphere" else 2 * ROOM
    room = {"type": "sphere", "radius": size, "flip_normals": True, "bsdf": diffuse(rho)}
    return scene(optimize=False, bulb=bulb, room=room, **closed)


def room_is_lit(a_scene, name="room"):
    """Does light reach all faces of a shape?"""
    model = Model(a_scene)
    faces = model.faces
    of = faces.shape == [part.shape.id() for part in faces.parts].index(name)
    lit = np.zeros(len(faces), dtype=bool)
    lit[np.array(model.patches.face)] = True
    return bool(lit[of].all())


CHECKERS = {"type": "checkerboard", "color0": 0.95, "color1": 1.0}
PASSING = {
    "half": mask(0.5),
    "dense": mask(0.9),
    "nearly opaque": mask(0.9999),
    "one-sided": mask(0.9, two_sided=False),
    "textured": mask(CHECKERS),
    "blend with null": blend({"type": "null"}),
    "blend with thin glass": blend({"type": "thindielectric"}),
    "mask in a mask": {"type": "mask", "opacity": 0.9, "bsdf": mask(0.9)},
}


@pytest.mark.parametrize("material", PASSING)
def test_light_gets_out_of_closed_shells(material):
    """Three of them in each other."""
    assert room_is_lit(shells([PASSING[material]] * 3, "cube"))


def test_light_gets_out_of_shells_of_many_faces():
    assert room_is_lit(shells([PASSING["nearly opaque"]] * 2, "sphere"))


def test_light_does_not_get_out_of_an_opaque_shell():
    for opaque in (mask(1.0), diffuse(0.5, True)):
        assert not room_is_lit(shells([PASSING["half"], opaque, PASSING["half"]], "cube"), "shell2")


@pytest.mark.parametrize("kind", ["point", "directional", "constant", "area"])
def test_light_gets_through_a_curtain(kind):
    """What is behind the only opening of a box is lit by emitters of all kinds."""
    light = {"type": "rgb", "value": 1.0}
    emitter = {
        "point": {"type": "point", "position": [0, 0, 3], "intensity": light},
        "directional": {"type": "directional", "direction": [0, 0, -1], "irradiance": light},
        "constant": {"type": "constant", "radiance": light},
        "area": rectangle(T().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.1), emitter=lamp(1.0)),
    }[kind]
    curtain = rectangle(T().translate([0, 0, 1]), bsdf=mask(0.98))
    walls = {
        name: rectangle(T().rotate([0, 0, 1], 90 * k).translate([0, 1, 0]).rotate([1, 0, 0], 90), bsdf=diffuse())
        for k, name in enumerate("abcd")
    }
    floor = rectangle(T().translate([0, 0, -1]), bsdf=diffuse())
    box = {"curtain": curtain, "floor": floor, "emitter": emitter, **walls}
    assert room_is_lit(scene(optimize=False, **box), "floor")
    assert not room_is_lit(scene(optimize=False, **box | {"curtain": rectangle(
        T().translate([0, 0, 1]), bsdf=diffuse(two_sided=True))}), "floor")  # fmt: skip


def mean(solution, name):
    leaves = solution.leaves()
    of = leaves.shape == [s.id() for s in solution.model.scene.shapes()].index(name)
    return np.average(leaves.irradiance[of, 0], weights=leaves.area[of])


def areas(solution):
    """Of the bulb and the room, as they are tessellated."""
    faces = solution.model.faces
    ids = [part.shape.id() for part in faces.parts]
    return [faces.area[faces.shape == ids.index(name)].sum() for name in ("bulb", "room")]


@pytest.mark.parametrize("opacities", [[0.5], [0.5, 0.5], [0.9], [0.3, 0.3, 0.3]])
def test_black_masks_in_each_other(opacities):
    """All light of the bulb meets all n masks: H = Π (1 − a_k) Φ / A."""
    solution = mr.solve(shells([mask(a, 0.0) for a in opacities]), elements=1500, rays=600_000)
    bulb, room = areas(solution)
    expected = np.prod([1 - a for a in opacities]) * bulb / room
    assert mean(solution, "room") == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("opacity, rho", [(0.5, 0.5), (0.8, 0.9)])
def test_a_globe_of_paper(opacity, rho):
    """Of the light that meets the globe of radius r_g from within, a ρ goes back, of which (r_b / r_g)² is absorbed by
    the bulb: H = (1 − a) / (1 − a ρ (1 − (r_b / r_g)²)) Φ / A, whatever the directions."""
    solution = mr.solve(shells([mask(opacity, rho)]), elements=1500, rays=600_000)
    bulb, room = areas(solution)
    out = (1 - opacity) / (1 - opacity * rho * (1 - (BULB / (BULB + 0.1)) ** 2))
    assert mean(solution, "room") == pytest.approx(out * bulb / room, rel=0.04)


@pytest.mark.parametrize("shading", ["gather", "gouraud"])
def test_pictures_from_a_tent_agree_with_path(shading):
    """The camera is in a tent of a mask, the bulb in another one."""
    tent = {"type": "sphere", "center": [0, 0, 5], "radius": 0.5, "bsdf": mask(0.5)}
    lit = scene(
        optimize=False,
        tent=tent,
        floor=rectangle(T().scale(4), bsdf=diffuse()),
        bulb={"type": "sphere", "center": [0, 0, 2], "radius": 0.5, "emitter": lamp(1.0)},
        globe={"type": "sphere", "center": [0, 0, 2], "radius": 0.7, "bsdf": mask(0.5)},
    )
    true = np.array(mi.render(lit, integrator=mi.load_dict({"type": "path", "max_depth": -1}), spp=4096)).mean()
    solution = mr.solve(lit, elements=1000, rays=600_000)
    assert np.array(solution.render(lit.sensors()[0], spp=256, shading=shading)).mean() == pytest.approx(true, rel=0.03)
