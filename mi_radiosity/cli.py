"""mi-radiosity: the command line."""

import argparse
import json
import sys
from contextlib import contextmanager
from pathlib import Path

from .core.errors import RadiosityError, interruptible
from .core.files import check_writable, writing

PROGRAM = "mi-radiosity"
STAGES = {"refine": "Refining", "distribute": "Distributing power"}


class Parser(argparse.ArgumentParser):
    def error(self, message):
        raise RadiosityError(f"{message}; see `{self.prog} --help`")


def main(argv=None):
    """Run one command; returns the exit status: 0, 2 for what the user can mend, 130 after Ctrl-C."""
    try:
        arguments = _parser().parse_args(argv)
        with interruptible():
            return arguments.command(arguments) or 0
    except RadiosityError as error:
        print(f"{PROGRAM}: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{PROGRAM}: interrupted; finished files are whole, unfinished ones were not written", file=sys.stderr)
        return 130


def _parser():
    parser = Parser(prog=PROGRAM, description="Hierarchical Monte Carlo radiosity for Mitsuba 3 scenes.")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    render = commands.add_parser("render", help="solve a scene and write pictures of it")
    _scene_arguments(render)
    render.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="OUT.exr|.png",
        help="picture; with several views the view's number is added to the name",
    )
    _solve_arguments(render)
    render.add_argument("--view", default="0", metavar="K|all", help="sensor number, or all (default 0)")
    render.add_argument("--spp", type=_positive, default=64, metavar="N", help="camera samples per pixel (default 64)")
    render.add_argument("--shading", choices=("gouraud", "flat", "mesh"), default="gouraud")
    render.add_argument("--save", type=Path, metavar="SOLUTION.npz", help="keep the solution")
    render.add_argument("--load", type=Path, metavar="SOLUTION.npz", help="show a kept solution instead of solving")
    render.add_argument("--stats", type=Path, metavar="STATS.json", help="write the numbers of the run")
    render.set_defaults(command=_render)

    reference = commands.add_parser("reference", help="path-trace a reference; resumes, never starts over")
    _scene_arguments(reference)
    reference.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="REF.exr",
        help="with several views the view's number is added to the name",
    )
    reference.add_argument(
        "--spp", type=_positive, default=1024, metavar="N", help="samples per pixel in all (default 1024)"
    )
    reference.add_argument("--view", default="0", metavar="K|all")
    reference.add_argument("--seed", type=int, default=0, metavar="K")
    reference.set_defaults(command=_reference)

    compare = commands.add_parser("compare", help="compare oracles: error beside cost, against a path-traced reference")
    _scene_arguments(compare)
    compare.add_argument(
        "-o",
        "--output",
        required=True,
        type=Path,
        metavar="DIR",
        help="table.md, results.json, figure.png, report.html; an interrupted run goes on",
    )
    compare.add_argument(
        "--oracles",
        default=None,
        metavar="LIST",
        help="such as ks,gmi:1.5,mi,gmi:0.5 (default: the rows of the paper's table 1)",
    )
    compare.add_argument("--elements", type=_positive, default=19_000, metavar="N")
    compare.add_argument("--rays", type=_positive, default=2_684_000, metavar="N")
    compare.add_argument("--lines", type=_positive, default=10, metavar="S")
    compare.add_argument("--seeds", type=_positive, default=5, metavar="N", help="repetitions (default 5)")
    compare.add_argument("--view", default="all", metavar="K|all")
    compare.add_argument(
        "--spp", type=_positive, default=64, metavar="N", help="camera samples per pixel of our pictures (default 64)"
    )
    compare.add_argument("--reference-spp", type=_positive, default=1024, metavar="N")
    compare.add_argument(
        "--questions",
        default="mesh,rays,time,noise",
        metavar="LIST",
        help="which budgets are equal: mesh, rays, time; noise splits the error",
    )
    compare.add_argument(
        "--scheduler", metavar="ADDRESS", help="run on the Dask cluster there (needs mi_radiosity[dask])"
    )
    compare.set_defaults(command=_compare)

    bench = commands.add_parser("bench", help="error against time: ours, path, and path with a denoiser")
    _scene_arguments(bench)
    bench.add_argument("-o", "--output", required=True, type=Path, metavar="DIR", help="bench.json and error_time.png")
    bench.add_argument(
        "--elements", type=_positive, default=19_000, metavar="N", help="middle of the ladder of budgets"
    )
    bench.add_argument("--rays", type=_positive, default=2_684_000, metavar="N")
    bench.add_argument("--view", default="0", metavar="K")
    bench.add_argument("--views", type=_positive, default=16, metavar="N", help="views of the camera path (default 16)")
    bench.add_argument("--reference-spp", type=_positive, default=1024, metavar="N")
    bench.add_argument(
        "--path-spp", type=_positive, default=1024, metavar="N", help="most samples per pixel of path (default 1024)"
    )
    bench.set_defaults(command=_bench)

    info = commands.add_parser("info", help="say what of a scene would be modelled, what not and why")
    _scene_arguments(info)
    info.set_defaults(command=_info)
    return parser


