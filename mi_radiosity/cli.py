"""mi-radiosity: the command line."""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .core.console import (
    PROGRAM,
    Report,
    choose_views,
    integer,
    loading_arguments,
    positive,
    positive_number,
    printed_warnings,
    progress_bars,
    shading_argument,
    view_name,
    warn,
)
from .core.errors import RadiosityError, interruptible
from .core.files import check_outputs, writing
from .evaluation.commands import add_evaluation
from .export.commands import add_export
from .export.commands_factors import add_view_factors
from .export.commands_measure import add_measure
from .export.kept import recall_scene

if TYPE_CHECKING:  # imported where they are used, so that --help is quick
    import mitsuba as mi

    from .scene.report import Report as SceneReport
    from .solver import Solution
    from .solver.cost import Cost

SOLVING = ("oracle", "alpha", "elements", "epsilon", "rays", "lines", "seed", "layers")


class Parser(argparse.ArgumentParser):
    """A parser whose errors are ours."""

    def error(self, message):
        raise RadiosityError(f"{message}; see `{self.prog} --help`")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status: 0, 2 for what the user can mend, 130 after Ctrl-C, 141 if the
    reader of standard output has ended."""
    try:
        arguments = _parser().parse_args(argv)
        with interruptible(), printed_warnings():
            _prepare(arguments)
            arguments.command(arguments)
        return 0
    except RadiosityError as error:
        print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of standard output, such as `head`, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that Python's own flush does not fail, too
        return 141
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted; finished files are whole, unfinished ones were not written", file=sys.stderr)
        return 130


def _parser() -> Parser:
    parser = Parser(prog=PROGRAM, description="Hierarchical Monte Carlo radiosity for Mitsuba 3 scenes.")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for add, run, text in (
        (_render_arguments, _render, "solve a scene and write pictures of it"),
        (lambda parser: None, _info, "say what of a scene would be modelled, what not and why"),
    ):
        command = commands.add_parser(run.__name__.strip("_"), help=text)
        _scene_arguments(command)
        add(command)
        command.set_defaults(command=run)
    add_evaluation(commands, _scene_arguments)
    add_view_factors(commands, _scene_arguments)
    add_measure(commands, _solution_arguments)
    add_export(commands, _solution_arguments)
    return parser


# ---- Arguments -------------------------------------------------------------------------------------
# Names of oracles and shaders are checked after parsing, when plugins have defined theirs.


def _scene_arguments(parser):
    parser.add_argument("scene", type=Path, metavar="SCENE", help="Mitsuba XML file")
    loading_arguments(parser)


def _solution_arguments(parser):
    parser.add_argument("solution", type=Path, metavar="SOLUTION.npz", help="what render --save has kept")
    parser.add_argument("--scene", type=Path, metavar="SCENE", help="the scene's file, if it is not where it was")
    loading_arguments(parser)
    parser.set_defaults(mode=None)  # as it was kept


def _render_arguments(parser):
    add, names = parser.add_argument, "picture; with several views the view's number is added to the name"
    add("-o", "--output", required=True, type=Path, metavar="OUT.exr|.png", help=names)
    _solve_arguments(parser.add_argument_group("solution"))
    add("--view", default="0", metavar="K|all", help="sensor number, or all (default 0)")
    add("--spp", type=positive, metavar="N", help="camera samples per pixel (default 64)")
    within = "as good as it gets in T seconds, solve and pictures together; the file gets better all the time"
    add("--seconds", type=positive_number, metavar="T", help=within)
    shading_argument(parser, None)
    hides = "are emitters and the sky invisible to the camera? (default: what the scene's integrator says)"
    add("--hide-emitters", action=argparse.BooleanOptionalAction, default=None, help=hides)
    add("--denoise", action="store_true", help="remove noise; of 4 samples at least (needs mi_radiosity[denoise])")
    add("--save", type=Path, metavar="SOLUTION.npz", help="keep the solution")
    add("--load", type=Path, metavar="SOLUTION.npz", help="show a kept solution instead of solving")
    add("--stats", type=Path, metavar="STATS.json", help="write the numbers of the run")


def _solve_arguments(group):
    add = group.add_argument
    add(
        "--oracle",
        metavar="NAME[:PARAMETER]",
        help="ks, mi, gmi, power, uniform or a plugin's, such as gmi:0.75 (default gmi)",
    )
    add("--alpha", type=positive_number, metavar="A", help="entropic index of gmi, greater than 0 (default 0.5)")
    wanted = "elements wanted, fewer than faces too (default: 19,000 more than the patches, 114,000 at most)"
    add("--elements", type=positive, metavar="N", help=wanted)
    add("--epsilon", type=positive_number, metavar="E", help="the oracle's threshold, instead of --elements")
    rays = "rays in all that carry power and gather it (default: 300 for each of 19,000 elements, 20 for each of all, "
    rays += "twice as many with lamps like the sun)"
    add("--rays", type=positive, metavar="N", help=rays)
    add("--lines", type=positive, metavar="S", help="random lines per pair (default 10)")
    add("--seed", type=integer, metavar="K", help="random seed (default 0)")
    layers = "keep the light of every lamp by itself, to dim and colour it later: see view"
    add("--layers", action="store_true", default=None, help=layers)


# ---- Commands --------------------------------------------------------------------------------------


def _render(arguments: argparse.Namespace) -> None:
    from .display import SHADERS, Shader, require_denoiser, solve_options, unmodelled, write_image
    from .solver import SOLVING_SHARE

    options = _solve_options(arguments)
    if arguments.denoise:
        require_denoiser()
    check_outputs((arguments.output, arguments.save, arguments.stats), (arguments.scene, arguments.load))
    scene = arguments.file.load()
    views = choose_views(scene, arguments.view)
    warn(unmodelled(scene))
    named, shading = solve_options(scene)
    arguments.shading = arguments.shading or shading or "gather"
    options = _merged(named, options)
    with progress_bars() as report:
        start = time.perf_counter()
        if arguments.seconds and not arguments.load:
            options["seconds"] = SOLVING_SHARE * arguments.seconds
        solution = _solution(arguments, scene, options, report)
        _keep(arguments, solution)
        for number, view in enumerate(views):
            report("render", number, len(views))
            path = view_name(arguments.output, view, views)
            if arguments.seconds:
                left = max(arguments.seconds - (time.perf_counter() - start), 1e-3) / (len(views) - number)
                _grow(arguments, solution, view, path, left)
            else:
                how = {"denoise": arguments.denoise, "hide_emitters": arguments.hide_emitters}
                image = solution.render(view, arguments.spp or 64, arguments.shading, **how)
                write_image(path, image, solution.stats, scene.sensors()[view].film())
            report("render", number + 1, len(views))
    shader: type[Shader] = SHADERS.find(arguments.shading)
    if legend := shader.legend(solution):
        print(legend)
    s = solution.stats
    print(
        f"{s['elements']:,} elements, {s['pairs']:,} pairs, {s['rays']:,} rays, {s['oracle_rays']:,} oracle rays, "
        f"{'loaded' if arguments.load else format(s['seconds']['total'], '.2f') + ' s'}"
    )


def _grow(arguments: argparse.Namespace, solution: "Solution", view: int, path: Path, seconds: float) -> None:
    """Write ever better pictures of a view; the last one stays, whenever it ends."""
    from .display import write_image

    start, shown, taken, least = time.perf_counter(), 0, 0, 0.0
    film = solution.model.scene.sensors()[view].film()

    def show(image: "Callable[[], mi.TensorXf]", samples: int) -> None:
        nonlocal shown, least, taken
        now, taken = time.perf_counter() - start, samples
        if now >= least:
            before = time.perf_counter()
            write_image(path, image(), solution.stats | {"spp": samples}, film)
            shown, least = samples, now + 20 * (time.perf_counter() - before)

    try:
        with interruptible():
            image = solution.render(
                view,
                shading=arguments.shading,
                denoise=arguments.denoise,
                seconds=seconds,
                show=show,
                hide_emitters=arguments.hide_emitters,
            )
        write_image(path, image, solution.stats | {"spp": taken}, film)
    except KeyboardInterrupt:
        if shown:
            warn([f"interrupted: {path} has {shown} samples per pixel"])
        raise


def _solve_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """What `solve` is asked for; names and combinations are checked here, before anything takes time."""
    from .oracles import make_oracle

    if arguments.output.suffix.lower() not in (".exr", ".png"):
        raise RadiosityError(f"-o {arguments.output}: choose a name that ends in .exr or .png")
    options = {name: value for name in SOLVING if (value := getattr(arguments, name)) is not None}
    if arguments.seconds and arguments.spp:
        raise RadiosityError("give either --spp or --seconds, not both")
    if arguments.load and options:
        raise RadiosityError(f"--load shows a finished solution: leave out --{next(iter(options))}")
    if {"oracle", "alpha"} & set(options):
        options["oracle"] = make_oracle(options.pop("oracle", "gmi"), options.pop("alpha", None))
    return options


def _merged(named: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """Options of `solve`: those that the scene's integrator names, and in their place those of the command line."""
    exclusive = {"elements", "epsilon"}  # `solve` takes one of the two
    kept = {k: v for k, v in named.items() if k not in exclusive or not exclusive & set(given)}
    return kept | given


