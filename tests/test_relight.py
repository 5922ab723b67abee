"""Light by lamp: layers add up, and lamps dimmed afterwards are lamps solved so."""

import mi_radiosity as mr
from mi_radiosity.export.relight import irradiance_over
from mi_radiosity.scene.lamps import Lamps

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import balance, diffuse, lamp, leaf_values, rectangle, scene

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
SMALL = dict(elements=1500, rays=300_000)


def above(x, y, size):
    return T().translate([x, y, 0.95]).rotate([1, 0, 0], 180).scale(size)


def lit_room(one=1.0, two=5.0, **others):
    return scene(
        optimize=False,
        room={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)},
        one=rectangle(above(-0.4, 0, 0.2), bsdf=diffuse(0.3), emitter=lamp(one)),
        two=rectangle(above(0.5, 0.3, 0.1), bsdf=diffuse(0.3), emitter=lamp(two)),
        **others,
    )


@pytest.fixture(scope="module")
def solution():
    return mr.solve(lit_room(), layers=True, **SMALL)


def values(solution, name):
    return np.array(getattr(solution, name), dtype=np.float64).reshape(3, -1)


def patch_means(solution):
    return np.array(solution.radiosity())[0][: solution.model.patches.count].astype(float)


def test_layers_add_up(solution):
    layers, stats = solution.layers, solution.stats
    assert layers.names == ("one", "two") and stats["lamps"] == ["one", "two"]
    assert stats["rays"] == SMALL["rays"] and balance(solution) == pytest.approx(1, rel=1e-3)
    for name in ("direct", "indirect"):
        np.testing.assert_allclose(getattr(layers, name).sum(axis=0), values(solution, name), rtol=1e-6)
        alone = values(solution.relight({"two": 0}), name) + values(solution.relight({"one": 0}), name)
        np.testing.assert_allclose(alone, values(solution, name), rtol=1e-6)


def test_rays_go_by_power():
    """Powers of 0.16 and 0.2 W per channel; budgets are met to the ray, with three lamps and few rays as well."""
    lamps = Lamps(mr.scene.Model(lit_room()))
    np.testing.assert_allclose(lamps.power[:, 0], [0.16, 0.2], rtol=1e-5)
    for rays in (192, 10_001):
        three = lit_room(three=rectangle(above(0, -0.6, 0.1), bsdf=diffuse(0.3), emitter=lamp(1e-3)))
        assert mr.solve(three, elements=100, rays=rays, layers=True).stats["rays"] == rays
    with pytest.raises(mr.RadiosityError, match="give at least 128"):
        mr.solve(lit_room(), elements=100, rays=100, layers=True)


def test_one_lamp_is_the_plain_solution(cornell):
    plain, layered = (mr.solve(cornell, elements=1000, rays=50_000, layers=layers) for layers in (False, True))
    np.testing.assert_allclose(np.array(layered.radiosity()), np.array(plain.radiosity()), rtol=1e-6)
    assert plain.layers is None and layered.layers.names == ("light",)


def test_relit_is_solved_anew():
    """A doubled lamp, and another colour, are what solves of such scenes find: means of patches to 4 σ over seeds."""
    seeds = range(6)
    scales = {"one": 2, "two": (0.2, 0.2, 0.2)}
    relit = np.array([patch_means(mr.solve(lit_room(), layers=True, seed=s, **SMALL).relight(scales)) for s in seeds])
    solved = np.array([patch_means(mr.solve(lit_room(2.0, 1.0), seed=s, **SMALL)) for s in seeds])
    error = np.sqrt((relit.var(axis=0, ddof=1) + solved.var(axis=0, ddof=1)) / len(seeds))
    assert (np.abs(relit.mean(axis=0) - solved.mean(axis=0)) < 6 * error + 1e-6).all()
    assert np.abs(relit.mean(axis=0) / solved.mean(axis=0) - 1).max() < 0.02


def test_colours(solution):
    red = solution.relight({"one": (1, 0, 0), 1: 0.0})
    B, _, _ = leaf_values(red)
    white, _, _ = leaf_values(solution.relight({"two": 0}))
    assert (B[:, 1:] == 0).all()
    np.testing.assert_allclose(B[:, 0], white[:, 0], rtol=1e-6)
    assert red.stats["power"]["emitted"] == pytest.approx(0.16, rel=1e-5)


