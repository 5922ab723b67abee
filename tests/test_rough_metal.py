"""Pictures of rough metal: lamps in it, and how well spread its lobes are."""

import mi_radiosity as mr
from mi_radiosity.scene.lobes import Lobes

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle
from scipy import stats

T = mi.ScalarTransform4f
PATH = {"type": "path", "max_depth": -1}


def plate(lamp):
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    look = T().look_at([-1.5, 0, 1.0], [0, 0, 0], [0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 60, "to_world": look, "film": film},
            "plate": rectangle(bsdf={"type": "roughconductor", "alpha": 0.2}),
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


def test_lines_from_rough_metal_take_its_noise_away():
    """A third of the noise that the lobe's own rays have, at as many samples."""
    solution = mr.solve(plate(LAMPS["area"]), mr.Uniform(), elements=500, rays=100_000)
    noise = []
    for highlights in (solution.gatherer.highlights, None):
        solution.gatherer.highlights = highlights
        noise.append(np.std([solution.render(spp=16, shading="gather", seed=seed) for seed in range(6)], axis=0).mean())
    assert noise[0] < noise[1] / 3


def test_first_lobes_are_as_well_spread_as_camera_rays(monkeypatch):
    """Plates of a rough lobe under a lamp, 64 samples: beside lobes drawn independently the variance between seeds is
    smaller, by an F-test with the pixels' own degrees of freedom at the level of 1e-4; the mean is the same."""
    solution, follow = mr.solve(plate(LAMPS["area"]), mr.Uniform(), elements=500, rays=100_000), Lobes.follow

    def variance():
        images = np.array([solution.render(spp=64, shading="gather", seed=seed)[..., 1] for seed in range(8)])
        return images.var(axis=0, ddof=1), images.mean(axis=(1, 2))

    spread, mean = variance()
    monkeypatch.setattr(Lobes, "follow", lambda self, *args, first=(): follow(self, *args[:9]))
    independent, same = variance()
    freedom = [7 * np.sum(v) ** 2 / np.sum(v**2) for v in (independent, spread)]  # Satterthwaite's
    assert stats.f.sf(independent.mean() / spread.mean(), *freedom) < 1e-4
    assert abs(mean.mean() - same.mean()) < 4 * np.hypot(mean.std(ddof=1), same.std(ddof=1)) / 8**0.5
