"""Every lamp against Mitsuba's `path`: pictures, power, and the irradiance of a plate."""

import mi_radiosity as mr
from mi_radiosity.core.points import kronecker
from mi_radiosity.scene import Model

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from beside_path import compare
from conftest import balance, diffuse, lamp, rectangle

DOWN = mi.ScalarTransform4f().look_at([0.3, 0.2, 1.9], [0, 0, 0], [0, 1, 0])
TEXTURE = np.random.default_rng(3).uniform(0, 1, (8, 16, 3)).astype(np.float32) ** 4
SMOOTH = np.random.default_rng(5).uniform(0.2, 1, (2, 2, 3)).astype(np.float32)


def texture(data=TEXTURE):
    return {"type": "bitmap", "raw": True, "data": mi.TensorXf(data)}


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


FREE = ["point", "spot", "textured spot", "projector", "directional", "constant", "envmap", "sunsky", "timed_sunsky"]
SURFACES = ["area", "textured area"]
SHINING = mi.ScalarTransform4f().translate([0, 0, 1.9]).rotate([1, 0, 0], 180).scale([0.6, 0.4, 1])


def free(name, **changes):
    """A lamp that is no surface."""
    lamps = {
        "point": {"type": "point", "position": [0.3, 0.2, 1.5], "intensity": rgb(1, 2, 3)},
        "spot": {"type": "spot", "to_world": DOWN, "intensity": rgb(1, 2, 3), "cutoff_angle": 35},
        "textured spot": {"type": "spot", "to_world": DOWN, "texture": texture(SMOOTH), "cutoff_angle": 35},
        "projector": {"type": "projector", "to_world": DOWN, "irradiance": texture(SMOOTH), "fov": 60},
        "directional": {"type": "directional", "direction": [0.2, -0.3, -1], "irradiance": rgb(1, 2, 3)},
        "constant": {"type": "constant", "radiance": rgb(1, 2, 3)},
        "envmap": {
            "type": "envmap",
            "bitmap": mi.Bitmap(TEXTURE),
            "to_world": mi.ScalarTransform4f().rotate([0, 0.6, 0.8], 70),
        },
        "sunsky": {"type": "sunsky", "sun_direction": [0.3, 0.5, 0.8], "to_world": mi.ScalarTransform4f()},
        "timed_sunsky": {"type": "timed_sunsky", "to_world": mi.ScalarTransform4f()},
    }
    return lamps[name] | changes


