"""Pictures that grow: within a time, and denoised."""

import re

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.display import denoise, pixels
from mi_radiosity.display.image import write_image
from mi_radiosity.scene import Model
from mi_radiosity.solver import cost
from mi_radiosity.transport import Gatherer, PathEnd

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

BOX = "scenes_xml/cornell_box.xml"
T = mi.ScalarTransform4f
PATH = {"type": "path", "max_depth": -1}


@pytest.fixture(scope="module")
def box():
    parts = mi.cornell_box()
    parts["sensor"]["film"] |= {"width": 48, "height": 48}
    return mi.load_dict(parts)


@pytest.fixture(scope="module")
def solution(box):
    return mr.solve(box, elements=1500, rays=200_000)


# ---- Within a time ---------------------------------------------------------------------------------


class Clock:
    """Time that passes only when samples are taken, a second each."""

    now = 0.0

    def perf_counter(self):
        return self.now


class Counted:
    """A picture that counts, ``least`` samples at first, and takes a while to finish."""

    def __init__(self, clock, least=1, last=0.0):
        self.clock, self.least, self.last, self.passes = clock, least, last, []

    def add(self, spp):
        self.clock.now += spp
        self.passes.append(spp)
        return spp

    def preview(self):
        return sum(self.passes)

    def finishing(self, seconds, spp):
        return self.last


@pytest.mark.parametrize("least, last", [(1, 0.0), (4, 0.0), (1, 7.0), (4, 7.0)])
@pytest.mark.parametrize("seconds", [0.5, 3, 10, 1000])
def test_passes_grow_and_fill_the_time(seconds, least, last, monkeypatch):
    """From the least there are, and leave what the last image takes."""
    clock, told = Clock(), []
    monkeypatch.setattr(pixels, "time", clock)
    picture = Counted(clock, least, last)
    done = pixels.grow(picture, seconds, lambda image, samples: told.append((image(), samples)))
    assert done == sum(picture.passes) == told[-1][1] and all(image == samples for image, samples in told)
    assert picture.passes[0] == least
    left = seconds - last
    assert done == least if left < least else 0.85 * left - 1 <= done <= max(left, least)
    assert len(picture.passes) < 20


def test_a_picture_within_a_time_is_as_right_as_others(box, solution):
    """Its passes are independent and add up: the mean agrees with path to 1 %, and there is one after every pass."""
    seen = []
    for spp in (1, 16):  # lest compiling take the time
        solution.render(shading="gather", spp=spp)
    image = solution.render(shading="gather", seconds=1.5, show=lambda image, samples: seen.append(samples))
    true = np.mean([mi.render(box, integrator=mi.load_dict(PATH), spp=256, seed=k) for k in range(4)])
    assert np.mean(image) == pytest.approx(true, rel=0.01) and seen == sorted(set(seen)) and seen[0] == 1


def test_a_denoised_picture_keeps_the_mean(solution):
    """Of all that is not a lamp, whose brightness the denoiser takes from its edges; so does one that grows."""
    pytest.importorskip("mitsuba_oidn")
    noisy = np.array(solution.render(shading="gather", spp=256))
    walls = noisy.max(axis=2) < 1
    for how in ({"spp": 64}, {"seconds": 1.5}):
        clean = np.array(solution.render(shading="gather", denoise=True, **how))
        assert clean[walls].mean() == pytest.approx(noisy[walls].mean(), rel=0.02)


def test_solves_get_what_the_time_allows(box, monkeypatch):
    """Elements and rays go with the time, up to a mesh and rays that add no more; what is given stays."""
    model = Model(box)
    pace = cost.Pace.of(model)
    monkeypatch.setattr(cost.Pace, "of", lambda *_: pace)
    usual = cost.estimate_cost(model)
    budgets = [cost.afford(model, usual.seconds * share) for share in (0, 0.1, 0.5, 1, 3, 1000)]
    elements, rays, paces = zip(*budgets)
    assert list(elements[:3]) == sorted(elements[:3]) and list(rays) == sorted(rays)
    assert budgets[3][:2] == (None, usual.rays) and elements[4:] == (None, None)  # as by default
    assert set(paces) == {pace} and 0 < pace.ray * usual.rays < usual.seconds
    assert rays[-1] == cost.MOST * usual.rays and model.patches.count < elements[0] < usual.elements
    assert cost.affordable(10**6, 1000, 3.0, 1.0, 2.0**-18) == 2**19  # what is left decides, unless it would be noisy
    assert cost.affordable(10**6, 1000, 1.0, 2.0, 2.0**-18) == int(cost.RAYS_SHARE * 2**18)  # rays have a share
    assert cost.affordable(10**6, 1000, 1.0, 2.0, 1e-4) == 1000 * cost.FEW_RAYS
    assert cost.affordable(10**4, 1000, 3.0, 1.0, 2.0**-18) == 10**4
    monkeypatch.undo()
    solution = mr.solve(box, seconds=0.05, rays=10_000)
    assert solution.stats["rays"] == 10_000 and solution.stats["elements"] < usual.elements