def test_dark_rooms_are_black():
    """A wall apart, a room only one lamp lights: exactly zero without that lamp."""
    closed = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5), "to_world": T().translate([5, 0, 0])}
    two = rectangle(T().translate([5, 0, 0]) @ above(0, 0, 0.2), bsdf=diffuse(0.3), emitter=lamp(2))
    rooms = scene(
        optimize=False,
        room={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)},
        one=rectangle(above(0, 0, 0.2), bsdf=diffuse(0.3), emitter=lamp(1)),
        other=closed,
        two=two,
    )
    solution = mr.solve(rooms, layers=True, elements=800, rays=50_000).relight({"two": 0})
    leaves = solution.leaves()
    there = leaves.vertices[:, :, 0].min(axis=1) > 3
    assert (leaves.radiosity[there] == 0).all() and (leaves.radiosity[~there] > 0).all()


def test_a_wall_that_crosses_elements():
    """Between the lamps, dark on the side whose lamp is off: also in the picture."""
    wall = {"type": "cube", "to_world": T().translate([0.013, 0, 0]).scale([0.01, 1.001, 1.001]), "bsdf": diffuse(0.5)}
    rooms = scene(
        optimize=False,
        room={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)},
        wall=wall,
        one=rectangle(above(-0.5, 0, 0.2), bsdf=diffuse(0.3), emitter=lamp(1)),
        two=rectangle(above(0.5, 0, 0.2), bsdf=diffuse(0.3), emitter=lamp(1)),
    )
    solution = mr.solve(rooms, layers=True, elements=1000, rays=100_000)
    assert solution.landings.slots > 0
    camera = {"type": "orthographic", "to_world": T().look_at([0, 0, 0.9], [0, 0, -1], [0, 1, 0]).scale(0.99)}
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    sensor = mi.load_dict(camera | {"film": film})
    halves = [np.array(solution.relight({off: 0}).render(sensor, spp=4))[..., 0] for off in ("one", "two")]
    both = np.array(solution.render(sensor, spp=4))[..., 0]
    columns = [[half[:, :30].mean(), half[:, 34:].mean()] for half in halves]
    assert min(columns[0]) == min(columns[1]) == 0  # to the last bit
    assert np.argmax(columns[0]) != np.argmax(columns[1])
    np.testing.assert_allclose(np.add(*halves)[:, :28], both[:, :28], rtol=0.02, atol=2e-3)


def test_lamps_in_pictures_follow(solution):
    """What a camera sees of a lamp is E scaled, plus what it reflects; the gatherer sees it, too."""
    below = T().look_at([-0.4, 0, 0], [-0.4, 0, 1], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 9, "height": 9, "pixel_format": "rgb"}
    sensor = mi.load_dict({"type": "perspective", "fov": 8, "to_world": below, "film": film})
    base, dim = (np.array(s.render(sensor, spp=1))[4, 4] for s in (solution, solution.relight({"one": (3, 1, 0)})))
    E = 1 / np.pi
    np.testing.assert_allclose(base, E, rtol=0.1)
    assert dim[0] == pytest.approx(3 * E, rel=0.1) and dim[2] < 0.05 * E
    off = solution.relight({"one": 0, "two": 0})
    assert (off.irradiance([[0, 0, 0]], [[0, 0, 1]]) == 0).all() and (np.array(off.render(sensor, spp=1)) == 0).all()


def test_scenes_are_left_alone(solution):
    before = np.array(solution.radiosity())
    solution.relight({"one": 7}).relight({"two": 3})
    np.testing.assert_array_equal(np.array(solution.radiosity()), before)
    again = solution.relight({"one": 7}).relight({})  # scales are those of the scene, not of one another
    np.testing.assert_array_equal(np.array(again.radiosity()), before)


def test_archives_keep_layers(solution, tmp_path):
    file = tmp_path / "relit.npz"
    relit = solution.relight({"one": 2, "two": (0, 0, 1)})
    relit.save(file)
    loaded = mr.Solution.load(file, solution.model.scene)
    for a, b in ((loaded, relit), (loaded.relight({}), solution)):
        np.testing.assert_array_equal(np.array(a.radiosity()), np.array(b.radiosity()))
    assert loaded.layers.names == solution.layers.names and loaded.stats["power"] == relit.stats["power"]


def test_archives_of_lamps_with_other_names_are_refused(solution, tmp_path):
    """Which of them is which could not be told."""
    solution.save(tmp_path / "kept.npz")
    renamed = lit_room()
    for shape in renamed.shapes():
        shape.set_id({"one": "two", "two": "three"}.get(shape.id(), shape.id()))
    with pytest.raises(mr.RadiosityError, match="were called one, two, and are called three, two now|two, three now"):
        mr.Solution.load(tmp_path / "kept.npz", renamed)