def _scene_arguments(parser):
    parser.add_argument("scene", type=Path, metavar="SCENE", help="Mitsuba XML file")
    parser.add_argument(
        "-m", "--mode", default="llvm_ad_rgb", metavar="VARIANT", help="Mitsuba variant (default llvm_ad_rgb)"
    )
    parser.add_argument(
        "-D", "--define", action="append", default=[], metavar="KEY=VALUE", help="set a $KEY of the scene file"
    )


def _solve_arguments(parser):
    group = parser.add_argument_group("solution")
    group.add_argument("--oracle", metavar="NAME", help="ks, mi, gmi, power or uniform (default gmi)")
    group.add_argument("--alpha", type=float, metavar="A", help="entropic index of gmi, greater than 0 (default 0.5)")
    group.add_argument(
        "--elements",
        type=_positive,
        metavar="N",
        help="leaf elements wanted (default: 19,000 more than the patches, or twice those)",
    )
    group.add_argument("--epsilon", type=float, metavar="E", help="the oracle's threshold, instead of --elements")
    group.add_argument("--rays", type=_positive, metavar="N", help="rays that carry power (default: 300 per element)")
    group.add_argument("--lines", type=_positive, metavar="S", help="random lines per pair (default 10)")
    group.add_argument("--seed", type=int, metavar="K", help="random seed (default 0)")


def _positive(text):
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value <= 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number greater than 0")
    return value


# ---- Commands --------------------------------------------------------------------------------------


def _render(arguments):
    from .display import render, write_image
    from .oracles import make_oracle
    from .solver import Solution, solve

    output = arguments.output
    if output.suffix.lower() not in (".exr", ".png"):
        raise RadiosityError(f"-o {output}: choose a name that ends in .exr or .png")
    solving = {
        name: value
        for name in ("oracle", "alpha", "elements", "epsilon", "rays", "lines", "seed")
        if (value := getattr(arguments, name)) is not None
    }
    if arguments.load and solving:
        raise RadiosityError(f"--load shows a finished solution: leave out --{next(iter(solving))}")
    solving["oracle"] = make_oracle(solving.pop("oracle", "gmi"), solving.pop("alpha", None))
    for path in filter(None, (output, arguments.save, arguments.stats)):
        check_writable(path)

    scene = load_scene(arguments)
    views = choose_views(scene, arguments.view)
    with progress_bars() as report:
        solution = Solution.load(arguments.load, scene) if arguments.load else solve(scene, **solving, progress=report)
        for warning in solution.model.warnings:
            print(f"{PROGRAM}: warning: {warning}", file=sys.stderr)
        if arguments.save:
            solution.save(arguments.save)
        if arguments.stats:
            with writing(arguments.stats) as temporary:
                Path(temporary).write_text(json.dumps(solution.stats, indent=2) + "\n")
        for number, view in enumerate(views):
            report("render", number, len(views))
            write_image(
                view_name(output, view, views),
                render(solution, view, spp=arguments.spp, shading=arguments.shading),
                solution.stats,
            )
            report("render", number + 1, len(views))
    s = solution.stats
    print(
        f"{s['elements']:,} elements, {s['pairs']:,} pairs, {s['rays']:,} rays, {s['oracle_rays']:,} oracle rays, "
        f"{'loaded' if arguments.load else format(s['seconds']['total'], '.2f') + ' s'}"
    )


def _reference(arguments):
    from .evaluation.reference import render_reference

    if arguments.output.suffix.lower() != ".exr":
        raise RadiosityError(f"-o {arguments.output}: choose a name that ends in .exr")
    check_writable(arguments.output)
    scene = load_scene(arguments)
    views = choose_views(scene, arguments.view)
    with progress_bars() as report:
        for view in views:
            path = view_name(arguments.output, view, views)
            result = render_reference(
                scene,
                scene.sensors()[view],
                path,
                arguments.spp,
                arguments.seed,
                lambda done, total, view=view: report(f"path tracing view {view}", done, total),
            )
            print(f"{path}: {sum(result.spp)} samples per pixel, its own RMSE_a is {result.noise():.3f}")


def _compare(arguments):
    from .evaluation.compare import PAPER, QUESTIONS, compare_oracles

    questions = arguments.questions.split(",")
    if unknown := set(questions) - set(QUESTIONS):
        raise RadiosityError(f"--questions {', '.join(unknown)}: choose from {', '.join(QUESTIONS)}")
    if "mesh" not in questions:
        raise RadiosityError("--questions: the others are measured against 'mesh', name it too")
    scene = load_scene(arguments)
    views = choose_views(scene, arguments.view)
    make_folder(arguments.output)
    with progress_bars() as report:
        compare_oracles(
            arguments.scene,
            arguments.output,
            variant=arguments.mode,
            definitions=tuple(parse_definitions(arguments.define).items()),
            oracles=arguments.oracles or PAPER,
            elements=arguments.elements,
            rays=arguments.rays,
            lines=arguments.lines,
            seeds=arguments.seeds,
            views=tuple(views),
            spp=arguments.spp,
            reference_spp=arguments.reference_spp,
            questions=tuple(q for q in QUESTIONS if q in questions),
            scheduler=arguments.scheduler,
            progress=report,
        )
    print((arguments.output / "table.md").read_text())


