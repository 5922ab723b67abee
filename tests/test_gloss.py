"""Pictures of rough metal and principled materials: emitters in them, noise, and how well spread directions are."""

import mi_radiosity as mr
from mi_radiosity.transport import Paths

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle
from scipy import stats

T = mi.ScalarTransform4f
PATH = {"type": "path", "max_depth": -1}


ROUGH = {"type": "roughconductor", "alpha": 0.2}
WOOD = {"type": "rgb", "value": [0.5, 0.3, 0.2]}
BSDFS = {
    "rough metal": ROUGH,
    **{f"principled {r}": {"type": "principled", "base_color": WOOD, "roughness": r} for r in (0.3, 0.5)},
    "principled metal": {"type": "principled", "base_color": WOOD, "roughness": 0.5, "metallic": 1.0},
}


def plate(lamp, bsdf=ROUGH):
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    look = T().look_at([-1.5, 0, 1.0], [0, 0, 0], [0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 60, "to_world": look, "film": film},
            "plate": rectangle(bsdf=bsdf),
            "wall": rectangle(T().translate([1, 0, 1]).rotate([0, 1, 0], -90), bsdf=diffuse(0.5)),
            "lamp": lamp,
        }
    )


LAMPS = {
    "area": rectangle(
        T().translate([0.4, 0, 1.2]).rotate([1, 0, 0], 180).scale(0.1), bsdf=diffuse(0), emitter=lamp(300)
    ),
    "point": {"type": "point", "position": [0.4, 0, 1.2], "intensity": 3.0},
    "sky": {"type": "constant", "radiance": 0.5},
}


@pytest.mark.parametrize("name", LAMPS)
def test_rough_metal_mirrors_lamps_as_path_sees_them(name):
    truth = plate(LAMPS[name])
    solution = mr.solve(truth, rays=200_000)
    ours, theirs = (
        np.array([np.array(image)[..., :3] for image in images])
        for images in (
            [solution.render(spp=64, shading="gather", seed=seed) for seed in range(6)],
            [mi.render(truth, integrator=mi.load_dict(PATH), spp=256, seed=seed) for seed in range(6)],
        )
    )
    (a, e), (b, f) = ((x.mean(), x.mean(axis=(1, 2, 3)).std(ddof=1) / 6**0.5) for x in (ours, theirs))
    assert abs(a - b) < 4 * np.hypot(e, f) + 0.01 * b


def variance(images):
    """Variance between images of different seeds, without the hundredth of the pixels where it is largest: single
    bright paths that both find by chance say nothing."""
    each = np.sort(images.var(axis=0, ddof=1).ravel())
    return each[: int(0.99 * len(each))].mean()


@pytest.mark.parametrize("bsdf", BSDFS)
@pytest.mark.parametrize("name", LAMPS)
def test_pictures_have_no_more_noise_than_path(name, bsdf):
    """At as many samples, between ten seeds."""
    truth = plate(LAMPS[name], BSDFS[bsdf])
    solution = mr.solve(truth, mr.Uniform(), elements=500, rays=100_000)
    path = mi.load_dict(PATH)
    ours = np.array([solution.render(spp=16, shading="gather", seed=seed)[..., :3] for seed in range(10)])
    theirs = np.array([mi.render(truth, integrator=path, spp=16, seed=seed)[..., :3] for seed in range(10)])
    assert variance(ours) < 1.1 * variance(theirs)


def test_first_vertices_are_as_well_spread_as_camera_rays(monkeypatch):
    """Plates of a rough lobe under a lamp, 64 samples: beside directions drawn independently the variance between seeds
    is smaller, by an F-test with the pixels' own degrees of freedom at the level of 1e-4; the mean is the same."""
    solution, follow = mr.solve(plate(LAMPS["area"]), mr.Uniform(), elements=500, rays=100_000), Paths.follow

    def images():
        return np.array([solution.render(spp=64, shading="gather", seed=seed)[..., 1] for seed in range(8)])

    spread = images()

    def without_given_numbers(self, *args, first=(), **more):
        return follow(self, *args[:8], **more)

    monkeypatch.setattr(Paths, "follow", without_given_numbers)
    independent = images()
    variances = [x.var(axis=0, ddof=1) for x in (independent, spread)]
    freedom = [7 * np.sum(v) ** 2 / np.sum(v**2) for v in variances]  # Satterthwaite's
    assert stats.f.sf(variances[0].mean() / variances[1].mean(), *freedom) < 1e-4
    means = [x.mean(axis=(1, 2)) for x in (independent, spread)]
    error = np.hypot(*(mean.std(ddof=1) / 8**0.5 for mean in means))
    assert abs(means[0].mean() - means[1].mean()) < 4 * error
