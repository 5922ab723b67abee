"""mi-radiosity export --lightmap."""

import argparse

from ..core.console import integer, positive, progress_bars
from ..core.errors import RadiosityError
from .kept import load_kept

SAMPLES = 256  # per texel


def lightmap_arguments(parser: argparse.ArgumentParser) -> None:
    """What is asked for of a lightmap."""
    add = parser.add_argument_group("lightmap").add_argument
    add(
        "--lightmap",
        type=integer,
        metavar="SIZE",
        help="bake SIZE x SIZE texels: irradiance (.exr) or the scene (.glb)",
    )
    samples = f"lines to the lamps, and as many rays into the room, per texel (default {SAMPLES})"
    add("--samples", type=positive, metavar="N", help=samples)
    add("--denoise", action="store_true", help="by Open Image Denoise")
    add("--unlit", action="store_true", help="a .glb that every viewer shows, its texture being the radiance itself")
    add("--seed", type=integer, metavar="K", help="random seed (default 0)")


def refuse_without_lightmap(arguments: argparse.Namespace) -> None:
    """Raise RadiosityError for options of a lightmap where none is asked for."""
    for name in ("samples", "denoise", "unlit", "seed"):
        value = getattr(arguments, name)
        if value is not None and value is not False:
            raise RadiosityError(f"--{name} belongs to a lightmap: add --lightmap SIZE, or leave it out")


def bake(arguments: argparse.Namespace) -> None:
    """Write a lightmap, and say what it is made of."""
    from .lightmap import check_budget
    from .lightmap_files import check_target, export_lightmap

    samples = SAMPLES if arguments.samples is None else arguments.samples
    check_budget(arguments.lightmap, samples, arguments.denoise)
    check_target(arguments.output, arguments.unlit)
    solution = load_kept(arguments)
    with progress_bars() as report:
        found = export_lightmap(
            solution,
            arguments.output,
            arguments.lightmap,
            samples,
            arguments.denoise,
            arguments.unlit,
            arguments.exposure,
            arguments.seed or 0,
            report,
            arguments.hide_emitters,
        )
    mean, error = found.mean(), found.error[found.open].mean() / max(found.irradiance[found.open].mean(), 1e-30)
    print(
        f"{arguments.output}: {found.open.sum():,} texels of {arguments.lightmap:,} x {arguments.lightmap:,} in "
        f"{found.atlas.chart.max() + 1:,} charts, {found.atlas.per_metre:.3g} per metre, {found.rays:,} rays; mean "
        f"irradiance {', '.join(f'{h:.4g}' for h in mean)} W/m2, error of a texel {error:.1%} of it"
        + (" before denoising" if arguments.denoise else "")
    )
