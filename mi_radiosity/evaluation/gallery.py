"""A gallery: every scene by `path`, by us in a few seconds, and what is between the two."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.color import srgb
from ..core.errors import RadiosityError, warn_of
from ..core.files import writing
from ..core.numbers import real_number, whole_number
from ..display import unmodelled
from ..scene import Model
from .bench import now, pictures_within
from .metrics import compare
from .records import make_folder
from .reference import cached_reference, path_image
from .scenes import SceneFile

TIMES_DIFFERENCE = 4
WIDTH = 400  # of the pictures on the page, at most, pixels
HEAD = """# Gallery

Left `path` at {spp:,} samples per pixel, then ours as `--seconds {seconds:g}` shows it{denoised}, and {times} times
what lies between the two. RMSE_a is over 8-bit sRGB, the reference's noise removed; `path`'s is that of as many
samples as it takes in our time. Kernels warm, reading and solving included. Made by

    {command}

"""


def write_gallery(
    files: Iterable[SceneFile],
    output: Path,
    work: Path,
    *,
    seconds: float = 4.0,
    reference_spp: int = 1024,
    denoise: bool = False,
    command: str = "mi-radiosity gallery",
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> str:
    """Write gallery.md into ``output`` and a strip of pictures per scene beside it; returns the page.

    files: scenes, of which the first sensor is looked from. work: where references are kept, and resumed.
    """
    files, seconds = list(files), real_number("seconds", seconds, 0)
    reference_spp = whole_number("reference_spp", reference_spp)
    folder = output / "gallery"
    for path in (folder, work):
        make_folder(path)
    rows = []
    for number, (file, title) in enumerate(zip(files, _titles(files))):
        progress("scenes", number, len(files))
        row = _row(file, work, seconds, reference_spp, denoise, progress)
        name = f"{title.removesuffix('.xml').replace('/', '__')}.jpg"
        _write_strip(folder / name, row.pop("pictures"))
        rows.append(row | {"scene": title, "name": name})
    progress("scenes", len(files), len(files))
    head = HEAD.format(
        spp=reference_spp,
        seconds=seconds,
        denoised=", denoised" if denoise else "",
        times=TIMES_DIFFERENCE,
        command=command,
    )
    page = head + "\n".join(_text(row) for row in rows)
    with writing(output / "gallery.md") as temporary:
        Path(temporary).write_text(page, encoding="utf-8")
    return page


def _titles(files):
    """Names of scene files, with as many of their folders as tell them apart."""
    paths = [Path(file.path).absolute().parts for file in files]
    length = next((n for n in range(1, max(map(len, paths))) if len({p[-n:] for p in paths}) == len(paths)), 0)
    return ["/".join(path[-length:]) for path in paths]


def _row(file, work, seconds, spp, denoise, progress):
    """Pictures of a scene, and their figures."""
    file.prepare()
    scene = file.load()
    if not scene.sensors():
        raise RadiosityError(f"{file.path} has no sensor: add one to the file")
    for line in unmodelled(scene):
        warn_of(f"{file.path}: {line}")
    reference, _ = cached_reference(Model(scene), 0, work, spp, progress)
    halves = reference.halves()

    def ours(seconds):
        return pictures_within(scene, "gather", denoise, seconds, scene.sensors()[:1])

    ours(0.5)  # compiles
    start = now()
    (image,), made = ours(seconds)
    taken = now() - start
    path_image(scene, scene.sensors()[0], 4)
    start = now()
    path_image(scene, scene.sensors()[0], 4, seed=1)
    count = max(1, round(4 * taken / max(now() - start, 1e-3)))
    start = now()
    theirs = path_image(scene, scene.sensors()[0], count, seed=2)
    path_seconds = now() - start
    truth = halves.mean(axis=0)
    difference = np.abs(srgb(image) - srgb(truth)) * TIMES_DIFFERENCE
    return {
        "seconds": taken,
        "elements": made["elements"],
        "samples": round(made["spp"]),
        "error": compare(image, halves).rmse_a_clean,
        "mean": float(np.mean(image) / np.mean(truth)),
        "path_samples": count,
        "path_seconds": path_seconds,
        "path_error": compare(theirs, halves).rmse_a_clean,
        "pictures": [srgb(truth), srgb(image), np.minimum(difference, 255)],
    }


def _text(row: dict[str, Any]) -> str:
    return (
        f"## {row['scene']}\n\n"
        f"![{row['scene']}: path, ours, difference](gallery/{row['name']})\n\n"
        f"{row['seconds']:.1f} s, {row['elements']:,} elements, {row['samples']} samples per pixel: RMSE_a "
        f"{row['error']:.2f}, mean {row['mean']:.4f} of `path`'s; `path` with {row['path_samples']} samples after "
        f"{row['path_seconds']:.1f} s: {row['path_error']:.2f}.\n"
    )


def _write_strip(path, pictures):
    """Pictures [height, width, 3] of 0…255 side by side, as a JPEG."""
    step = max(1, -(-pictures[0].shape[1] // WIDTH))
    strip = np.concatenate([_smaller(picture, step) for picture in pictures], axis=1)
    with writing(path) as temporary:
        mi.Bitmap(np.ascontiguousarray(np.round(strip), dtype=np.uint8)).write(temporary, quality=90)


def _smaller(picture, step):
    """Means of step × step pixels."""
    height, width = (n // step * step for n in picture.shape[:2])
    return picture[:height, :width].reshape(height // step, step, width // step, step, 3).mean(axis=(1, 3))
