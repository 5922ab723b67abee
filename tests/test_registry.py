"""Every BSDF that the installed Mitsuba ships agrees with `path`, or is refused in one line."""

from pathlib import Path

import mi_radiosity as mr

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle
from scipy import stats

T = mi.ScalarTransform4f
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
LEAN = mi.Bitmap(np.tile(np.float32([0.65, 0.5, 0.9]), (4, 4, 1)))
BUMPS = mi.Bitmap(np.float32(0.02 * np.sin(np.arange(64) / 64 * 4 * np.pi))[None, :, None].repeat(64, axis=0))
# What a plugin needs beyond its defaults.
NEEDS = {
    "twosided": {"bsdf": {"type": "roughplastic"}},
    "mask": {"opacity": 0.6, "bsdf": GREY},
    "blendbsdf": {"weight": 0.4, "a": GREY, "b": {"type": "roughconductor", "alpha": 0.3}},
    "normalmap": {"normalmap": {"type": "bitmap", "raw": True, "bitmap": LEAN}, "bsdf": GREY},
    "bumpmap": {"bumpmap": {"type": "bitmap", "raw": True, "bitmap": BUMPS}, "bsdf": GREY},
}
FILES = {"measured", "measured_polarized"}  # need measurements that Mitsuba does not ship
REFUSED = {"hair": "Hair"}
RUNS = 3


def plugins():
    """Names of all BSDF plugins beside the Mitsuba that is installed."""
    manager, found = mi.PluginManager.instance(), []
    for file in sorted((Path(mi.__file__).parent / "plugins").iterdir()):
        try:
            kind = manager.plugin_type(file.stem.removeprefix("lib"))
        except RuntimeError:
            continue
        if kind == mi.ObjectType.BSDF:
            found.append(file.stem.removeprefix("lib"))
    return found


def room(bsdf):
    """A block of a BSDF under a panel, in a grey room."""
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    look = T().look_at([0, -0.95, 0.1], [0, 1, -0.6], [0, 0, 1])
    panel = rectangle(T().translate([0.3, -0.2, 0.95]).rotate([1, 0, 0], 180).scale(0.4), emitter=lamp(20))
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 60, "to_world": look, "film": film},
            "room": {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)},
            "block": {"type": "cube", "to_world": T().translate([0, 0, -0.6]).scale([0.6, 0.6, 0.2]), "bsdf": bsdf},
            "panel": panel | {"bsdf": diffuse(0)},
        },
        optimize=False,
    )


def nestings(name):
    """The BSDF by itself and in others, as far as Mitsuba allows that."""
    bsdf = {"type": name, **NEEDS.get(name, {})}
    yield bsdf
    for outer in (
        {"type": "twosided", "bsdf": bsdf},
        {"type": "mask", "opacity": 0.7, "bsdf": bsdf},
        {"type": "blendbsdf", "weight": 0.4, "a": bsdf, "b": GREY},
    ):
        try:
            mi.load_dict(outer)
        except RuntimeError:
            continue
        yield outer


def test_the_registry_is_complete():
    """Mitsuba's documentation lists these and more."""
    assert {"diffuse", "principled", "principledthin", "plastic", "pplastic", "mask", "hair"} <= set(plugins())


@pytest.mark.parametrize("name", sorted(set(plugins()) - FILES))
def test_every_bsdf_agrees_with_path_or_is_refused(name):
    """The mean of the picture to 0.5 % and what chance allows (Welch's t at 1e-4), alone and nested."""
    path = mi.load_dict({"type": "path", "max_depth": -1})
    for bsdf in nestings(name):
        scene = room(bsdf)
        if name in REFUSED:
            with pytest.raises(mr.RadiosityError, match=rf"'block'.*'{REFUSED[name]}'.*use another"):
                mr.solve(scene)
            continue
        theirs = [np.mean(mi.render(scene, integrator=path, spp=256, seed=seed)) for seed in range(RUNS)]
        ours = [
            np.mean(mr.solve(scene, elements=400, rays=60_000, seed=seed).render(spp=32, shading="gather", seed=seed))
            for seed in range(RUNS)
        ]
        error = np.hypot(*(np.std(x, ddof=1) / RUNS**0.5 for x in (ours, theirs)))
        off = abs(np.mean(ours) - np.mean(theirs))
        assert off < 0.005 * np.mean(theirs) + stats.t.ppf(1 - 1e-4, 2 * RUNS - 2) * error, (
            bsdf,
            np.mean(ours) / np.mean(theirs),
        )
