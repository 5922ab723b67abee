"""mi-radiosity view-factors."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.console import integer, positive, progress_bars, warn
from ..core.errors import RadiosityError
from ..core.files import check_outputs

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def add_view_factors(commands: Any, scene_arguments: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add the command; ``scene_arguments`` adds those that say which scene and how it is loaded."""
    parser = commands.add_parser("view-factors", help="view factors between shapes or faces, as a sparse matrix")
    scene_arguments(parser)
    add = parser.add_argument
    files = "sparse matrix; beside .csv and .mtx, OUT_facets.csv names the facets"
    add("-o", "--output", required=True, type=Path, metavar="OUT.npz|.csv|.mtx", help=files)
    add("--level", default="face", metavar="shape|face", help="what has a row: shapes, or their faces (default face)")
    add("--rays", type=positive, metavar="N", help="rays from every row (default 1,024; 131,072 from shapes)")
    add("--up", default="z", metavar="x|y|z", help="axis towards the sky (default z); -x, -y, -z as --up=-z")
    add("--seed", type=integer, default=0, metavar="K", help="random seed (default 0)")
    parser.set_defaults(command=_view_factors)


def _view_factors(arguments: argparse.Namespace) -> None:
    """Compute, write, and print what closing has changed."""
    from ..scene import Model
    from ..transport import view_factors
    from .factors import check_factors_path, facets_path, write_factors

    check_factors_path(arguments.output)
    check_outputs((arguments.output, facets_path(arguments.output)), (arguments.scene,))
    up = _up(arguments.up)
    model = Model(arguments.file.load(), lit=False)
    warn(model.warnings)
    with progress_bars() as report:
        factors = view_factors(model, arguments.level, arguments.rays, seed=arguments.seed, up=up, progress=report)
        write_factors(factors, arguments.output, lambda done, total: report("write", done, total))
    c, s, (rows, columns) = factors.closure, factors.stats, factors.F.shape
    print(
        f"{rows:,} × {columns:,} view factors, {factors.F.nnz:,} not 0, {s['rays']:,} rays, {s['lines']:,} lines, "
        f"{s['seconds']:.1f} s\n"
        f"rows summed to 1 within {c.raw_row_error:.2g}, now within {c.row_error:.1g}; "
        f"entries changed by {c.mean:.2g} in the mean, {c.largest:.2g} at most"
    )
    if c.row_error > 1e-9:
        warn(["some rows do not sum to 1: more --rays may help"])


def _up(text):
    axis = AXES.get(text.lstrip("+-"))
    if axis is None:
        raise RadiosityError(f"--up {text}: choose one of x, y, z, or --up=-x and so on")
    return tuple(-x for x in axis) if text.startswith("-") else axis
