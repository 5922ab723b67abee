"""Light gathered at leaves and pixels: unbiased, exact in its budget, better than shooting, as sharp as paths."""

import dataclasses

import mi_radiosity as mr
from mi_radiosity.display.pixels import PixelPoints
from mi_radiosity.evaluation.metrics import rmse
from mi_radiosity.evaluation.reference import path_image
from mi_radiosity.scene import Model
from mi_radiosity.transport import lamps as lamps_of_places
from mi_radiosity.transport.lamps import LampChoice

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene
from scipy import stats

T = mi.ScalarTransform4f


def small(cornell_dict):
    """The Cornell box on a film of 64 × 64 box-filtered pixels."""
    cornell_dict["sensor"]["film"] |= {"width": 64, "height": 64, "rfilter": {"type": "box"}}
    return mi.load_dict(cornell_dict)


@pytest.fixture(scope="module")
def box():
    return small(mi.cornell_box())


@pytest.fixture(scope="module")
def solution(box):
    return mr.solve(box, elements=2000, rays=400_000)


@pytest.fixture(scope="module")
def reference(box):
    return path_image(box, box.sensors()[0], 4096)


def test_all_rays_are_counted(solution):
    found = solution.stats
    assert found["rays"] == 400_000 == found["power_rays"] + found["gather_rays"]
    assert 0.8 * 400_000 < found["gather_rays"] <= 0.9 * 400_000


def test_every_line_counts():
    """A line to each lamp that is no surface, and one to those that are: the budget is met by what is cast."""
    panel = rectangle(T().translate([0, 0, 0.9]).scale(0.2), bsdf=diffuse(0), emitter=lamp(), flip_normals=True)
    points = {f"point{k}": {"type": "point", "position": [0, 0, 0.1 * k]} for k in range(3)}
    room, cast = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)}, []

    class Counted(mr.Gathering):
        def __call__(self, problem, *rest, **more):
            problem.model.rays = Counting(problem.model.rays)
            return super().__call__(problem, *rest, **more)

    class Counting:
        def __init__(self, rays):
            self.__dict__.update(vars(rays), _rays=rays)

        def __getattr__(self, name):
            return getattr(self._rays, name)

        def follow(self, origin, *rest, **more):
            cast.append(dr.width(origin))
            return self._rays.follow(origin, *rest, **more)

        def meet(self, origin, *rest):
            cast.append(dr.width(origin))
            return self._rays.meet(origin, *rest)

        def blocked(self, a, *rest):
            cast.append(dr.width(a))
            return self._rays.blocked(a, *rest)

        def blocked_along(self, start, *rest):
            cast.append(dr.width(start))
            return self._rays.blocked_along(start, *rest)

        def kernel_at(self, x, *rest):
            cast.append(dr.width(x))
            return self._rays.kernel_at(x, *rest)

    stats = mr.solve(scene(room=room, panel=panel, **points), elements=500, rays=100_000, transport=Counted()).stats
    assert sum(cast) == stats["rays"] == stats["power_rays"] + stats["gather_rays"]


def test_lamps_much_weaker_than_others_shine():
    """A lamp whose share of the rays rounds to none lights what only it can: the inside of a chest."""
    cube = {"type": "cube", "bsdf": diffuse(0.5, two_sided=True)}
    far, near = ({"type": "point", "position": p, "intensity": i} for p, i in (([9, 0, 0], 1e7), ([0.2, 0, 0], 1.0)))
    hall = cube | {"to_world": T().scale(20)}
    room = scene(hall=hall, chest=cube, far=far, near=near)
    solution = mr.solve(room, elements=500, rays=50_000, transport=mr.Shooting())
    leaves = solution.leaves()
    inside = leaves.back & (np.abs(leaves.vertices).max(axis=(1, 2)) < 1.01)
    direct = np.array(dr.gather(mi.Color3f, solution.direct, solution.elements.leaves)).T
    assert (direct * leaves.area[:, None])[inside].sum() == pytest.approx(3 * 4 * np.pi, rel=1e-3)


def test_too_few_rays_to_gather_are_all_shot(box):
    """... and the user is told how many would do."""
    stats = mr.solve(box, elements=2000, rays=4000).stats
    assert stats["gather_rays"] == 0 and f"give {30 * stats['elements']:,} or more" in stats["warnings"][0]
    assert mr.solve(box, elements=2000, rays=100_000).stats["warnings"] == []


def test_gathering_is_better_than_shooting(box, reference):
    """Three quarters of the error at as many rays: a leaf's own rays serve it better than those that chance upon it."""
    errors = {}
    for share in (0.8, 0.0):
        transport = mr.Gathering(share=share)
        image = np.array(mr.solve(box, elements=2000, rays=200_000, transport=transport).render(spp=64))[..., :3]
        errors[share] = rmse(image, reference)
    assert errors[0.8] < 0.75 * errors[0.0]


