"""Error against wall time: ours, `path`, and `path` with a denoiser, measured in one run."""

import importlib.util
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.numbers import whole_number
from ..core.points import Stream, stream_seed
from ..display import SHADERS, CleanPicture, hides_emitters, linear_rgb
from ..display.pixels import AT_ONCE
from ..scene import Model
from ..solver import SOLVING_SHARE, solve
from . import require_extra
from .metrics import compare
from .plots import error_against_time
from .records import make_folder, write
from .reference import cached_reference, path_image, versions
from .scenes import scene_file
from .speed import measure

LADDER = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 2, 4)  # of the budgets given
PATH_SPP = (1, 4, 16, 64, 256, 1024)
VIEWS = 16
TIMES = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0)  # seconds of the shadings that sample
OUR_SPP = 16  # camera samples per pixel of our pictures
OURS = {"path": "ours", "denoised": "ours, denoised"}  # curves of ours, by what they are compared with
ROOM = 1.5  # times what sampling took, in which `path` may be denoised
SWEEP = 45  # degrees the camera path turns through


@dataclass(frozen=True)
class Views:
    """Sensors with their references: one view, or a camera path."""

    sensors: list["mi.Sensor"]
    halves: list[np.ndarray]

    def error(self, images: Iterable[np.ndarray]) -> dict[str, float]:
        """RMSE_a over all views, with the references' noise and without, and relMSE."""
        errors = [compare(image, halves) for image, halves in zip(images, self.halves, strict=True)]
        return {
            "rmse_a": float(np.mean([e.rmse_a**2 for e in errors]) ** 0.5),
            "rmse_a_clean": float(np.mean([e.rmse_a_clean**2 for e in errors]) ** 0.5),
            "rel_mse": float(np.mean([e.rel_mse for e in errors])),
        }