def test_layers_have_rays_of_their_own():
    """Two equal lamps in mirrored places would otherwise share the noise of their samples."""
    twins = mr.solve(lit_room(1.0, 1.0), layers=True, elements=100, rays=20_000)
    one, two = (np.array(x) for x in twins.layers.indirect)
    flows = [(h[0] / np.average(h[0])) for h in (one, two)]
    assert not np.allclose(*flows)


def test_damaged_layers_are_refused(solution, tmp_path):
    solution.save(tmp_path / "whole.npz")
    with np.load(tmp_path / "whole.npz") as whole:
        np.savez(tmp_path / "cut.npz", **{name: whole[name] for name in whole.files if name != "layers_direct"})
    with pytest.raises(mr.RadiosityError, match="not a readable solution"):
        mr.Solution.load(tmp_path / "cut.npz", solution.model.scene)


def test_hours(solution):
    """A year's schedule in one product is as hour for hour."""
    hours = [{"one": k / 4, "two": (1, k / 4, 0)} for k in range(5)]
    found = irradiance_over(solution, hours)
    assert found.shape == (5, solution.stats["elements"], 3)
    for H, hour in zip(found, hours):
        np.testing.assert_allclose(H, solution.relight(hour).leaves().irradiance, rtol=1e-5, atol=1e-9)
    assert irradiance_over(solution, []).shape == (0, solution.stats["elements"], 3)


def every_kind():
    """A room with a hole, lit by the sky, a point, and a lamp with a texture of two colours."""
    texture = np.zeros((2, 2, 3), dtype=np.float32)
    texture[0], texture[1] = 1.0, (3.0, 0.0, 0.0)
    radiance = {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True, "filter_type": "nearest"}
    floor, wall = {"bsdf": diffuse(0.5)}, {"bsdf": diffuse(0.5, two_sided=True)}
    return scene(
        optimize=False,
        floor=rectangle(T().scale(2), **floor),
        wall=rectangle(T().translate([0, 1.5, 1]).rotate([1, 0, 0], 90), **wall),
        shade=rectangle(above(0.5, 0, 0.2), bsdf=diffuse(0.3), emitter={"type": "area", "radiance": radiance}),
        lantern={"type": "point", "position": [-1, 0, 0.5], "intensity": {"type": "rgb", "value": 0.3}},
        sky={"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.4]}},
    )


def test_every_kind_of_lamp():
    """Sky, points and textures have layers; sums are what the whole is, solved without layers, in the mean."""
    solution, plain = (mr.solve(every_kind(), layers=layers, **SMALL) for layers in (True, False))
    assert sorted(solution.layers.names) == ["lantern", "shade", "sky"]
    assert balance(solution) == pytest.approx(1, rel=1e-3)
    np.testing.assert_allclose(patch_means(solution), patch_means(plain), rtol=0.02)
    off = dict.fromkeys(solution.layers.names, 0)
    assert (np.array(solution.relight(off).radiosity()) == 0).all()
    shade = solution.relight(off | {"shade": (2, 1, 1)})
    assert shade.stats["power"]["emitted"] == pytest.approx(0.16 * np.pi * (2 * 2 + 0.5 + 0.5), rel=1e-3)
    E = np.array(shade.elements.emission(dr.arange(mi.UInt32, len(shade.elements))))
    assert E[0].max() == pytest.approx(6 * np.pi, rel=1e-3) and E[2].max() == pytest.approx(np.pi, rel=1e-3)
    # Straight below the lantern, at 0.5 m: 2 · 0.3 / 0.25, gathered there.
    lantern = solution.relight(off | {"lantern": 2})
    assert lantern.irradiance([[-1, 0, 0]], [[0, 0, 1]])[0, 0] == pytest.approx(2.4, rel=0.1)
    assert [type(light).__name__ for light in lantern.model.lights.free] == ["Dimmed"]
    blue = solution.relight(off | {"sky": (0, 0, 1)})
    assert (np.array(blue.radiosity())[:2] == 0).all() and np.array(blue.radiosity())[2].max() > 0


@pytest.mark.parametrize(
    "scales, says",
    [
        ({"three": 1}, "no lamp 'three': choose from one, two"),
        ({2: 1}, "no lamp 2"),
        ({-1: 1}, "no lamp -1"),
        ({"one": -1}, "≥ 0"),
        ({"one": float("nan")}, "≥ 0"),
        ({"one": (1, 2)}, "one number ≥ 0 or three"),
    ],
)
def test_refused(solution, scales, says):
    with pytest.raises(mr.RadiosityError, match=says):
        solution.relight(scales)


def test_without_layers(cornell):
    plain = mr.solve(cornell, elements=200, rays=5_000)
    for call in (lambda: plain.relight({}), lambda: irradiance_over(plain, [{}])):
        with pytest.raises(mr.RadiosityError, match="layers=True"):
            call()
