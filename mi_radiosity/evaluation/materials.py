"""Noise and mean of pictures beside `path`, material by material: `python -m mi_radiosity.evaluation.materials`."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from ..solver import solve

SPP, SEEDS = 16, 10  # samples per pixel, and pictures, whose variance is compared
TRUE_SPP, TRUE_SEEDS = 1024, 4  # of the reference
ELEMENTS, RAYS = 3000, 400_000
SIZE = 64  # pixels of a picture along each side
LEFT_OUT = 0.01  # of the pixels, those of the largest variance: single bright paths that both find by chance


@dataclass(frozen=True)
class MaterialRow:
    """`gather` beside `path` at as many samples, for one material."""

    name: str
    variance: float  # ours over path's, the mean over all pixels
    usual_variance: float  # the same without the LEFT_OUT pixels of either
    mean: float  # ours over path's, of the picture
    error: float  # standard error of that
    own_mean: float  # the same where the camera sees the material
    own_error: float


def color(*rgb: float) -> dict[str, Any]:
    """A colour for `mi.load_dict`."""
    return {"type": "rgb", "value": list(rgb)}


def bsdfs() -> dict[str, dict[str, Any]]:
    """The materials by name, for `mi.load_dict`."""
    wood = color(0.5, 0.3, 0.2)
    diffuse = {"type": "diffuse", "reflectance": wood}
    tilt = mi.Bitmap(np.tile(np.array([0.65, 0.5, 0.9], dtype=np.float32), (4, 4, 1)))
    height = 0.02 * np.sin(np.arange(64) / 64 * 8 * np.pi)
    waves = mi.Bitmap(np.tile(height.astype(np.float32)[None, :, None], (64, 1, 1)))

    def principled(**more: float) -> dict[str, Any]:
        return {"type": "principled", "base_color": wood} | more

    def plastic(alpha: float) -> dict[str, Any]:
        return {"type": "roughplastic", "diffuse_reflectance": wood, "alpha": alpha}

    def metal(alpha: float) -> dict[str, Any]:
        return {"type": "roughconductor", "alpha": alpha}

    one_sided = {
        "diffuse": diffuse,
        "plastic": {"type": "plastic", "diffuse_reflectance": wood},
        "pplastic": {"type": "pplastic", "diffuse_reflectance": wood},
        **{f"roughplastic, alpha {a}": plastic(a) for a in (0.05, 0.1, 0.3)},
        "conductor": {"type": "conductor", "material": "Al"},
        **{f"roughconductor, alpha {a}": metal(a) for a in (0.05, 0.2, 0.5)},
        **{f"principled, roughness {r}": principled(roughness=r) for r in (0.05, 0.1, 0.3, 0.5, 1.0)},
        **{f"principled metal, roughness {r}": principled(roughness=r, metallic=1.0) for r in (0.1, 0.5)},
        "principled, clearcoat": principled(roughness=0.5, clearcoat=1.0, clearcoat_gloss=0.9),
        "principled, sheen": principled(roughness=0.5, sheen=1.0),
        "blend of principled and its metal": {
            "type": "blendbsdf",
            "weight": 0.5,
            "a": principled(roughness=0.5),
            "b": principled(roughness=0.5, metallic=1.0),
        },
        "normal map over diffuse": {
            "type": "normalmap",
            "normalmap": {"type": "bitmap", "raw": True, "bitmap": tilt},
            "bsdf": diffuse,
        },
        "bump map over principled": {
            "type": "bumpmap",
            "bumpmap": {"type": "bitmap", "raw": True, "bitmap": waves},
            "bsdf": principled(roughness=0.3),
        },
    }
    transmitting = {
        "principled, spec_trans 0.7": principled(roughness=0.2, spec_trans=0.7),
        "principledthin, diff_trans 0.6": {"type": "principledthin", "base_color": wood, "diff_trans": 0.6},
        "mask, opacity 0.5": {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": diffuse}},
        "dielectric": {"type": "dielectric"},
        "thindielectric": {"type": "thindielectric"},
        "roughdielectric, alpha 0.2": {"type": "roughdielectric", "alpha": 0.2},
        "null": {"type": "null"},
    }
    return {name: {"type": "twosided", "bsdf": bsdf} for name, bsdf in one_sided.items()} | transmitting


def table_under_lamp(bsdf: dict[str, Any], side: float) -> "mi.Scene":
    """A table and a cube of a material under an area emitter of a ``side``, m, in a grey room of 2 m."""
    at = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = at().look_at([0, -0.95, 0.1], [0, 1, -0.6], [0, 0, 1])
    panel = at().translate([0.3, -0.2, 0.95]).rotate([1, 0, 0], 180).scale(side / 2)
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 60, "to_world": look, "film": film},
            "room": {
                "type": "cube",
                "flip_normals": True,
                "bsdf": {"type": "diffuse", "reflectance": color(*[0.5] * 3)},
            },
            "table": {"type": "rectangle", "to_world": at().translate([0, 0, -0.6]).scale(0.6), "bsdf": bsdf},
            "block": {
                "type": "cube",
                "to_world": at().translate([0.1, 0, -0.35]).rotate([0, 0, 1], 30).scale(0.2),
                "bsdf": bsdf,
            },
            "panel": {
                "type": "rectangle",
                "to_world": panel,
                "emitter": {"type": "area", "radiance": color(*[1.5 / side**2] * 3)},
            },
        },
        optimize=False,
    )


def measure(name: str, bsdf: dict[str, Any], side: float = 0.05) -> MaterialRow:
    """Compare pictures of one material; see `MaterialRow`."""
    scene, path = table_under_lamp(bsdf, side), mi.load_dict({"type": "path", "max_depth": -1})

    def pictures(seeds, picture):
        return np.array([np.array(picture(seed), dtype=np.float64)[..., :3] for seed in seeds])

    true = pictures(range(900, 900 + TRUE_SEEDS), lambda s: mi.render(scene, integrator=path, spp=TRUE_SPP, seed=s))
    theirs = pictures(range(SEEDS), lambda s: mi.render(scene, integrator=path, spp=SPP, seed=s))
    solutions = [solve(scene, elements=ELEMENTS, rays=RAYS, seed=seed) for seed in range(2)]
    ours = pictures(range(SEEDS), lambda s: solutions[0].render(spp=SPP, shading="gather", seed=s))
    more = pictures(range(SEEDS), lambda s: solutions[1].render(spp=SPP, shading="gather", seed=SEEDS + s))
    spread = [images.var(axis=0, ddof=1).mean(axis=-1).ravel() for images in (ours, theirs)]
    usual = [np.sort(v)[: int((1 - LEFT_OUT) * len(v))].mean() for v in spread]
    own = np.zeros((SIZE, SIZE), dtype=bool)
    own[SIZE // 2 :, SIZE // 4 : 3 * SIZE // 4] = True  # table and block only
    every = np.ones_like(own)
    means = []
    for where in (every, own):
        a, b = (images[:, where].mean(axis=(1, 2)) for images in (np.concatenate([ours, more]), true))
        error = np.hypot(a.std(ddof=1) / len(a) ** 0.5, b.std(ddof=1) / len(b) ** 0.5)
        means += [a.mean() / b.mean(), error / b.mean()]
    return MaterialRow(name, spread[0].mean() / spread[1].mean(), usual[0] / usual[1], *means)


def main(argv: Sequence[str] | None = None) -> None:
    """Print a table in Markdown."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="parts of names of materials (default: all)")
    parser.add_argument("--side", type=float, default=0.05, help="side of the emitter, m (default 0.05)")
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb")
    a = parser.parse_args(argv)
    mi.set_variant(a.mode)
    print("| material | variance, ours over `path`'s | without 1 % of the pixels | mean | mean of table and block |")
    print("|---|---|---|---|---|")
    for name, bsdf in bsdfs().items():
        if not a.names or any(part in name for part in a.names):
            row = measure(name, bsdf, a.side)
            means = f"{row.mean:.4f} ± {row.error:.4f} | {row.own_mean:.4f} ± {row.own_error:.4f}"
            print(f"| {name} | {row.variance:.2f} | {row.usual_variance:.2f} | {means} |", flush=True)


if __name__ == "__main__":
    main()