def _solution(arguments: argparse.Namespace, scene: "mi.Scene", options: dict[str, Any], report: Report) -> "Solution":
    """The solution of a scene, loaded or solved now, with its warnings on standard error."""
    from .solver import Solution, solve

    solution = Solution.load(arguments.load, scene) if arguments.load else solve(scene, **options, progress=report)
    warn([*solution.model.warnings, *solution.stats["warnings"]])
    return solution


def _keep(arguments: argparse.Namespace, solution: "Solution") -> None:
    """Write what was asked for beside pictures."""
    if arguments.save:
        solution.save(arguments.save, asdict(arguments.file))
    if arguments.stats:
        with writing(arguments.stats) as temporary:
            Path(temporary).write_text(json.dumps(solution.stats, indent=2) + "\n")


def _info(arguments: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.table import Table

    from .display import hides_emitters, unmodelled
    from .scene.report import report
    from .solver.cost import estimate_cost

    scene = arguments.file.load()
    console = Console()
    found = report(scene)
    shapes = Table("shape", "class", "faces", "fronts", "backs", "BSDF", "it is", title=str(arguments.scene))
    for row in found.shapes:
        counts = ("?" if n is None else f"{n:,}" for n in (row.faces, row.fronts, row.backs))
        shapes.add_row(row.name, row.kind, *counts, row.bsdf, row.treatment)
    lamps = Table("lamp", "class", "power, W", "it is")
    for lamp in found.lamps:
        power = "?" if lamp.power is None else ", ".join(f"{p:.4g}" for p in lamp.power)
        lamps.add_row(lamp.name, lamp.kind, power, lamp.treatment)
    facts = Table(show_header=False)
    if hides_emitters(scene):
        facts.add_row("pictures", "show no emitters: the scene's integrator hides them")
    for line in unmodelled(scene):
        facts.add_row("warning", line)
    for name, value in [*_facts(scene, found), *_costs(estimate_cost(found.model) if found.model else None)]:
        facts.add_row(name, value)
    for table in (shapes, lamps, facts):
        console.print(table)


def _facts(scene: "mi.Scene", found: "SceneReport") -> Iterator[tuple[str, str]]:
    """What there is to know of a scene before it is solved."""
    yield "sensors", f"{len(scene.sensors())}"
    for refused in found.refused or ["nothing: the whole scene is modelled"]:
        yield "refused", refused
    if model := found.model:
        fronts = int((model.patches.sides % 2 == 0).sum())
        backs = model.patches.count - fronts
        yield "faces", f"{len(model.faces.shape):,}"
        yield "patches", f"{model.patches.count:,} ({fronts:,} fronts, {backs:,} backs)"
        yield "sides no light reaches", f"{model.unreached:,}, left out"
        yield "area of patches", f"{model.patches.total_area:.6g}"
        for warning in model.warnings:
            yield "warning", warning


def _costs(cost: "Cost | None") -> Iterator[tuple[str, str]]:
    """What a solve by default costs."""
    if cost:
        yield "elements by default", f"{cost.elements:,}"
        yield "rays by default", f"{cost.rays:,}"
        yield "memory, about", f"{cost.memory / 2**20:,.0f} MiB"
        yield "time here, about", f"{cost.seconds:.0f} s" if cost.seconds > 1 else "a second"


# ---- What commands share ---------------------------------------------------------------------------


def _prepare(arguments: argparse.Namespace) -> None:
    """Choose the variant, load plugins, and check the names they may have added to."""
    import mitsuba as mi

    from .display import SHADERS
    from .evaluation.scenes import scene_file

    mi.set_log_level(mi.LogLevel.Error)
    recall_scene(arguments)
    path = arguments.scene[0] if isinstance(arguments.scene, list) else arguments.scene
    arguments.file = scene_file(path, arguments.mode, dict(arguments.define), arguments.plugin)
    arguments.file.prepare()
    if getattr(arguments, "shading", None) is not None:
        SHADERS.find(arguments.shading)
