"""mi-radiosity export and view."""

import argparse
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import RadiosityError
from ..core.files import check_writable

if TYPE_CHECKING:  # imported where they are used, so that --help is quick
    from ..solver import Solution

Bars = Callable[[], AbstractContextManager[Callable[[str, int, int | None], None]]]


def add_commands(commands: Any, loading_arguments: Callable[[Any], None], bars: Bars) -> None:
    """Add the commands to a parser's; ``loading_arguments`` adds what says how a scene is loaded."""
    for run, files, text in (
        (_export, "OUT.ply|.glb|.xml", "write a kept solution as a mesh, or as a scene that shines by itself"),
        (_view, "VIEW.html", "write a page to walk through a kept solution, offline"),
    ):
        parser = commands.add_parser(run.__name__.strip("_"), help=text)
        add = parser.add_argument
        add("solution", type=Path, metavar="SOLUTION.npz", help="kept by render --save")
        add("-o", "--output", required=True, type=Path, metavar=files)
        add("--scene", type=Path, metavar="SCENE", help="the scene's file, if it is not where it was")
        add("--exposure", default="1", metavar="X|auto", help="what radiance is multiplied by for colours (default 1)")
        loading_arguments(parser)
        parser.set_defaults(command=run, mode=None, bars=bars)


def recall_scene(arguments: argparse.Namespace) -> None:
    """Complete the arguments of a command that reads a kept solution by what that says of its scene.

    Raises RadiosityError if it does not say it, or if the scene is gone.
    """
    if "solution" not in arguments:
        return
    from ..solver import Solution

    source = Solution.source_of(arguments.solution) or {}
    if arguments.scene is None:
        if not source:
            raise RadiosityError(
                f"{arguments.solution} does not say which scene it belongs to: name the file with --scene"
            )
        arguments.scene = Path(source["path"])
        beside = arguments.solution.parent / arguments.scene.name
        if not arguments.scene.is_file() and beside.is_file():
            arguments.scene = beside
        if not arguments.scene.is_file():
            raise RadiosityError(
                f"the scene {arguments.scene} of {arguments.solution} is gone: name the file with --scene"
            )
    arguments.mode = arguments.mode or source.get("variant", "llvm_ad_rgb")
    arguments.define = [*source.get("definitions", ()), *arguments.define]
    arguments.plugin = [*source.get("plugins", ()), *arguments.plugin]


def _export(arguments: argparse.Namespace) -> None:
    from .api import check_target, export
    from .tone import checked

    checked(arguments.exposure)
    check_target(arguments.output)
    solution = _load(arguments)
    with arguments.bars() as report:
        export(solution, arguments.output, arguments.exposure, report)
    print(arguments.output)


def _view(arguments: argparse.Namespace) -> None:
    from .page import write_page
    from .tone import checked

    if arguments.output.suffix.lower() not in (".html", ".htm"):
        raise RadiosityError(f"-o {arguments.output}: choose a name that ends in .html")
    checked(arguments.exposure)
    check_writable(arguments.output)
    solution = _load(arguments)
    with arguments.bars() as report:
        write_page(solution, arguments.output, arguments.exposure, report)
    print(arguments.output)


def _load(arguments: argparse.Namespace) -> "Solution":
    from ..solver import Solution

    solution = Solution.load(arguments.solution, arguments.file.load())
    for warning in solution.model.warnings:
        print(f"mi-radiosity: warning: {warning}", file=sys.stderr)
    return solution