def run_bench(
    path: str | Path,
    output: str | Path,
    *,
    variant: str | None = None,
    definitions: Mapping[str, str] | None = None,
    plugins: Iterable[str] = (),
    elements: int = 19_000,
    rays: int = 2_684_000,
    view: int = 0,
    shading: str = "gouraud",
    reference_spp: int = 1024,
    path_spp: Sequence[int] = PATH_SPP,
    views: int = VIEWS,
    runs: int = 5,
    times: Sequence[float] = TIMES,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Write bench.json and error_time.png of a scene file into ``output``; returns the results.

    Ours is reading, solve and pictures, with kernels warm: for a ladder of budgets, or, in a shading that samples, of
    times, denoised and not, that goes on until ours is as good as ``path`` or takes as long. ``path`` runs at 1…1024
    samples per pixel; Open Image Denoise, where it is installed, gets box-filtered pixels or quarters of them, albedo
    and normals of both, and the film's filter comes afterwards. The camera path turns the sensor ``view`` about its
    place, at half the resolution and a quarter of the samples; there is none of other sensors than `perspective`.
    ``elements`` and ``rays`` are the middle of that ladder, and of one solve whose speed is told.
    """
    require_extra()
    elements, rays, view = whole_number("elements", elements), whole_number("rays", rays), whole_number("view", view, 0)
    reference_spp, views = whole_number("reference_spp", reference_spp), whole_number("views", views)
    path_spp, runs = [whole_number("path_spp", spp) for spp in path_spp], whole_number("runs", runs)
    output, file = Path(output), scene_file(path, variant, definitions, plugins)
    file.prepare()
    SHADERS.find(shading)
    make_folder(output)
    model = file.model()
    reference, _ = cached_reference(model, view, output, reference_spp, progress)
    results = {
        "scene": Path(path).name,
        "versions": versions(),
        "elements": elements,
        "rays": rays,
        "shading": shading,
        "spp": reference_spp,
        "reference_noise": reference.noise(),
        "tracing": measure(file, elements, rays, runs),
    }
    curves = partial(_curves, model, elements, rays, shading, times)
    one = Views([model.scene.sensors()[view]], [reference.halves()])
    results["one"] = curves(path_spp, one, partial(progress, "measuring one view"))
    many = _camera_path(model.scene, view, views, max(reference_spp // 8, 1), progress) if views > 1 else None
    if many:
        fewer = [s for s in path_spp if s <= max(path_spp[-1] // 4, path_spp[0])]
        results["many"] = curves(fewer, many, partial(progress, f"measuring {views} views"))
    results["views"] = views if many else 1
    write(output / "bench.json", json.dumps(results, indent=1) + "\n")
    write(output / "error_time.png", error_against_time(results))
    return results


# ---- Curves ----------------------------------------------------------------------------------------


def _curves(
    model: Model,
    elements: int,
    rays: int,
    shading: str,
    times: Sequence[float],
    path_spp: Sequence[int],
    views: Views,
    progress: Callable[[int, int], None],
) -> dict[str, Any]:
    """Measured points of every curve, and where the others cross ours."""
    scene, cleans = model.scene, _denoiser_is_there()
    tracers = {"path": path_image} | ({"denoised": _denoised_path} if cleans else {})
    traced, ours = {}, {}
    for curve, trace in tracers.items():  # of which `path` has one kernel for one sample per pixel and one for more
        few = CleanPicture.least if curve == "denoised" else 1
        attempts = [partial(_traced, trace, scene, spp) for spp in path_spp if spp >= few or spp == path_spp[-1]]
        traced[curve] = _points(attempts, 2, views, progress)
    if SHADERS.find(shading).samples:
        for curve in traced:
            attempt = partial(pictures_within, scene, shading, curve == "denoised")
            ours[OURS[curve]] = _within_times(attempt, times, traced[curve], views, progress)
    else:
        ladder = [(max(model.patches.count, round(elements * f)), round(rays * f)) for f in LADDER]
        ours["ours"] = _points([partial(_solved, scene, shading, *budget) for budget in ladder], -1, views, progress)
    crossings = {curve: crossing(ours.get(OURS[curve], ours["ours"]), points) for curve, points in traced.items()}
    return ours | traced | {"crossing": crossings}


def _within_times(attempt, times, other, views, progress):
    """Our points within ``times``, and twice and twice the last of them until the other's least error is reached, or
    its longest time."""
    times = list(times)
    points = _points([partial(attempt, seconds) for seconds in times], -1, views, progress)
    least, longest = (pick(p[name] for p in other) for pick, name in ((min, "rmse_a_clean"), (max, "seconds")))
    while points[-1]["rmse_a_clean"] > least and 2 * times[-1] <= longest:
        times.append(2 * times[-1])
        points += _points([partial(attempt, times[-1])], 0, views, progress)
    return points


def _points(attempts, first, views, progress):
    """Points of a curve, after its ``first`` attempts have compiled what they need."""
    for attempt in attempts[:first]:
        attempt(views.sensors)
    points = []
    for attempt in attempts:
        points.append(_timed(attempt, views))
        progress(len(points), len(attempts))
    return points


def _timed(attempt: Callable, views: Views) -> dict[str, Any]:
    """One point of a curve: seconds and errors of an attempt at pictures of the views."""
    start = now()
    images, more = attempt(views.sensors)
    return {"seconds": now() - start, **more, **views.error(images)}


def pictures_within(
    scene: "mi.Scene", shading: str, denoise: bool, seconds: float, sensors: "list[mi.Sensor]"
) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Our pictures after so many seconds in all, and what they are made of."""
    start, samples = now(), []
    solution = solve(scene, seconds=SOLVING_SHARE * seconds)
    more = {"elements": solution.stats["elements"], "rays": solution.stats["rays"], "solve_seconds": now() - start}
    images = []
    for number, sensor in enumerate(sensors):
        left, seen = max(seconds - (now() - start), 1e-3) / (len(sensors) - number), [0]
        picture = solution.render(sensor, shading=shading, denoise=denoise, seconds=left, show=partial(_note, seen))
        images.append(linear_rgb(picture, sensor.film()))
        samples.append(seen[-1])
    return images, more | {"spp": float(np.mean(samples))}


def _note(seen, image, samples):
    seen.append(samples)


def _solved(scene, shading, elements, rays, sensors):
    """Our pictures, and what the solution took."""
    start = now()
    solution = solve(scene, elements=elements, rays=rays)
    more = {"elements": solution.stats["elements"], "rays": rays, "solve_seconds": now() - start}
    return [linear_rgb(solution.render(s, spp=OUR_SPP, shading=shading), s.film()) for s in sensors], more


def _traced(trace, scene, spp, sensors):
    """Pictures by a path tracer."""
    return [trace(scene, sensor, spp) for sensor in sensors], {"spp": spp}


def now() -> float:
    """Seconds, when all that was asked of the device is done."""
    dr.sync_thread()
    return time.perf_counter()


def _denoiser_is_there() -> bool:
    return importlib.util.find_spec("mitsuba_oidn") is not None


def _denoised_path(scene, sensor, spp):
    """A picture by `path`, denoised as ours are."""
    integrator = mi.load_dict({"type": "path", "max_depth": -1, "hide_emitters": hides_emitters(scene)})

    def draw(pixel, index, total, before, seed):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(stream_seed(seed, Stream.PIXELS, AT_ONCE * index[0] + pixel[0]), dr.width(pixel))
        return sampler

    start = now()
    see = partial(scene.ray_intersect_preliminary, coherent=True)
    picture = CleanPicture(see, sensor, lambda points, ray, met: integrator.sample(scene, points, ray), spp, draw)
    picture.add(spp)  # all at once, so everywhere alike
    return linear_rgb(picture.image(picture.finishing(ROOM * (now() - start), spp)), sensor.film())


def crossing(ours: Sequence[Mapping[str, float]], other: Sequence[Mapping[str, float]]) -> dict[str, float | None]:
    """Where another curve becomes better than ours, points joined by straight lines in log-log.

    {"seconds": time from which the other is better (None if never in the time measured, each curve keeping its last
    error), "rmse_a": the lowest error both reach, "ours_seconds", "other_seconds": when}.
    """

    def curve(points):
        error = np.minimum.accumulate([max(p["rmse_a_clean"], 1e-6) for p in points])
        return np.log([p["seconds"] for p in points]), np.log(error)

    (t, e), (u, f) = curve(ours), curve(other)
    times = np.linspace(max(t[0], u[0]), max(t[-1], u[-1]), 2000)
    behind = np.flatnonzero(np.interp(times, u, f) >= np.interp(times, t, e))
    first = int(behind[-1]) + 1 if len(behind) else 0
    both = max(e[-1], f[-1])
    return {
        "seconds": math.exp(times[first]) if first < len(times) else None,
        "rmse_a": math.exp(both),
        "ours_seconds": math.exp(np.interp(-both, -e, t)),
        "other_seconds": math.exp(np.interp(-both, -f, u)),
    }


# ---- Camera path -----------------------------------------------------------------------------------


def _camera_path(
    scene: "mi.Scene", view: int, count: int, spp: int, progress: Callable[[str, int, int], None]
) -> Views | None:
    """Views of a perspective sensor that turns about its place, with two halves of ``spp`` samples each."""
    sensor = scene.sensors()[view]
    if sensor.class_name() != "PerspectiveCamera":
        return None
    sensors = [_turned(sensor, angle) for angle in np.linspace(-SWEEP / 2, SWEEP / 2, count)]
    halves = []
    for number, turned in enumerate(sensors):
        halves.append(np.stack([path_image(scene, turned, spp, seed=start + number) for start in (1000, 2000)]))
        progress("references of the camera path", number + 1, count)
    return Views(sensors, halves)


def _turned(sensor: "mi.Sensor", angle: float) -> "mi.Sensor":
    """A perspective sensor at half its resolution, turned by ``angle`` degrees about its own up direction."""
    to_world = np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4)
    place, up = to_world[:3, 3], to_world[:3, 1]
    turn = mi.ScalarTransform4f().translate(place).rotate(up, angle).translate(-place)
    old, values = sensor.film(), dict(mi.traverse(sensor))
    film: dict[str, Any] = {"type": "hdrfilm", "pixel_format": "rgb", "component_format": "float32"}
    for axis, length in enumerate(("width", "height")):
        film[length] = max(int(old.size()[axis]) // 2, 8)
        film[f"crop_{length}"] = min(max(int(old.crop_size()[axis]) // 2, 8), film[length])
        offset = int(old.crop_offset()[axis]) // 2
        film[f"crop_offset_{'xy'[axis]}"] = min(offset, film[length] - film[f"crop_{length}"])
    offsets = {name: float(values[name][0]) for name in ("principal_point_offset_x", "principal_point_offset_y")}
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": float(values["x_fov"][0]),
            "fov_axis": "x",
            "to_world": turn @ mi.ScalarTransform4f(to_world),
            "film": film | {"rfilter": {"type": "gaussian"}},
        }
        | offsets
    )
