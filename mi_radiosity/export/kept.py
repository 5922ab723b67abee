"""Kept solutions and the scenes they belong to, as commands name them."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.console import warn
from ..core.errors import RadiosityError

if TYPE_CHECKING:  # imported where it is used, so that --help is quick
    from ..solver import Solution


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


def load_kept(arguments: argparse.Namespace) -> "Solution":
    """The solution that a command is given; its warnings go to standard error."""
    from ..solver import Solution

    solution = Solution.load(arguments.solution, arguments.file.load())
    warn([*solution.model.warnings, *solution.stats["warnings"]])
    return solution