def plate(**parts):
    """A floor, a block on it, half a wall; and lamps."""
    camera = {
        "type": "perspective",
        "fov": 60,
        "to_world": mi.ScalarTransform4f().look_at([0, -3, 2.5], [0, 0, 0.3], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
        "sampler": {"type": "independent"},
    }
    at = mi.ScalarTransform4f
    wall = at().translate([0, 1, 0.7]).rotate([1, 0, 0], 90).scale([1, 0.7, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "camera": camera,
            "floor": rectangle(bsdf=diffuse([0.5, 0.6, 0.7]), to_world=at().scale([1.5, 1, 1])),
            "block": {"type": "cube", "bsdf": diffuse(0.7), "to_world": at().translate([-0.5, 0, 0.3]).scale(0.3)},
            "wall": rectangle(bsdf=diffuse(0.4, two_sided=True), to_world=wall),
            **parts,
        },
        optimize=False,
    )


def lit(name, **changes):
    if name in FREE:
        return plate(lamp=free(name, **changes))
    emitter = lamp(2) if name == "area" else {"type": "area", "radiance": texture(20 * TEXTURE)}
    return plate(lamp=rectangle(SHINING, bsdf=diffuse(), emitter=emitter))


@pytest.mark.parametrize("name", [*SURFACES, *FREE[:-1]])  # `path` of Mitsuba 3.9 fails with the last one
def test_pictures_agree_with_path(name):
    solutions, _, _ = compare(lit(name), elements=3000, rays=400_000)
    assert all(balance(solution) == pytest.approx(1, abs=2e-3) for solution in solutions)


@pytest.mark.parametrize("name", FREE)
def test_power_arrives_where_lines_to_the_lamp_say(name):
    """The mean irradiance of a floor, by rays from the lamp and by lines to it; and for the sky, by looking at it."""
    model = Model(lit(name, **({"sun_scale": 0} if "sun" in name else {})))  # looking around misses the sun
    (light,), n = model.lights.free, 1 << 20
    zero = mi.UInt32(0)
    origin, direction, power = light.shoot(*kronecker(dr.arange(mi.UInt32, n), zero, zero))
    assert np.array([dr.mean(p)[0] for p in power]) == pytest.approx(light.power(), rel=0.01)
    si = model.scene.ray_intersect(mi.Ray3f(origin, direction))
    met = si.is_valid() & (dr.abs(si.p.z) < 1e-5) & (direction.z < 0)
    shot = np.array([dr.mean(dr.select(met, p, 0))[0] for p in power]) / 6
    x, y, s, t = kronecker(dr.arange(mi.UInt32, n), zero + 1, zero)
    point = mi.Point3f(1.5 * (2 * x - 1), 2 * y - 1, 0) - model.patches.origin
    up = mi.Vector3f(0, 0, 1)
    sampled, _, _ = light.lights_up(model.rays, point, up, s, t)
    assert shot == pytest.approx(np.array([dr.mean(h)[0] for h in sampled]), rel=0.01)
    if model.lights.sky_light:
        a, b, s, t = kronecker(dr.arange(mi.UInt32, n), zero + 2, zero)
        outwards = mi.warp.square_to_cosine_hemisphere(mi.Point2f(a, b))
        seen = ~model.scene.ray_test(mi.Ray3f(mi.Point3f(1.5 * (2 * s - 1), 2 * t - 1, 1e-4), outwards))
        looked = [dr.mean(dr.select(seen, h, 0))[0] for h in model.lights.sky(outwards)]
        assert shot == pytest.approx(np.array(looked), rel=0.01)


def test_directionalarea_lights_what_is_straight_ahead():
    """E falls on the floor below a lamp of exitance E, less what the block is in the way of; its shape reflects."""
    emitter = {"type": "directionalarea", "radiance": rgb(1, 2, 3)}
    truth = plate(lamp=rectangle(SHINING, bsdf=diffuse(0.3), emitter=emitter))
    solution = mr.solve(truth, elements=2000, rays=200_000)
    assert solution.stats["power"]["emitted"] == pytest.approx(6 * 0.96, rel=1e-4)
    assert balance(solution) == pytest.approx(1, abs=2e-3)
    (light,) = solution.model.lights.free
    x, y, _, _ = kronecker(dr.arange(mi.UInt32, 1 << 16), mi.UInt32(0), mi.UInt32(0))
    point = mi.Point3f(1.5 * (2 * x - 1), 2 * y - 1, 0) - solution.model.patches.origin
    H, _, _ = light.lights_up(solution.model.rays, point, mi.Vector3f(0, 0, 1), x, y)
    below = 4 * 0.6 * 0.4 - 0.4 * 0.6  # the block is under a part of the lamp
    assert dr.mean(H.z)[0] * 6 == pytest.approx(3 * below, rel=0.01)


def test_lamps_refused_by_name():
    emitter = {"type": "directionalarea", "radiance": rgb(1, 2, 3)}
    with pytest.raises(mr.RadiosityError, match="flat"):
        Model(plate(lamp={"type": "sphere", "bsdf": diffuse(), "emitter": emitter}))


def test_solutions_belong_to_their_lamps(tmp_path):
    truth = lit("textured area")
    solution = mr.solve(truth, elements=1000, rays=20_000)
    solution.save(tmp_path / "kept.npz")
    kept = mr.Solution.load(tmp_path / "kept.npz", truth)
    np.testing.assert_array_equal(np.array(kept.radiosity()), np.array(solution.radiosity()))
    moved = [Model(plate(lamp=free("point", position=[x, 0, 1.5]))).fingerprint for x in (0, 0.5, 0)]
    assert moved[0] == moved[2] != moved[1]


def test_the_sky_shows_where_nothing_else_is():
    solution = mr.solve(lit("constant"), elements=500, rays=20_000)
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    up = {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 3], [0, 1, 0])}
    image = np.array(solution.render(mi.load_dict(up | {"film": film}), spp=4))
    np.testing.assert_allclose(image, np.broadcast_to([1, 2, 3, 1], image.shape), rtol=1e-5)
