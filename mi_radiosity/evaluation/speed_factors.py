"""What view factors and relighting cost: `python -m mi_radiosity.evaluation.speed_factors SCENE`."""

import argparse
import statistics
import time
from collections.abc import Sequence
from typing import Any

from ..scene import Model
from ..solver import solve
from ..transport import ViewFactors, view_factors
from .records import peak_megabytes
from .scenes import SceneFile, scene_file
from .speed import Recorder, _clock


def main(argv: Sequence[str] | None = None) -> None:
    """Print the figures of one scene."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--elements", type=int, default=22_000, help="facets, leaves of a solution (default 22,000)")
    parser.add_argument("--rays", type=int, default=1024, help="rays per facet (default 1,024)")
    parser.add_argument("-m", "--mode", default="llvm_ad_rgb")
    a = parser.parse_args(argv)
    for name, value in measure(scene_file(a.scene, a.mode), a.elements, a.rays).items():
        print(f"{name:>22}  {value:.4g}" if isinstance(value, float) else f"{name:>22}  {value}")


def measure(file: SceneFile, elements: int, rays: int) -> dict[str, Any]:
    """Time view factors between the leaves of a mesh against tracing the very same rays and lines (seconds, once each,
    kernels warm), and lighting the solution anew (the median of ten)."""
    model = Model(file.load(optimize=False))
    solution = solve(model, elements=elements, rays=50 * elements, layers=True)
    solution.view_factors("leaf", rays=16)
    found: list[ViewFactors] = []
    before = time.process_time()
    seconds = _clock(lambda: found.append(solution.view_factors("leaf", rays=rays)))
    cpu = time.process_time() - before
    memory = peak_megabytes()
    factors = found.pop()
    figures = {"facets": len(factors.areas), "entries": factors.F.nnz} | {
        k: factors.stats[k] for k in ("rays", "lines")
    }
    figures |= {"row_error_before": factors.closure.raw_row_error, "row_error": factors.closure.row_error}
    del factors
    recorder = model.rays = Recorder(model.rays)
    recorder.carrying = True
    view_factors(model, "leaf", rays, elements=solution.elements)
    traced = _clock(recorder.replay)
    lamps = solution.stats["lamps"]
    scales: dict[str | int, Any] = dict.fromkeys(lamps, 0.5)
    relight = statistics.median(_clock(lambda: solution.relight(scales)) for _ in range(10))
    return figures | {
        "seconds": seconds,
        "cpu_seconds": cpu,
        "tracing_seconds": traced,
        "seconds_over_tracing": seconds / traced,
        "peak_megabytes": memory,
        "lamps": len(lamps),
        "relight_milliseconds": 1e3 * relight,
    }


if __name__ == "__main__":
    main()