def _bench(arguments):
    from .evaluation.bench import PATH_SPP, run_bench

    scene = load_scene(arguments)
    if arguments.view == "all":
        raise RadiosityError("--view all: bench looks from one sensor, name its number")
    (view,) = choose_views(scene, arguments.view)
    make_folder(arguments.output)
    with progress_bars() as report:
        results = run_bench(
            arguments.scene,
            arguments.output,
            elements=arguments.elements,
            rays=arguments.rays,
            view=view,
            reference_spp=arguments.reference_spp,
            path_spp=tuple(s for s in PATH_SPP if s <= arguments.path_spp),
            views=arguments.views,
            progress=report,
        )
    tracing = results["tracing"]
    print(
        f"solve: {tracing['warm_seconds']:.2f} s warm, {tracing['cold_seconds']:.1f} s cold, {tracing['solve_over_tracing']:.2f} times tracing its rays, {tracing['peak_megabytes']:.0f} MB"
    )
    for name, title in (("one", "one view"), ("many", f"{arguments.views} views")):
        for other, where in results.get(name, {}).get("crossing", {}).items():
            print(
                f"{title}: RMSE_a {where['rmse_a']:.2f} takes us {where['ours_seconds']:.2f} s and {other} {where['other_seconds']:.2f} s; "
                + (
                    f"{other} is better from {where['seconds']:.1f} s on"
                    if where["seconds"]
                    else f"{other} is never better in the time measured"
                )
            )
    print(arguments.output / "bench.json")


def _info(arguments):
    import drjit as dr
    import mitsuba as mi
    from rich.console import Console
    from rich.table import Table

    from .scene import Model, inspect

    scene = load_scene(arguments)
    console = Console()
    findings = inspect(scene)
    if findings:
        table = Table("not modelled", "why", title=str(arguments.scene), title_justify="left")
        for finding in findings:
            table.add_row(finding.what, finding.why)
        console.print(table)
        return
    model = Model(scene)
    fronts = int((model.sides % 2 == 0).sum())
    table = Table(title=str(arguments.scene), title_justify="left", show_header=False)
    power = [dr.sum(e * model.area)[0] for e in model.emission]
    lamps = int(dr.sum(dr.select(dr.max(model.emission) > 0, mi.UInt32(1), 0))[0])
    for name, value in (
        ("shapes", f"{len(scene.shapes()):,}"),
        ("faces", f"{len(model.faces.shape):,}"),
        ("patches", f"{model.count:,} ({fronts:,} fronts, {model.count - fronts:,} backs)"),
        ("sides no light reaches", f"{model.unreached:,}, left out"),
        ("area of patches", f"{model.total_area:.6g}"),
        ("lamps", f"{lamps:,} patches, {power[0]:.4g}, {power[1]:.4g}, {power[2]:.4g} W"),
        ("textured reflectance", "yes" if model.textured else "no"),
        ("sensors", f"{len(scene.sensors())}"),
        ("not modelled", "nothing: the whole scene is"),
    ):
        table.add_row(name, value)
    for warning in model.warnings:
        table.add_row("warning", warning)
    console.print(table)


# ---- What commands share ---------------------------------------------------------------------------


def load_scene(arguments):
    """The Mitsuba scene of the command line, in the variant asked for."""
    import mitsuba as mi

    if arguments.mode not in mi.variants():
        raise RadiosityError(f"unknown variant '{arguments.mode}': choose one of {', '.join(mi.variants())}")
    if not arguments.scene.is_file():
        raise RadiosityError(f"the scene {arguments.scene} does not exist: check the path")
    definitions = parse_definitions(arguments.define)
    from .scene.model import require_variant

    mi.set_log_level(mi.LogLevel.Error)
    mi.set_variant(arguments.mode)
    require_variant()
    try:
        scene = mi.load_file(str(arguments.scene), optimize=False, **definitions)  # unmerged shapes keep their names
    except RuntimeError as error:
        raise RadiosityError(f"Mitsuba cannot read {arguments.scene}: {error}") from None
    if not isinstance(scene, mi.Scene):
        raise RadiosityError(f"{arguments.scene} holds no <scene>: give a scene file")
    return scene


def make_folder(path):
    """Make a folder for output, or say why not."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RadiosityError(f"cannot write into {path} ({error.strerror}): choose another folder") from None


def parse_definitions(texts):
    """-D options as {key: value}."""
    definitions = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise RadiosityError(f"-D {text}: write it as KEY=VALUE")
        definitions[key] = value
    return definitions


def view_name(path, view, views):
    """``path`` itself, or with the number of the view if there are several."""
    return path if len(views) == 1 else path.with_name(f"{path.stem}_{view}{path.suffix}")


def choose_views(scene, text):
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
def progress_bars():
    """Yield report(stage, done, total), which draws one bar per stage on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    tasks = {}
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=not sys.stderr.isatty()) as progress:

        def report(stage, done, total):
            if stage not in tasks:
                tasks[stage] = progress.add_task(STAGES.get(stage, stage.capitalize()), total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield report
