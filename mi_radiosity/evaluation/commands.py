"""mi-radiosity reference, compare, bench and gallery."""

import argparse
import shlex
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.console import (
    Report,
    choose_views,
    integer,
    loading_arguments,
    positive,
    positive_number,
    progress_bars,
    shading_argument,
    view_name,
    warn,
)
from ..core.errors import RadiosityError
from ..core.files import check_writable

if TYPE_CHECKING:  # imported where it is used, so that --help is quick
    from .scenes import SceneFile


def add_evaluation(commands: Any, scene_arguments: Callable[[argparse.ArgumentParser], None]) -> None:
    """Add the commands; ``scene_arguments`` adds those that say which scene and how it is loaded."""
    for add, run, text in (
        (_reference_arguments, _reference, "path-trace a reference; resumes, never starts over"),
        (_compare_arguments, _compare, "compare oracles: error beside cost, against a path-traced reference"),
        (_bench_arguments, _bench, "error against time: ours, path, and path with a denoiser"),
    ):
        command = commands.add_parser(run.__name__.strip("_"), help=text)
        scene_arguments(command)
        add(command)
        command.set_defaults(command=run)
    gallery = commands.add_parser("gallery", help="a page of scenes: path, ours, and the difference")
    _gallery_arguments(gallery)
    gallery.set_defaults(command=_gallery)


def _reference_arguments(parser):
    add, names = parser.add_argument, "with several views the view's number is added to the name"
    add("-o", "--output", required=True, type=Path, metavar="REF.exr", help=names)
    add("--spp", type=positive, default=1024, metavar="N", help="samples per pixel in all (default 1024)")
    add("--view", default="0", metavar="K|all")
    add("--seed", type=integer, default=0, metavar="K")


def _budget_arguments(parser, elements, files):
    add = parser.add_argument
    add("-o", "--output", required=True, type=Path, metavar="DIR", help=files)
    add("--elements", type=positive, default=19_000, metavar="N", help=elements)
    add("--rays", type=positive, default=2_684_000, metavar="N")
    add("--reference-spp", type=positive, default=1024, metavar="N")
    shading_argument(parser)


def _compare_arguments(parser):
    add, files = parser.add_argument, "table.md, results.json, figure.png, report.html; an interrupted run goes on"
    _budget_arguments(parser, "leaf elements of every mesh", files)
    rows = "such as ks,gmi:1.5,mi,gmi:0.5 (default: the rows of the paper's table 1)"
    add("--oracles", metavar="LIST", help=rows)
    add("--lines", type=positive, default=10, metavar="S")
    add("--seeds", type=positive, default=5, metavar="N", help="repetitions (default 5)")
    add("--view", default="all", metavar="K|all")
    samples = "camera samples per pixel of our pictures (default 64)"
    add("--spp", type=positive, default=64, metavar="N", help=samples)
    equal = "which budgets are equal: mesh, rays, time; noise splits the error"
    add("--questions", default="mesh,rays,time,noise", metavar="LIST", help=equal)
    add("--scheduler", metavar="ADDRESS", help="run on the Dask cluster there (needs mi_radiosity[dask])")


def _bench_arguments(parser):
    add = parser.add_argument
    _budget_arguments(parser, "middle of the ladder of budgets", "bench.json and error_time.png")
    add("--view", default="0", metavar="K")
    add("--views", type=positive, default=16, metavar="N", help="views of the camera path (default 16; 1: none)")
    most = "most samples per pixel of path (default 1024)"
    add("--path-spp", type=positive, default=1024, metavar="N", help=most)


def _reference(arguments: argparse.Namespace) -> None:
    from ..display import unmodelled
    from .reference import render_reference

    if arguments.output.suffix.lower() != ".exr":
        raise RadiosityError(f"-o {arguments.output}: choose a name that ends in .exr")
    check_writable(arguments.output)
    scene = arguments.file.load()
    views = choose_views(scene, arguments.view)
    warn(unmodelled(scene))
    with progress_bars() as report:
        for view in views:
            path, stage = view_name(arguments.output, view, views), f"path tracing view {view}"
            result = render_reference(
                scene,
                scene.sensors()[view],
                path,
                arguments.spp,
                arguments.seed,
                partial(report, stage),
            )
            print(f"{path}: {sum(result.spp)} samples per pixel, its own RMSE_a is {result.noise():.3f}")


