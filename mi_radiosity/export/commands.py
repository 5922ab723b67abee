"""mi-radiosity export and view."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.console import progress_bars
from ..core.errors import RadiosityError
from ..core.files import check_outputs
from .commands_lightmap import bake, lightmap_arguments, refuse_without_lightmap
from .kept import load_kept


def add_export(commands: Any, solution_arguments: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add the commands; ``solution_arguments`` adds those that say which solution, and how its scene is loaded."""
    for run, files, text in (
        (
            _export,
            "OUT.ply|.glb|.xml|.exr",
            "write a kept solution as a mesh, a scene that shines by itself, a lightmap",
        ),
        (_view, "VIEW.html", "write a page to walk through a kept solution, offline"),
    ):
        parser = commands.add_parser(run.__name__.strip("_"), help=text)
        add = parser.add_argument
        solution_arguments(parser)
        add("-o", "--output", required=True, type=Path, metavar=files)
        add("--exposure", default="1", metavar="X|auto", help="what radiance is multiplied by for colours (default 1)")
        hides = "leave emitters out? (default: what the scene's integrator says)"
        add("--hide-emitters", action=argparse.BooleanOptionalAction, default=None, help=hides)
        if run is _export:
            lightmap_arguments(parser)
        parser.set_defaults(command=run)


def _export(arguments: argparse.Namespace) -> None:
    from .api import check_target, export
    from .tone import checked

    checked(arguments.exposure, arguments.output)
    check_outputs((arguments.output,), (arguments.scene, arguments.solution))
    if arguments.lightmap is not None:
        bake(arguments)
        return
    refuse_without_lightmap(arguments)
    check_target(arguments.output)
    solution = load_kept(arguments)
    with progress_bars() as report:
        written = export(solution, arguments.output, arguments.exposure, report, arguments.hide_emitters)
    for path in written:
        print(path)


def _view(arguments: argparse.Namespace) -> None:
    from .page import write_page
    from .tone import checked

    if arguments.output.suffix.lower() not in (".html", ".htm"):
        raise RadiosityError(f"-o {arguments.output}: choose a name that ends in .html")
    checked(arguments.exposure)
    check_outputs((arguments.output,), (arguments.scene, arguments.solution))
    solution = load_kept(arguments)
    with progress_bars() as report:
        write_page(solution, arguments.output, arguments.exposure, report, arguments.hide_emitters)
    print(arguments.output)