@pytest.mark.parametrize("seconds", [0, -1, float("nan"), float("inf")])
def test_impossible_times_are_refused(box, solution, seconds):
    for ask in (lambda: mr.solve(box, seconds=seconds), lambda: solution.render(seconds=seconds)):
        with pytest.raises(mr.RadiosityError, match="seconds must be a number greater than 0"):
            ask()


def test_seconds_on_the_command_line(tmp_path, capsys):
    out = tmp_path / "box.exr"
    assert main(["render", BOX, "-o", str(out), "--seconds", "0.5"]) == 0 and out.is_file()
    assert main(["render", BOX, "-o", str(out), "--seconds", "1", "--spp", "4"]) == 2
    assert "either --spp or --seconds" in capsys.readouterr().err
    assert main(["render", BOX, "-o", str(out), "--seconds", "-1"]) == 2
    assert "not a number greater than 0" in capsys.readouterr().err


def test_an_interrupt_keeps_the_best_so_far(tmp_path, capsys, monkeypatch):
    out, add = tmp_path / "box.exr", pixels.FilmPicture.add

    def interrupted(self, spp):
        if spp > 2:
            raise KeyboardInterrupt
        return add(self, spp)

    monkeypatch.setattr(pixels.FilmPicture, "add", interrupted)
    assert main(["render", BOX, "-o", str(out), "--seconds", "60", "--elements", "200", "--rays", "9000"]) == 130
    found = re.search(r"interrupted: .*box.exr has (\d) samples per pixel", capsys.readouterr().err)
    assert found and int(found[1]) >= 1 and np.isfinite(np.array(mi.Bitmap(str(out)))).all()


# ---- Denoised --------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 2, 3])
@pytest.mark.parametrize("name", ["gaussian", "tent", "mitchell", "box"])
def test_a_filter_over_parts_of_pixels_is_as_wide_as_the_film_s(name, parts):
    """Variances add up: that of the weights and of a part itself is that of the filter, or of a pixel if it is less."""
    rfilter = mi.load_dict({"type": name})
    weight = denoise._over_parts(rfilter, parts)
    x = np.linspace(-rfilter.radius(), rfilter.radius(), 20001)
    curve = np.array([float(rfilter.eval(float(y))[0]) for y in x])
    wide = 1 / 12 if name == "box" else (curve @ x**2) / curve.sum()
    place = (np.arange(len(weight)) - (len(weight) - 1) / 2) / parts
    assert weight.sum() == pytest.approx(1) and weight == pytest.approx(weight[::-1])
    assert weight @ place**2 + 1 / (12 * parts**2) == pytest.approx(max(wide, 1 / 12), rel=0.03, abs=1e-3)


@pytest.mark.parametrize("parts", [1, 2])
def test_filtered_parts_are_pixels_in_their_place(parts):
    """A ramp stays one away from the border, whatever the filter; and of a box a pixel is the mean of its parts."""
    wide, high = 12, 9
    across = (np.arange(wide * parts) + 0.5) / parts
    ramp = np.repeat(np.broadcast_to(across, (high * parts, wide * parts))[..., None], 3, axis=2).astype(np.float32)
    for name in ("gaussian", "tent", "mitchell", "box"):
        image = denoise._filtered(ramp, mi.load_dict({"type": name}), parts)
        assert image.shape == (high, wide, 3) and image.dtype == np.float32
        assert image[:, 3:-3] == pytest.approx(np.broadcast_to(np.arange(3, wide - 3)[:, None] + 0.5, (high, 6, 3)))
    image = np.random.default_rng(0).random((high * parts, wide * parts, 3)).astype(np.float32)
    mean = image.reshape(high, parts, wide, parts, 3).mean(axis=(1, 3))
    assert denoise._filtered(image, mi.load_dict({"type": "box"}), parts) == pytest.approx(mean)