def test_noise_of_gathering_falls_with_rays():
    """In a furnace nothing but noise is wrong: slope −½ or steeper in rays."""
    room = scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5), "emitter": lamp()})
    rays, noise = 4 ** np.arange(4) * 20_000, []
    for n in rays:
        leaves = mr.solve(room, mr.Uniform(), elements=768, rays=int(n)).leaves()
        noise.append(np.average(np.abs(leaves.radiosity[:, 0] / 2 - 1), weights=leaves.area))
    assert np.polyfit(np.log(rays), np.log(noise), 1)[0] < -0.5


@pytest.mark.parametrize("shading", ["gather", "direct"])
def test_pixels_that_gather_agree_with_path(solution, reference, shading):
    """Means to 0.5 %; and gather is as sharp: closer to path than the field, whose shadows are those of elements."""
    image = np.array(solution.render(spp=256, shading=shading))[..., :3]
    assert image.mean() == pytest.approx(reference.mean(), rel=0.005)
    field = np.array(solution.render(spp=256))[..., :3]
    assert rmse(image, reference) < (0.7 if shading == "gather" else 1.0) * rmse(field, reference)


def test_walls_keep_gathered_light():
    """Behind a wall that elements cross nothing is seen, not a bit, at any pixel."""
    down = T().translate([2.5, 0, 4.9]).rotate([1, 0, 0], 180)
    room = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5), "to_world": T().scale(5)}
    wall = {"type": "cube", "bsdf": diffuse(0.5), "to_world": T().translate([-1.3, 0, 0]).scale([0.0005, 5, 5])}
    parts = scene(optimize=False, room=room, wall=wall, light=rectangle(down, bsdf=diffuse(0.5), emitter=lamp()))
    solution = mr.solve(parts, elements=1500, rays=200_000)
    film = {"type": "hdrfilm", "width": 32, "height": 32}
    eye = T().look_at([-4.5, 0.1, 0.1], [-1.3, 0, -5], [0.3, 0.2, 1])
    camera = mi.load_dict({"type": "perspective", "fov": 80, "to_world": eye, "film": film})
    for shading in ("gather", "direct", "gouraud"):
        assert np.array(solution.render(camera, spp=64, shading=shading)).max() == 0


# ---- Lamps -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("most, places", [(1 << 24, 200), (1000, 100), (5, 1)])
def test_lamps_are_drawn_as_often_as_their_density_says(most, places, monkeypatch):
    """χ² at 99.9 %: for places on three leaves, and for places nobody knows; with a row of lamps for every leaf, for
    elements above them, and with none."""
    monkeypatch.setattr(lamps_of_places, "MOST", most)
    lamps = {
        f"lamp{k}": rectangle(
            T().translate([k - 2, 0, 2]).rotate([1, 0, 0], 180).scale(0.2 + 0.1 * k), emitter=lamp(1 + k)
        )
        for k in range(5)
    }
    solution = mr.solve(scene(floor=rectangle(T().scale(4), bsdf=diffuse()), **lamps), elements=200, rays=20_000)
    choice, n = LampChoice(solution.elements), 100_000
    leaves = np.array(solution.elements.leaves)
    rows = np.stack(
        [
            np.array(choice.density(dr.full(mi.UInt32, int(p), len(leaves)), mi.UInt32(leaves)))
            for p in np.array(choice.lamps)
        ]
    )
    assert 0.3 * places < len(np.unique(rows, axis=1).T) <= places
    area = np.array(solution.model.patches.area)
    lot = mi.Float(np.random.default_rng(0).random(n).astype(np.float32))
    for leaf in (None, *np.array(solution.elements.leaves)[[0, 50, 150]]):
        places = None if leaf is None else dr.full(mi.UInt32, int(leaf), n)
        patch, density = choice.draw(lot, places)
        patch, density = np.array(patch), np.array(density)
        lamp_patches = np.array(choice.lamps)
        one = None if leaf is None else dr.full(mi.UInt32, int(leaf), len(lamp_patches))
        expected = np.array(choice.density(mi.UInt32(lamp_patches), one)) * area[lamp_patches]
        assert expected.sum() == pytest.approx(1, rel=1e-5)
        counts = np.array([(patch == p).sum() for p in lamp_patches])
        assert stats.chisquare(counts, expected * (n / expected.astype(float).sum()), sum_check=False).pvalue > 0.001
        assert density * area[patch] == pytest.approx(expected[np.searchsorted(lamp_patches, patch)], rel=1e-4)


# ---- Camera samples --------------------------------------------------------------------------------


