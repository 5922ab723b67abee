"""Lobes that are not diffuse: every material of Mitsuba against `path`, energy, and what stays as it was."""

import mi_radiosity as mr
from mi_radiosity.scene import Model

import mitsuba as mi
import numpy as np
import pytest
from conftest import balance

COLOR = {"type": "rgb", "value": [0.5, 0.3, 0.2]}
DIFFUSE = {"type": "diffuse", "reflectance": COLOR}
MATERIALS = {
    "plastic": {"type": "plastic", "diffuse_reflectance": COLOR},
    "rough plastic": {"type": "roughplastic", "diffuse_reflectance": COLOR, "alpha": 0.2},
    "conductor": {"type": "conductor", "material": "Al"},
    "rough conductor": {"type": "roughconductor", "alpha": 0.3},
    "principled": {"type": "principled", "base_color": COLOR, "roughness": 0.4, "specular": 0.5},
    "blend": {"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE, "b": {"type": "roughconductor", "alpha": 0.3}},
    "glass": {"type": "dielectric"},
    "thin glass": {"type": "thindielectric"},
    "rough glass": {"type": "roughdielectric", "alpha": 0.3},
    "null": {"type": "null"},
    "mask": {"type": "mask", "opacity": 0.3, "bsdf": {"type": "twosided", "bsdf": DIFFUSE}},
    "thin principled": {"type": "principledthin", "base_color": COLOR, "diff_trans": 0.6, "roughness": 0.4},
    "two sides": {"type": "twosided", "a": DIFFUSE, "b": {"type": "conductor"}},
}
TRANSPARENT = ("glass", "thin glass", "rough glass", "null", "mask", "thin principled", "two sides")


def box(material):
    """The Cornell box with its tall block of another material, on a small film."""
    parts = mi.cornell_box()
    del parts["integrator"]
    parts["sensor"]["film"] |= {"width": 48, "height": 48, "rfilter": {"type": "box"}}
    bsdf = MATERIALS[material]
    parts["large-box"]["bsdf"] = bsdf if material in TRANSPARENT else {"type": "twosided", "bsdf": bsdf}
    return mi.load_dict(parts)


def mean_and_error(images):
    means = np.array([np.array(image)[..., :3].mean(axis=(0, 1)) for image in images])
    return means.mean(axis=0), means.std(axis=0, ddof=1) / len(means) ** 0.5


@pytest.mark.parametrize("material", MATERIALS)
def test_pictures_agree_with_path(material):
    """Means to four standard errors of both and 0.5 %, in every channel; energy kept to 1 %."""
    parts = box(material)
    solution = mr.solve(parts, elements=2000, rays=300_000)
    assert balance(solution) == pytest.approx(1, abs=0.01)
    path = mi.load_dict({"type": "path", "max_depth": -1})
    ours, noise = mean_and_error([solution.render(spp=64, shading="gather", seed=seed) for seed in range(4)])
    true, error = mean_and_error([mi.render(parts, integrator=path, spp=256, seed=seed) for seed in range(4)])
    assert (np.abs(ours - true) < 4 * np.hypot(noise, error) + 0.005 * true).all(), (ours, true)


@pytest.mark.parametrize(
    "material, albedo", [("plastic", 0.455), ("rough plastic", 0.441), ("principled", 0.388), ("blend", 0.268)]
)
def test_rho_is_the_albedo_of_the_diffuse_lobe(material, albedo):
    """At a reflectance of one half, as found by independent sampling to 1 %."""
    grey = {"type": "rgb", "value": 0.5}
    bsdf = {
        "plastic": {"type": "plastic", "diffuse_reflectance": grey},
        "rough plastic": {"type": "roughplastic", "diffuse_reflectance": grey},
        "principled": {"type": "principled", "base_color": grey, "roughness": 0.4, "specular": 0.5},
        "blend": {
            "type": "blendbsdf",
            "weight": 0.5,
            "a": {"type": "diffuse", "reflectance": grey},
            "b": {"type": "roughconductor"},
        },
    }[material]
    light = {"type": "sphere", "center": [0, 0, 3], "radius": 0.2, "emitter": {"type": "area", "radiance": 1.0}}
    model = Model(mi.load_dict({"type": "scene", "plate": {"type": "rectangle", "bsdf": bsdf}, "light": light}))
    shape = [part.shape.class_name() for part in model.faces.parts].index("Rectangle")
    assert model.materials.rho[0][model.faces.shape == shape] == pytest.approx(albedo, rel=0.01)


def test_mirrors_and_glass_make_no_patches():
    """A side without a diffuse lobe receives nothing: all that meets it goes on."""
    plain, glass = (Model(box(m)) for m in ("null", "plastic"))
    assert plain.patches.count == glass.patches.count - 22


def test_diffuse_scenes_are_not_followed(cornell):
    """Not a kernel more than before: no lobe is ever asked for."""
    assert Model(cornell).rays.lobes is None
