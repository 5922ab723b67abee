"""What a solve costs beside tracing its rays: `python -m mi_radiosity.evaluation.speed SCENE`."""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time

import drjit as dr
import mitsuba as mi

from ..scene import Model
from ..solver import solve

COLD = """
import sys, time
import mi_radiosity, mitsuba as mi
path, variant, elements, rays = sys.argv[1:]
mi.set_variant(variant)
scene = mi.load_file(path)
start = time.perf_counter()
mi_radiosity.solve(scene, elements=int(elements), rays=int(rays))
print(time.perf_counter() - start)
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--elements", type=int, default=19_000)
    parser.add_argument("--rays", type=int, default=2_684_000)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb")
    arguments = parser.parse_args()
    mi.set_variant(arguments.mode)
    for name, value in measure(arguments.scene, arguments.elements, arguments.rays, arguments.runs).items():
        print(f"{name:>22}  {value:.4g}" if isinstance(value, float) else f"{name:>22}  {value}")


def measure(path, elements, rays, runs=7):
    """Time solves of a scene file against tracing the very same rays, in turn (dict; seconds, medians).

    ``tracing`` is ray_intersect_preliminary for the rays that carry power and ray_test for those
    that feed the oracle, from arrays in memory. ``cold`` is the first solve of a process that finds
    no compiled kernel on disk. ``later_kernels`` counts what is compiled after a first solve, over
    other seeds and half and double the budgets.
    """
    cold = _cold_seconds(path, elements, rays)
    scene = mi.load_file(str(path))
    patches = solve(scene, elements=elements, rays=rays).stats["patches"]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for seed, factor in ((1, 1), (2, 0.5), (3, 2)):
            solve(scene, elements=max(patches, int(elements * factor)), rays=int(rays * factor), seed=seed)
        compiled = sum(not k["cache_hit"] for k in dr.kernel_history((dr.KernelType.JIT,)))
    dr.kernel_history_clear()
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    model = _recording_model(scene)
    stats = solve(model, elements=elements, rays=rays).stats
    carried, left = [], stats["rays"]
    for ray in reversed(model.power_rays):  # the pilots' rays came first
        if left <= 0:
            break
        carried.append(ray)
        left -= dr.width(ray.o)
    solves, traces = [], []
    _clock(lambda: _trace(model, carried))
    for _ in range(runs):
        solves.append(_clock(lambda: solve(scene, elements=elements, rays=rays))[0])
        traces.append(_clock(lambda: _trace(model, carried))[0])
    ratio = statistics.median(s / t for s, t in zip(solves, traces))
    return {
        "elements": stats["elements"],
        "pairs": stats["pairs"],
        "rays": stats["rays"],
        "oracle_rays": stats["oracle_rays"],
        "cold_seconds": cold,
        "warm_seconds": statistics.median(solves),
        "tracing_seconds": statistics.median(traces),
        "solve_over_tracing": ratio,
        "later_kernels": compiled,
        "peak_megabytes": memory,
    }


def _clock(work):
    """Seconds that ``work()`` takes, and its result."""
    dr.sync_thread()
    start = time.perf_counter()
    result = work()
    dr.sync_thread()
    return time.perf_counter() - start, result


def _cold_seconds(path, elements, rays):
    """Seconds of a first solve in a process of its own, with an empty kernel cache."""
    with tempfile.TemporaryDirectory() as cache:
        run = subprocess.run(
            [sys.executable, "-c", COLD, str(path), mi.variant(), str(elements), str(rays)],
            env=os.environ | {"DRJIT_CACHE_DIR": cache},
            capture_output=True,
            text=True,
            check=True,
        )
    return float(run.stdout)


def _recording_model(scene):
    """A Model that keeps the rays it casts."""

    class Recorder(Model):
        def trace(self, origin, direction, active=True):
            self.power_rays.append(mi.Ray3f(origin, direction))
            return super().trace(origin, direction, active)

        def blocked(self, a, b, active):
            self.oracle_rays.append((mi.Point3f(a), mi.Point3f(b), active))
            return super().blocked(a, b, active)

    Recorder.power_rays, Recorder.oracle_rays = [], []
    model = Recorder(scene)
    Recorder.power_rays, Recorder.oracle_rays = [], []
    return model


def _trace(model, carried):
    """Trace recorded rays and nothing else."""
    for ray in carried:
        hit = model.tracing.ray_intersect_preliminary(ray)
        dr.eval(hit.prim_index, hit.shape_index, hit.prim_uv, hit.t)
    for line in model.oracle_rays:
        dr.eval(Model.blocked(model, *line))


if __name__ == "__main__":
    main()