def test_denoising_parts_of_pixels_keeps_edges(box, solution, monkeypatch):
    """Beside `path` under the film's own filter the picture is better than if whole pixels were denoised; and every
    pixel has as many samples as were asked for."""
    pytest.importorskip("mitsuba_oidn")
    monkeypatch.setattr(denoise, "APART", 1)
    true = np.mean([mi.render(box, integrator=mi.load_dict(PATH), spp=256, seed=k) for k in range(8)], axis=0)[..., :3]
    integrator = mi.load_dict({"type": "radiosity"})
    integrator.show(solution, "gather")
    picture = denoise.CleanPicture(integrator._see, box.sensors()[0], integrator._sample, seed=1)
    picture.add(62)
    colors, features = picture._counts
    assert (picture._taken() == 62).all() and colors.min() == 15 and colors.max() == 16
    assert (features == denoise.FEATURE_SPP / denoise.FINE**2).all()

    def error(image):
        return np.sqrt(np.mean((np.clip(image, 0, 1) - np.clip(true, 0, 1)) ** 2))

    assert error(picture.image()) < 0.8 * error(picture.preview())


def test_camera_rays_are_mitsubas():
    """Of all pixels, from the same numbers; with a lens, a shutter, and a part of the film only."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    film = {"width": 40, "height": 30, "crop_width": 12, "crop_height": 6, "crop_offset_x": 7, "crop_offset_y": 9}
    lens = {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 2.0, "shutter_close": 1.5}
    parts = {"type": "scene", "camera": lens | {"film": {"type": "hdrfilm", "rfilter": {"type": "box"}} | film}}
    scene, spp = mi.load_dict(parts), 4
    draw = lambda: pixels.PixelPoints.of_all(12 * 6, 0, spp, spp, 0, seed=5)
    theirs, _, _ = ADIntegrator.sample_rays(None, scene, scene.sensors()[0], draw())
    ours, _ = pixels.camera_rays(scene.sensors()[0], 12, 6, dr.arange(mi.UInt32, 12 * 6 * spp) // spp, draw())
    for a, b in ((ours.o, theirs.o), (ours.d, theirs.d), (ours.time, theirs.time)):
        np.testing.assert_allclose(np.array(a), np.array(b), atol=2e-6)


def noise_in_a_corner(points, ray, met):
    """Black or white, by chance, in the lower left of the picture; grey elsewhere."""
    corner = (ray.d.x > 0.15) & (ray.d.y < -0.15)
    return mi.Color3f(dr.select(corner, dr.select(points.next_1d() < 0.3, 1.0, 0.0), 0.5)), True, []


def test_more_samples_are_taken_where_denoised_halves_differ(box):
    """As many in all as asked for, a quarter of them everywhere; the same ones every time; the mean is right."""
    pytest.importorskip("mitsuba_oidn")
    pictures = [
        denoise.CleanPicture(box.ray_intersect_preliminary, box.sensors()[0], noise_in_a_corner, seed=3)
        for _ in range(2)
    ]
    for picture in pictures:
        picture.take(64)
    counts = pictures[0]._taken()
    np.testing.assert_array_equal(pictures[0]._counts, pictures[1]._counts)
    np.testing.assert_array_equal(*(np.array(picture.image()) for picture in pictures))
    assert counts.mean() == pytest.approx(64, rel=0.02) and counts.min() >= 16
    parts, means = pictures[0]._counts[0], pictures[0]._mean(0)[..., 0]
    noisy = denoise._blocks(np.float32((means != 0.5)[..., None]), denoise.FINE)[..., 0] > 0
    assert 0.02 < noisy.mean() < 0.3 and counts[noisy].mean() > 3 * counts[~noisy].mean()
    n = parts[means != 0.5].sum()
    assert np.average(means[means != 0.5], weights=parts[means != 0.5]) == pytest.approx(0.3, abs=4 * 0.46 / n**0.5)


def test_halves_of_pixels_are_as_many(box):
    """However many samples there are, in passes of any size."""
    pytest.importorskip("mitsuba_oidn")

    def white(points, ray, met):
        return mi.Color3f(dr.select(ray.d.x > 2, 0.0, 1.0)), True, []

    picture = denoise.CleanPicture(box.ray_intersect_preliminary, box.sensors()[0], white, seed=3)
    taken = 0
    for spp in (5, 1, 2, 3, 7.5):
        picture._needed = None if spp < 3 else np.random.default_rng(0).random(picture._taken().shape, np.float32) + 0.1
        picture._add(spp)
        taken += spp
        assert picture._taken().mean() == pytest.approx(taken, rel=0.02)
        radiance, apart, *_ = (np.array(total).T.reshape(*picture._counts.shape[1:], 3) for total in picture._sums)
        assert (denoise._blocks(apart, denoise.FINE) == 0).all()
    assert (radiance[..., 0] == picture._counts[0]).all()
    assert len(np.unique(picture._taken())) > 3


def test_denoising_takes_its_share_of_the_time(box, monkeypatch):
    """The better, the more time there is; parts of pixels of enough samples only; and the last image has its time."""
    pytest.importorskip("mitsuba_oidn")
    picture = denoise.CleanPicture(None, box.sensors()[0], None, 0)
    (least, *_, best), fine = denoise.WAYS, [way for way in denoise.WAYS if way.parts > 1]
    monkeypatch.setattr(denoise.CleanPicture, "_pace", picture._pace / picture._takes(least))  # the cheapest: 1 s
    planned = [picture.finishing(seconds, 64) for seconds in range(60)]
    assert planned == sorted(planned) and planned[0] == pytest.approx(1) and planned[-1] == pytest.approx(best.cost)
    assert all(planned[seconds] <= max(0.6 * seconds, 1.001) for seconds in range(60))
    coarse = max(way.cost for way in denoise.WAYS if way.parts == 1)
    assert picture.finishing(1000, min(way.least for way in fine) - 1) == pytest.approx(coarse)


def test_what_is_brighter_than_white_is_white_in_a_png(tmp_path):
    """However bright: a small lamp has a radiance of many thousands."""
    write_image(tmp_path / "bright.png", mi.TensorXf(np.float32([[[0, 0.5, 1], [2, 3e3, 1e6]]])))
    (dark, half, white), *bright = np.array(mi.Bitmap(str(tmp_path / "bright.png"))).reshape(2, 3).tolist()
    assert dark == 0 and half in (187, 188) and white == 255 and bright == [[255, 255, 255]]


# ---- Leaves that walls cross -----------------------------------------------------------------------


def test_looking_up_light_beside_walls_loses_none():
    """Over crossed leaves, what rays would find adds up to ρ H A: all of it is where the light came down."""
    wall = rectangle(
        T().translate([0.13, 0, 0]).rotate([0, 1, 0], 90).scale([1, 0.9, 1]), bsdf=diffuse(0.5, two_sided=True)
    )
    panel = rectangle(T().translate([0.5, 0, 0.9]).rotate([1, 0, 0], 180).scale(0.3), bsdf=diffuse(0), emitter=lamp())
    room = scene(room={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)}, wall=wall, panel=panel)
    solution = mr.solve(room, mr.Uniform(), elements=300, rays=300_000)
    e, exposure, gatherer = solution.elements, solution.exposure, solution.gatherer
    crossed = dr.gather(mi.UInt32, e.leaves, dr.compress(dr.gather(mi.UInt32, exposure.slot, e.leaves) != 0xFFFFFFFF))
    n, m = dr.width(crossed), 4096
    assert n > 10 and isinstance(gatherer, Gatherer)
    rng = np.random.default_rng(0)
    a, b = rng.random((2, n * m))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    leaf = dr.gather(mi.UInt32, crossed, dr.arange(mi.UInt32, n * m) // m)
    patch = dr.gather(mi.UInt32, e.patch, leaf)
    u, v = e.patch_point(leaf, mi.Float(a.astype(np.float32)), mi.Float(b.astype(np.float32)))

    yes = mi.Bool(True)
    end = PathEnd(mi.Color3f(0), mi.Color3f(1), leaf, patch, u, v, yes, yes)
    found = np.array(gatherer.reflected_by(end).x).reshape(n, m).mean(axis=1)
    want = np.array(dr.gather(mi.Float, e.reflectance.x * solution.irradiance().x, crossed))
    want = want * np.array(exposure.open_share(e, crossed))
    area = np.array(dr.gather(mi.Float, e.area, crossed))
    assert (found * area).sum() == pytest.approx((want * area).sum(), rel=0.03)
