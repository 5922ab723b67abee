"""What commands share: warnings, progress bars, and the reading of numbers and views."""

import argparse
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import RadiosityError, RadiosityWarning
from .numbers import real_number, whole_number

if TYPE_CHECKING:
    import mitsuba as mi

PROGRAM = "mi-radiosity"
STAGES = {
    "refine": "Refining",
    "distribute": "Distributing power",
    "trace": "Tracing rays",
    "connect": "Connecting facets",
    "write": "Writing",
}

Report = Callable[[str, int, int | None], None]


def warn(messages: Iterable[str]) -> None:
    """Print warnings on standard error, a line each."""
    for message in messages:
        print(f"{PROGRAM}: warning: {message}", file=sys.stderr)


@contextmanager
def printed_warnings() -> Iterator[None]:
    """Print every RadiosityWarning of the body on standard error, a line each, as soon as it is issued."""
    before = warnings.showwarning

    def show(message: Any, category: type[Warning], *rest: Any, **more: Any) -> None:
        if issubclass(category, RadiosityWarning):
            warn([str(message)])
        else:
            before(message, category, *rest, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", RadiosityWarning)
        warnings.showwarning = show
        yield


def positive(text: str) -> int:
    """The whole number > 0 that an option is given, such as 20000 or 2e4."""
    return _checked(text, lambda: whole_number("", _number(text)), "a whole number greater than 0")


def integer(text: str) -> int:
    """The whole number that an option is given, such as a seed."""
    return _checked(text, lambda: whole_number("", _number(text), None), "a whole number")


def positive_number(text: str) -> float:
    """The number > 0 that an option is given."""
    return _checked(text, lambda: real_number("", _number(text), 0), "a number greater than 0")


def _number(text):
    """The int or float that a text stands for: an int where possible, because floats round large numbers."""
    try:
        return int(text)
    except ValueError:
        return float(text)


def _checked(text, convert, wanted):
    """What ``convert`` returns; the error of an option if the text is not ``wanted``."""
    try:
        return convert()
    except ValueError:  # RadiosityError is one of them
        raise argparse.ArgumentTypeError(f"'{text}' is not {wanted}") from None


def loading_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what says how a scene is loaded."""
    add = parser.add_argument
    add("-m", "--mode", default="llvm_ad_rgb", metavar="VARIANT", help="Mitsuba variant (default llvm_ad_rgb)")
    add(
        "-D",
        "--define",
        type=definition,
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="set a $KEY of the scene file",
    )
    add(
        "--plugin",
        action="append",
        default=[],
        metavar="MODULE|FILE.py",
        help="Python code that defines oracles or shaders of your own; may be repeated",
    )


def definition(text: str) -> tuple[str, str]:
    """The KEY and VALUE that an option is given."""
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise argparse.ArgumentTypeError(f"write '{text}' as KEY=VALUE")
    return key, value


def shading_argument(parser: argparse.ArgumentParser, default: str | None = "gouraud") -> None:
    """Add --shading; its name is checked when plugins have defined theirs. default: None if the scene may name it."""
    names = (
        f"gather, direct, gouraud, flat, mesh, lux or a plugin's (default {default or 'gather, or the scene says it'})"
    )
    parser.add_argument("--shading", default=default, metavar="NAME", help=names)


def view_name(path: Path, view: int, views: Sequence[int]) -> Path:
    """``path`` itself, or with the number of the view if there are several."""
    return path if len(views) == 1 else path.with_name(f"{path.stem}_{view}{path.suffix}")


def choose_views(scene: "mi.Scene", text: str) -> list[int]:
    """Sensor numbers meant by --view."""
    count = len(scene.sensors())
    if count == 0:
        raise RadiosityError("the scene has no sensor: add one to the file")
    if text == "all":
        return list(range(count))
    if not text.isdigit() or int(text) >= count:
        raise RadiosityError(
            f"--view {text}: the scene has {count} sensor{'s' * (count > 1)}, counted from 0; choose one or 'all'"
        )
    return [int(text)]


@contextmanager
def progress_bars() -> Iterator[Report]:
    """Yield report(stage, done, total), which draws one bar per stage on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:

        def report(stage, done, total):
            if stage not in tasks:
                tasks[stage] = progress.add_task(STAGES.get(stage, stage.capitalize()), total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield report