def _gallery_arguments(parser):
    add = parser.add_argument
    add("scene", type=Path, nargs="+", metavar="SCENE", help="Mitsuba XML files")
    add("-o", "--output", required=True, type=Path, metavar="DIR", help="gallery.md, and pictures in gallery/")
    add("--work", type=Path, default=Path("runs/gallery"), metavar="DIR", help="references (default runs/gallery)")
    add("--seconds", type=positive_number, default=4.0, metavar="T", help="for ours (default 4)")
    add("--reference-spp", type=positive, default=1024, metavar="N", help="samples per pixel of path (default 1024)")
    add("--denoise", action="store_true", help="ours, by Open Image Denoise")
    loading_arguments(parser)


def _gallery(arguments: argparse.Namespace) -> None:
    from ..display import require_denoiser
    from .gallery import write_gallery
    from .scenes import scene_file

    if arguments.denoise:
        require_denoiser()
    definitions = dict(arguments.define)
    files = [scene_file(path, arguments.mode, definitions, arguments.plugin) for path in arguments.scene]
    command = ["mi-radiosity", "gallery", *map(str, arguments.scene), "-o", str(arguments.output)]
    command += ["--seconds", f"{arguments.seconds:g}", "--reference-spp", str(arguments.reference_spp)]
    command += ["--denoise"] * arguments.denoise + ["-m", arguments.mode] * (arguments.mode != "llvm_ad_rgb")
    for option, values in (("-D", map("=".join, arguments.define)), ("--plugin", arguments.plugin)):
        command += [part for value in values for part in (option, str(value))]
    with progress_bars() as report:
        page = write_gallery(
            files,
            arguments.output,
            arguments.work,
            seconds=arguments.seconds,
            reference_spp=arguments.reference_spp,
            denoise=arguments.denoise,
            command=shlex.join(command),
            progress=report,
        )
    print(page)


def _compare(arguments: argparse.Namespace) -> None:
    from ..display import unmodelled
    from .compare import PAPER, compare_oracles

    scene = arguments.file.load()
    views = choose_views(scene, arguments.view)
    warn(unmodelled(scene))
    with progress_bars() as report:
        compare_oracles(
            **_study(arguments, report),
            oracles=arguments.oracles or PAPER,
            lines=arguments.lines,
            seeds=arguments.seeds,
            views=views,
            spp=arguments.spp,
            questions=arguments.questions.split(","),
            scheduler=arguments.scheduler,
        )
    print((arguments.output / "table.md").read_text(encoding="utf-8"))


def _bench(arguments: argparse.Namespace) -> None:
    from ..display import unmodelled
    from .bench import PATH_SPP, run_bench
    from .plots import panel_titles

    if arguments.view == "all":
        raise RadiosityError("--view all: bench looks from one sensor, name its number")
    scene = arguments.file.load()
    (view,) = choose_views(scene, arguments.view)
    warn(unmodelled(scene))
    with progress_bars() as report:
        results = run_bench(
            **_study(arguments, report),
            view=view,
            path_spp=[s for s in PATH_SPP if s <= arguments.path_spp],
            views=arguments.views,
        )
    tracing = results["tracing"]
    print(
        f"solve: {tracing['warm_seconds']:.2f} s warm, {tracing['cold_seconds']:.1f} s cold, "
        f"{tracing['solve_over_tracing']:.2f} times tracing its rays, {tracing['peak_megabytes']:.0f} MB"
    )
    if results["views"] < arguments.views:
        print("no camera path: only perspective sensors turn")
    for name, title in panel_titles(results).items():
        for other, where in results[name]["crossing"].items():
            print(f"{title}: {_crossing(other, where)}")
    print(arguments.output / "bench.json")


def _study(arguments: argparse.Namespace, report: Report) -> dict[str, Any]:
    """What `compare_oracles` and `run_bench` are both given."""
    file: SceneFile = arguments.file
    return {
        "path": arguments.scene,
        "output": arguments.output,
        "variant": file.variant,
        "definitions": dict(file.definitions),
        "plugins": file.plugins,
        "elements": arguments.elements,
        "rays": arguments.rays,
        "shading": arguments.shading,
        "reference_spp": arguments.reference_spp,
        "progress": report,
    }


def _crossing(other: str, where: dict[str, Any]) -> str:
    """Where a curve crosses ours, as a sentence."""
    later = f"from {where['seconds']:.1f} s on" if where["seconds"] else "never in the time measured"
    return (
        f"RMSE_a {where['rmse_a']:.2f} takes us {where['ours_seconds']:.2f} s and {other} "
        f"{where['other_seconds']:.2f} s; {other} is better {later}"
    )
