"""Masks of textured opacity: what paths read of the solution varies over a face as the opacity does."""

import mi_radiosity as mr

import mitsuba as mi
import numpy as np
import pytest
from beside_path import compare
from conftest import diffuse, rectangle

T = mi.ScalarTransform4f
HOLES = {"type": "checkerboard", "color0": 0.0, "color1": 1.0, "to_uv": T().scale(4)}


def foliage(**mask):
    """Three sheets above each other over a floor, under a white sky: without it `path` drops light behind masks."""
    bsdf = {"type": "mask", "bsdf": diffuse(0.5, two_sided=True)} | mask
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    look = T().look_at([0, -2.5, 1.6], [0, 0, 0.3], [0, 0, 1])
    sheets = {f"sheet{k}": rectangle(T().translate([0, 0, 0.5 + 0.2 * k]).scale(0.6), bsdf=bsdf) for k in range(3)}
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
            "floor": rectangle(T().scale(1.2), bsdf=diffuse(0.5)),
            "sky": {"type": "constant", "radiance": 1.0},
            **sheets,
        },
        optimize=False,
    )


@pytest.mark.parametrize("shading", ["gather", "gouraud"])
def test_holes_show_what_is_behind(shading):
    """They were up to a quarter too bright: the solution was read where there is no surface."""
    compare(foliage(opacity=HOLES), bias=0.02, shading=shading, elements=800, rays=100_000)


def test_opacity_that_is_the_same_everywhere_costs_nothing():
    model = mr.scene.Model(foliage(opacity=0.5))
    assert float(np.array(model.materials.relative_opacity(None, mi.UInt32(0), mi.Bool(True)))[0]) == 1