def test_camera_samples_are_uniform():
    """χ² at 99.9 % of the first numbers of many pixels, 5 samples each: pairs, and pairs of different draws."""
    points = PixelPoints.of_all(20_000, 0, 5, 5, 0, seed=3)
    a, b, c = points.next_2d(), points.next_2d(), points.next_1d()
    for x, y in ((a.x, a.y), (b.x, b.y), (a.x, b.y), (a.y, c)):
        table = np.histogram2d(np.array(x), np.array(y), bins=8, range=((0, 1), (0, 1)))[0]
        assert stats.chisquare(table.ravel()).pvalue > 0.001


def test_camera_samples_are_well_spread():
    """The mean over 16 samples of a smooth function has a tenth of the variance of independent ones, and no bias."""
    pixels, count = 4096, 16
    points = PixelPoints.of_all(pixels, 0, count, count, 0, seed=1)
    p = points.next_2d()
    values = np.array(dr.block_sum(dr.sin(3 * p.x) * p.y, count)) / count
    exact = (1 - np.cos(3)) / 3 / 2
    second = (0.5 - np.sin(6) / 12) / 3
    independent = (second - exact**2) / count
    assert values.var() < 0.1 * independent
    assert abs(values.mean() - exact) < 3.3 * (values.var() / pixels) ** 0.5


def test_launches_of_a_pass_continue_each_other():
    """Samples drawn in two launches are those of one."""
    whole, parts = PixelPoints.of_all(10, 0, 8, 8, 0, seed=0).next_2d().x, []
    for first in (0, 4):
        parts.append(np.array(PixelPoints.of_all(10, first, 4, 8, 0, seed=0).next_2d().x).reshape(10, 4))
    np.testing.assert_array_equal(np.array(whole).reshape(10, 8), np.concatenate(parts, axis=1))


def test_passes_of_a_picture_continue_each_other():
    """All samples of two passes are as well spread as those of one: 8 in 8 rows, columns and 2 × 4 boxes each."""
    parts = [PixelPoints.of_all(50, 0, n, n, before, seed=0).next_2d() for n, before in ((2, 0), (6, 2))]
    x, y = (np.hstack([np.array(p[k]).reshape(50, -1) for p in parts]) for k in (0, 1))
    for wide, high in ((8, 1), (1, 8), (2, 4), (4, 2)):
        cell = np.floor(x * wide) * high + np.floor(y * high)
        assert (np.sort(cell, axis=1) == np.arange(8)).all()


def test_denoised_pictures_are_closer(solution, reference):
    """And as bright, but for the lamp, whose brightness the denoiser takes from its edges."""
    pytest.importorskip("mitsuba_oidn")
    plain, clean = (np.array(solution.render(spp=16, shading="gather", denoise=d))[..., :3] for d in (False, True))
    assert rmse(clean, reference) < 0.7 * rmse(plain, reference)
    walls = reference.max(axis=2) < 1
    assert clean[walls].mean() == pytest.approx(reference[walls].mean(), rel=0.01)
    assert clean.mean() == pytest.approx(reference.mean(), rel=0.02)


def test_a_white_hollow_is_no_brighter_than_what_shines_into_it():
    """Few of the rays that are shot find the slit under the lid of a small box that reflects all; those that do stay
    inside. Light in there is what comes in over what goes out and is absorbed, so less than outside, however many rays
    have come in by chance."""
    panel = rectangle(T().translate([0, 0, 0.99]).scale(0.3), bsdf=diffuse(0), emitter=lamp(), flip_normals=True)
    room = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)}
    white = {"bsdf": diffuse(1.0, two_sided=True)}
    walls = {
        f"wall{k}": rectangle(T().rotate(axis, angle).translate([0, 0, 0.05]).scale(0.05), **white)
        for k, (axis, angle) in enumerate([((1, 0, 0), 90), ((1, 0, 0), -90), ((0, 1, 0), 90), ((0, 1, 0), -90)])
    }
    lids = {
        "floor": rectangle(T().translate([0, 0, -0.05]).rotate([1, 0, 0], 180).scale(0.05), **white),
        "lid": rectangle(T().translate([0, 0, 0.054]).scale(0.05), **white),
    }
    model = Model(scene(panel=panel, room=room, **walls, **lids))
    shooting = mr.Gathering().first

    def with_a_lucky_ray(problem, *rest, **more):
        flow, e = shooting(problem, *rest, **more), problem.elements
        inside = dr.gather(mi.Bool, e.patches.back, e.patch)
        return dataclasses.replace(flow, indirect=flow.indirect + dr.select(inside, 1000, 0))

    for lucky in (False, True):
        first = with_a_lucky_ray if lucky else shooting
        leaves = mr.solve(model, elements=200, rays=40_000, transport=mr.Gathering(first=first)).leaves()
        inside = leaves.back
        assert inside.sum() >= 12 and leaves.radiosity[inside].max() <= leaves.radiosity[~inside].max()
