"""Error against wall time: ours, `path`, and `path` with a denoiser, measured in one run."""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.files import writing
from ..display import render
from ..scene import Model
from ..solver import solve
from .compare import cached_reference
from .metrics import compare
from .reference import path_image, versions
from .speed import measure

LADDER = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4)  # of the budgets given
PATH_SPP = (1, 4, 16, 64, 256, 1024)
VIEWS = 16
SWEEP = 45  # degrees the camera path turns through
NAMES = {"ours": "radiosity", "path": "path", "denoised": "path + Open Image Denoise"}


@dataclass
class Views:
    """Sensors with their references: one view, or a camera path."""

    sensors: list
    halves: list

    def error(self, images):
        """RMSE_a over all views, the references' noise removed, and with it."""
        errors = [compare(image, halves) for image, halves in zip(images, self.halves)]

        def mean(name):
            return float(np.mean([getattr(e, name) ** 2 for e in errors]) ** 0.5)

        return {
            "rmse_a": mean("rmse_a"),
            "rmse_a_clean": mean("rmse_a_clean"),
            "rel_mse": float(np.mean([e.rel_mse for e in errors])),
        }


def run_bench(
    path,
    output,
    *,
    elements=19_000,
    rays=2_684_000,
    view=0,
    reference_spp=1024,
    path_spp=PATH_SPP,
    views=VIEWS,
    runs=5,
    progress=lambda stage, done, total: None,
):
    """Write bench.json and error_time.png of a scene file into ``output``; returns the results (dict).

    Ours is solve + pictures for a ladder of budgets with kernels warm. ``path`` runs at 1…1024 samples
    per pixel; the denoiser, where mitsuba-oidn is installed, gets albedo and normals too. The camera
    path turns the first sensor about its place, at half the resolution and a quarter of the samples.
    """
    output = Path(output)
    scene = mi.load_file(str(path), optimize=False)
    model = Model(scene)
    reference, _ = cached_reference(model, scene, view, output, reference_spp, progress)
    one = Views([scene.sensors()[view]], [reference.halves()])
    results = {
        "scene": Path(path).name,
        "versions": versions(),
        "elements": elements,
        "rays": rays,
        "spp": reference_spp,
        "reference_noise": reference.noise(),
        "tracing": measure(path, elements, rays, runs),
    }
    results["one"] = _curves(model, scene, one, elements, rays, path_spp, "one view", progress)
    turning = _camera_path(scene, view, views)
    if turning:
        halves = []
        for number, sensor in enumerate(turning):
            halves.append(
                np.stack(
                    [
                        path_image(scene, sensor, max(reference_spp // 8, 1), seed=(1000 + number, 2000 + number)[half])
                        for half in range(2)
                    ]
                )
            )
            progress("references of the camera path", number + 1, len(turning))
        fewer = [s for s in path_spp if s <= max(path_spp[-1] // 16, path_spp[0])]
        results["many"] = _curves(
            model, scene, Views(turning, halves), elements, rays, fewer, f"{views} views", progress
        )
    for name in ("one", "many"):
        if name in results:
            results[name]["crossing"] = {
                other: crossing(results[name]["ours"], results[name][other])
                for other in ("path", "denoised")
                if other in results[name]
            }
    with writing(output / "bench.json") as temporary:
        Path(temporary).write_text(json.dumps(results, indent=1) + "\n")
    _plot(results, output / "error_time.png")
    return results


def _curves(model, scene, views, elements, rays, path_spp, stage, progress):
    """Measured points {"ours": [...], "path": [...], "denoised": [...]} for some views."""
    denoise = _denoiser()
    ladder = [(max(model.count, round(elements * f)), round(rays * f)) for f in LADDER]
    total = len(ladder) + len(path_spp) * (2 if denoise else 1)
    curves = {"ours": [], "path": []} | ({"denoised": []} if denoise else {})
    done = 0

    def note(curve, seconds, images, **more):
        nonlocal done
        curves[curve].append({"seconds": seconds, **more, **views.error(images)})
        done += 1
        progress(f"measuring {stage}", done, total)

    def pictures(solution):
        return [np.array(render(solution, s, spp=16))[..., :3] for s in views.sensors]

    pictures(solve(model, elements=ladder[0][0], rays=ladder[0][1]))  # compiles
    for n, r in ladder:
        start = _now()
        solution = solve(model, elements=n, rays=r)
        solved = _now()
        images = pictures(solution)
        note("ours", _now() - start, images, elements=solution.stats["elements"], rays=r, solve_seconds=solved - start)
    path_image(scene, views.sensors[0], 1)
    for spp in path_spp:
        start = _now()
        images = [path_image(scene, s, spp) for s in views.sensors]
        note("path", _now() - start, images, spp=spp)
    for spp in path_spp if denoise else ():
        denoise(scene, views.sensors[0], 1)
        start = _now()
        images = [denoise(scene, s, spp) for s in views.sensors]
        note("denoised", _now() - start, images, spp=spp)
    return curves


def _now():
    dr.sync_thread()
    return time.perf_counter()


def _denoiser():
    """denoise(scene, sensor, spp) with albedo and normals, or None where mitsuba-oidn is not installed."""
    try:
        import mitsuba_oidn
    except ImportError:
        return None

    def run(scene, sensor, spp):
        color = path_image(scene, sensor, spp)
        features = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"})
        planes = np.array(mi.render(scene, sensor=sensor, integrator=features, spp=min(spp, 16), seed=spp))
        albedo, normal = (
            np.ascontiguousarray(planes[..., -6 + 3 * k : planes.shape[2] - 3 + 3 * k], dtype=np.float32)
            for k in range(2)
        )
        return np.array(mitsuba_oidn.denoise(color, albedo=np.clip(albedo, 0, 1), normal=normal, hdr=True))

    return run


def _camera_path(scene, view, count):
    """``count`` sensors that turn about the place of a perspective sensor, at half its resolution ([] for others)."""
    sensor = scene.sensors()[view]
    if sensor.class_name() != "PerspectiveCamera":
        return []
    width, height = (max(int(n) // 2, 8) for n in sensor.film().crop_size())
    to_world = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    place, up = to_world[:3, 3], to_world[:3, 1]
    sensors = []
    for angle in np.linspace(-SWEEP / 2, SWEEP / 2, count):
        turn = mi.ScalarTransform4f().translate(place).rotate(up, angle).translate(-place)
        sensors.append(
            mi.load_dict(
                {
                    "type": "perspective",
                    "fov": float(mi.traverse(sensor)["x_fov"][0]),
                    "fov_axis": "x",
                    "to_world": turn @ mi.ScalarTransform4f(to_world),
                    "film": {
                        "type": "hdrfilm",
                        "width": width,
                        "height": height,
                        "pixel_format": "rgb",
                        "component_format": "float32",
                        "rfilter": {"type": "gaussian"},
                    },
                }
            )
        )
    return sensors


def crossing(ours, other):
    """Where another curve becomes better than ours, points joined by straight lines in log-log.

    {"seconds": time from which the other is better (None if never within the times both were
    measured), "rmse_a": the lowest error both reach, "ours_seconds", "other_seconds": when}.
    """

    def curve(points):
        error = np.minimum.accumulate([max(p["rmse_a_clean"], 1e-6) for p in points])
        return np.log([p["seconds"] for p in points]), np.log(error)

    (t, e), (u, f) = curve(ours), curve(other)
    times = np.linspace(max(t[0], u[0]), max(t[-1], u[-1]), 2000)
    behind = np.flatnonzero(np.interp(times, u, f) >= np.interp(times, t, e))
    first = behind[-1] + 1 if len(behind) else 0
    both = max(e[-1], f[-1])
    return {
        "seconds": math.exp(times[first]) if first < len(times) else None,
        "rmse_a": math.exp(both),
        "ours_seconds": math.exp(np.interp(-both, -e, t)),
        "other_seconds": math.exp(np.interp(-both, -f, u)),
    }


def _plot(results, file):
    from .report import _matplotlib, _png

    panels = [(name, title) for name, title in (("one", "one view"), ("many", f"{VIEWS} views")) if name in results]
    figure, axes = _matplotlib().subplots(
        1, len(panels), figsize=(6.5 * len(panels), 4.6), squeeze=False, layout="constrained"
    )
    for axis, (name, title) in zip(axes[0], panels):
        for curve, label in NAMES.items():
            if points := results[name].get(curve):
                axis.loglog([p["seconds"] for p in points], [p["rmse_a_clean"] for p in points], "o-", label=label)
        axis.set(
            title=f"{results['scene']}: {title}",
            xlabel="seconds (solve and render, kernels warm)",
            ylabel="RMSE_a (0…255), reference noise removed",
        )
        axis.grid(True, which="both", alpha=0.25)
        axis.legend()
    with writing(file) as temporary:
        Path(temporary).write_bytes(_png(figure))
