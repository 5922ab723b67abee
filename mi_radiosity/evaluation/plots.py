"""Figures, as PNG files in memory."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.color import srgb
from .records import picture_file

ROWS_OF_FIGURE = ("ks", "mi", "gmi:0.5")  # Fig. 1: KS, GMI_1, GMI_0.5
CURVES = {
    "ours": "radiosity",
    "ours, denoised": "radiosity + Open Image Denoise",
    "path": "path",
    "denoised": "path + Open Image Denoise",
}
MOST_ERROR = 40  # at the bright end of the heat maps


def pictures_and_errors(output: Path, labels: Sequence[str], references: Mapping[int, np.ndarray]) -> bytes:
    """Fig. 1: shaded first view and mesh of the last one, with error heat maps beside."""
    rows = [label for label in ROWS_OF_FIGURE if label in labels] or labels[:3]
    figure, axes = _figure(len(rows), 4, width=4, height=3.2)
    shown = None
    for line, label in zip(axes, rows, strict=True):
        for axis, (title, image) in zip(line, _panels(output, label, references), strict=True):
            axis.set_axis_off()
            axis.set_title(title, fontsize=10)
            if image is not None and image.ndim == 3:
                axis.imshow(srgb(image).astype(np.uint8))
            elif image is not None:
                shown = axis.imshow(image, cmap="inferno", vmin=0, vmax=MOST_ERROR)
    if shown is not None:
        figure.colorbar(shown, ax=axes[:, 2:].ravel().tolist(), shrink=0.6, label="|error| on 0…255")
    return _png(figure)


def _panels(output: Path, label: str, references: Mapping[int, np.ndarray]) -> list[tuple[str, Any]]:
    """Titles of pictures [height, width, 3] and errors [height, width], with None where a picture is missing."""
    first, last = min(references), max(references)

    def picture(view, mesh=False):
        file = picture_file(output, label, view, mesh)
        return np.array(mi.Bitmap(str(file)))[..., :3] if file.exists() else None

    def error(view):
        image = picture(view)
        return None if image is None else np.abs(srgb(image) - srgb(references[view])).mean(axis=2)

    return [
        (f"{label}: view {first}", picture(first)),
        (f"mesh, view {last}", picture(last, mesh=True)),
        (f"error, view {first}", error(first)),
        (f"error, view {last}", error(last)),
    ]


def panel_titles(results: Mapping[str, Any]) -> dict[str, str]:
    """What the measured panels of a benchmark show."""
    titles = {"one": "one view", "many": f"{results['views']} views"}
    return {name: title for name, title in titles.items() if name in results}


def error_against_time(results: Mapping[str, Any]) -> bytes:
    """RMSE_a against seconds, one panel for one view and one for the camera path."""
    titles = panel_titles(results)
    figure, axes = _figure(1, len(titles), width=6.5, height=4.6)
    for axis, (name, title) in zip(axes[0], titles.items(), strict=True):
        for curve, label in CURVES.items():
            if points := results[name].get(curve):
                axis.loglog([p["seconds"] for p in points], [p["rmse_a_clean"] for p in points], "o-", label=label)
        axis.set(
            title=f"{results['scene']}: {title}",
            xlabel="seconds (solve and render, kernels warm)",
            ylabel="RMSE_a (0…255), reference noise removed",
        )
        axis.grid(True, which="both", alpha=0.25)
        axis.legend()
    return _png(figure)


def _figure(rows: int, columns: int, width: float, height: float) -> tuple[Any, np.ndarray]:
    """A figure of panels, made without pyplot, whose backend is the user's."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
