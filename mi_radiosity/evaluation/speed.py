"""What a solve costs beside tracing its rays: `python -m mi_radiosity.evaluation.speed SCENE`."""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import drjit as dr
import mitsuba as mi

from ..scene import Model
from ..scene.rays import Rays
from ..solver import solve
from ..transport import Gathering
from .records import peak_megabytes
from .scenes import SceneFile, scene_file

FEW = 32  # entries of a kernel that may be for scalars
COLD = """
import json, sys, time
import mi_radiosity, mitsuba
from mi_radiosity.evaluation.scenes import scene_file
file, elements, rays = map(json.loads, sys.argv[1:])
scene = scene_file(**file).load(optimize=True)
start = time.perf_counter()
mi_radiosity.solve(scene, elements=elements, rays=rays)
print(time.perf_counter() - start)
"""


def main(argv: Sequence[str] | None = None) -> None:
    """Print the figures of one scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--elements", type=int, default=19_000)
    parser.add_argument("--rays", type=int, default=2_684_000)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb")
    parser.add_argument("-D", "--define", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--plugin", action="append", default=[], metavar="MODULE|FILE.py")
    a = parser.parse_args(argv)
    file = scene_file(a.scene, a.mode, {key: value for key, _, value in (d.partition("=") for d in a.define)}, a.plugin)
    for name, value in measure(file, a.elements, a.rays, a.runs).items():
        print(f"{name:>22}  {value:.4g}" if isinstance(value, float) else f"{name:>22}  {value}")


def measure(file: SceneFile, elements: int, rays: int, runs: int = 7) -> dict[str, Any]:
    """Time solves of a scene file against tracing the very same rays, in turn (seconds, medians).

    ``tracing`` is ray_intersect_preliminary and ray_test for the rays that carry power and those that
    feed the oracle, from arrays in memory. ``cold`` is the first solve of a process that finds no
    compiled kernel on disk. ``later_kernels`` counts what is compiled after a first solve, over other
    seeds and half and double the budgets.
    """
    scene = file.load(optimize=True)
    patches = solve(scene, elements=elements, rays=rays).stats["patches"]
    cold = _cold_seconds(file, elements, rays)
    compiled = _later_kernels(scene, max(patches, elements), patches, rays)
    memory = peak_megabytes()
    recorder, stats = record(scene, elements, rays)
    recorder.replay()
    solves, traces = [], []
    for _ in range(runs):
        solves.append(_clock(lambda: solve(scene, elements=elements, rays=rays)))
        traces.append(_clock(recorder.replay))
    return {name: stats[name] for name in ("elements", "pairs", "rays", "oracle_rays")} | {
        "cold_seconds": cold,
        "warm_seconds": statistics.median(solves),
        "tracing_seconds": statistics.median(traces),
        "solve_over_tracing": statistics.median(s / t for s, t in zip(solves, traces, strict=True)),
        "later_kernels": compiled,
        "peak_megabytes": memory,
    }


def _clock(work: Callable[[], Any]) -> float:
    """Seconds that ``work()`` takes."""
    dr.sync_thread()
    start = time.perf_counter()
    work()
    dr.sync_thread()
    return time.perf_counter() - start


def _cold_seconds(file: SceneFile, elements: int, rays: int) -> float:
    """Seconds of a first solve in a process of its own, with an empty kernel cache."""
    with tempfile.TemporaryDirectory() as cache:
        run = subprocess.run(
            [sys.executable, "-c", COLD, *map(json.dumps, (asdict(file), elements, rays))],
            env=os.environ | {"DRJIT_CACHE_DIR": cache},
            capture_output=True,
            text=True,
            check=True,
        )
    return float(run.stdout.split()[-1])


def _later_kernels(scene: "mi.Scene", elements: int, least: int, rays: int) -> int:
    """Kernels compiled by solves after a first one; not those for less than FEW entries, such as one pair and its
    lines: Dr.Jit has other kernels for scalars, of which not every solve has a case."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for seed, factor in ((1, 1), (2, 0.5), (3, 2)):
            solve(scene, elements=max(least, int(elements * factor)), rays=int(rays * factor), seed=seed)
        kernels = dr.kernel_history((dr.KernelType.JIT,))
        compiled = sum(not k["cache_hit"] and k["size"] >= FEW for k in kernels)
    dr.kernel_history_clear()
    return compiled


# ---- Recording -------------------------------------------------------------------------------------


class Recorder(Rays):
    """Keeps the rays it casts by what they are for: ``power``, ``oracle``, or nothing a solve is charged for.

    Rays are those traced to what they `meet`, and the lines of the kernel F. The only ones who ask for F between
    patches during a solve are oracles.
    """

    def __init__(self, rays: Rays):
        vars(self).update(vars(rays))
        self.queries: dict[str, list[Callable[[], Any]]] = {"power": [], "oracle": []}
        self.counts = dict.fromkeys(self.queries, 0)
        self.carrying, self._line_for = False, ""

    def meet(self, origin, direction, active=True):
        if self.carrying:
            ray = mi.Ray3f(origin, direction)
            self._keep("power", ray, active, lambda a: _hit(self.scene.ray_intersect_preliminary(ray, active=a)))
        return super().meet(origin, direction, active)

    def kernel(self, *points):
        self._line_for = "oracle"
        return super().kernel(*points)

    def kernel_at(self, *points):
        if self.carrying:
            self._line_for = "power"
        try:
            return super().kernel_at(*points)
        finally:
            self._line_for = ""

    def blocked(self, a, b, active=True):
        if self._line_for:
            ray = mi.Ray3f(a + self.patches.origin, b - a)
            ray.maxt = 1 - 1e-5
            self._keep(self._line_for, ray, active, lambda x: self.scene.ray_test(ray, active=x))
        return super().blocked(a, b, active)

    def _keep(self, purpose, ray, active, query):
        active = mi.Bool(active)
        dr.eval(ray, active)
        self.queries[purpose].append(lambda: query(active))
        self.counts[purpose] += dr.width(ray)

    def replay(self) -> None:
        """Trace the rays that were kept and nothing else."""
        for query in (*self.queries["power"], *self.queries["oracle"]):
            dr.eval(query())


def _hit(found):
    return found.prim_index, found.shape_index, found.prim_uv, found.t


class Carrying(Gathering):
    """The usual transport, telling a Recorder that rays carry power from now on; pilots were cast before."""

    def __call__(self, problem, *args, **kwargs):
        problem.model.rays.carrying = True
        return super().__call__(problem, *args, **kwargs)


def record(scene: "mi.Scene", elements: int, rays: int) -> tuple[Recorder, dict[str, Any]]:
    """A Recorder with the rays of one solve, and the solve's stats."""
    model = Model(scene)
    recorder = model.rays = Recorder(model.rays)
    return recorder, solve(model, elements=elements, rays=rays, transport=Carrying()).stats


if __name__ == "__main__":
    main()
