"""mi-radiosity measure: light at points, over a plane or a shape."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.console import integer, positive, positive_number, progress_bars
from ..core.errors import RadiosityError
from ..core.files import check_outputs
from .kept import load_kept

SAMPLES = 1024  # per point


def add_measure(commands: Any, solution_arguments: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add the command; ``solution_arguments`` adds those that say which solution, and how its scene is loaded."""
    parser = commands.add_parser("measure", help="light at points, over a plane or a shape: W/m² or lx")
    solution_arguments(parser)
    _arguments(parser)
    parser.set_defaults(command=_measure)


def _arguments(parser):
    add, where = parser.add_argument, parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--points", type=Path, metavar="FILE.csv", help="points with normals: x,y,z,nx,ny,nz")
    where.add_argument("--plane", metavar="z=0.8", help="a plane that faces +z, or -z=0.8 for one that faces -z")
    where.add_argument("--shape", metavar="NAME", help="the surfaces of a shape")
    add(
        "--spacing", type=positive_number, metavar="M", help="between points of a plane or shape (default: 20 along it)"
    )
    add("--lux", action="store_true", help="illuminance in lx instead of W/m² per channel")
    samples = f"lines to the lamps, and as many rays into the room, per point (default {SAMPLES})"
    add("--samples", type=positive, default=SAMPLES, metavar="N", help=samples)
    add("--seed", type=integer, default=0, metavar="K", help="random seed (default 0)")
    add("-o", "--output", type=Path, metavar="OUT.csv|.vtu|.png", help="numbers, a mesh, or a picture in false colours")


def _measure(arguments: argparse.Namespace) -> None:
    """Measure, write what was asked for, and print mean, least, most and uniformity."""
    from .grids import file_grid, plane_grid, shape_grid
    from .measure import check_output, measure, write_measurement

    if arguments.output:
        check_outputs((arguments.output,), (arguments.scene, arguments.solution, arguments.points))
        check_output(arguments.output, arguments.points is None)
    if arguments.points and arguments.spacing is not None:
        raise RadiosityError("--spacing belongs to --plane and --shape: points of a file are where they are")
    solution = load_kept(arguments)
    if arguments.points:
        grid = file_grid(arguments.points)
    elif arguments.plane:
        grid = plane_grid(solution.model, arguments.plane, arguments.spacing)
    else:
        grid = shape_grid(solution.model, arguments.shape, arguments.spacing)
    with progress_bars() as report:
        found = measure(solution, grid, arguments.lux, arguments.samples, arguments.seed, report)
    if arguments.output:
        write_measurement(arguments.output, found)
    print(_table(found))


def _table(found: Any) -> str:
    """Numbers of the points, as lines of text."""
    n, solid = len(found.values), int(found.solid.sum())
    lines = [f"{n:,} points" + (f", {solid:,} of them inside of solids" if solid else "")]
    lines.append(f"{found.unit:<14}" + "".join(f"{name:>12}" for name in found.channels))
    for name, values in found.summary().items():
        lines.append(f"{name:<14}" + "".join(f"{value:>12.4g}" for value in values))
    return "\n".join(lines)
