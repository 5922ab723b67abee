"""Light measured at points, written as numbers (CSV), as a mesh (VTU) or as a picture in false colours (PNG)."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import RadiosityError
from ..core.extras import optional
from ..core.files import writing
from ..solver import Solution
from .grids import COLUMNS, Grid
from .visible import hidden

PANELS, LEAST = 12, 0.05  # surfaces that a picture shows: the largest, and none below this part of the largest
LEVELS = 9  # isolines, about


@dataclass(frozen=True)
class Measurement:
    """What was measured at the points of a grid; NaN at points inside of solids.

    ``values`` and ``errors``: illuminance and its standard error, lx [n], or irradiance in W/m² per channel [n, 3].
    """

    grid: Grid
    values: np.ndarray
    errors: np.ndarray
    lux: bool

    @property
    def channels(self) -> dict[str, np.ndarray]:
        """Values by the name of their channel."""
        return {"E": self.values} if self.lux else dict(zip(("H_R", "H_G", "H_B"), self.values.T))

    @property
    def solid(self) -> np.ndarray:
        """Which points lie inside of solids (bool [n])?"""
        return np.isnan(self.values.reshape(len(self.values), -1)[:, 0])

    @property
    def unit(self) -> str:
        return "lx" if self.lux else "W/m²"

    def summary(self) -> dict[str, np.ndarray]:
        """mean, min, max, uniformity min / mean, and the largest standard error of a point, of every channel; NaN if
        all points lie inside of solids."""
        values, known = np.stack(list(self.channels.values())), ~self.solid
        if not known.any():
            return dict.fromkeys(("mean", "min", "max", "min / mean", "error"), np.full(len(values), np.nan))
        mean, low, high = (f(values[:, known], axis=1) for f in (np.mean, np.min, np.max))
        uniformity = np.divide(low, mean, out=np.full(len(mean), np.nan), where=mean > 0)
        error = self.errors.reshape(len(known), -1)[known].max(axis=0)
        return {"mean": mean, "min": low, "max": high, "min / mean": uniformity, "error": error}


def measure(
    solution: Solution,
    grid: Grid,
    lux: bool = False,
    samples: int = 1024,
    seed: int = 0,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Measurement:
    """Irradiance, or illuminance with ``lux``, at the points of a grid: see `Solution.irradiance`."""
    values, errors = solution.irradiance(
        grid.points, grid.normals, lux=lux, samples=samples, seed=seed, return_error=True, progress=progress
    )
    normals = grid.normals / np.linalg.norm(grid.normals, axis=1, keepdims=True)
    inside = hidden(solution.model, grid.points, normals, values)
    values[inside] = errors[inside] = np.nan
    return Measurement(grid, values, errors, lux)


def write_measurement(path: Path, measurement: Measurement) -> None:
    """Write a .csv, .vtu or .png file. Raises RadiosityError if it cannot be written."""
    with writing(path) as temporary:
        _WRITERS[path.suffix.lower()](measurement, temporary)


def check_output(path: Path, has_sheets: bool) -> None:
    """Raise RadiosityError now if a measurement could not be written there."""
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise RadiosityError(f"-o {path}: choose a name that ends in .csv, .vtu or .png")
    if suffix == ".png":
        if not has_sheets:
            raise RadiosityError(f"-o {path}: a picture needs --plane or --shape; choose .csv or .vtu for points")
        optional("matplotlib", "a picture of a measurement", "evaluation")
    if suffix == ".vtu":
        optional("meshio", "a .vtu file", "export")


def _csv(m, path):
    unit = m.unit.replace("²", "2")
    names = [*COLUMNS, *(f"{c} [{unit}]" for c in m.channels), *(f"error {c}" for c in m.channels)]
    table = np.column_stack([m.grid.points, m.grid.normals, m.values, m.errors])
    table += 0.0  # no -0
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(names), comments="", encoding="utf-8")


def _vtu(m, path):
    """Cells of sheets as quadrilaterals, points of lists as vertices."""
    meshio: Any = optional("meshio", "a .vtu file", "export")
    data = {f"{name} [{m.unit}]": [values] for name, values in m.channels.items()}
    data |= {f"error {name}": [e] for name, e in zip(m.channels, m.errors.reshape(len(m.values), -1).T)}
    points = m.grid.points
    cells: tuple[str, np.ndarray] = ("vertex", np.arange(len(points))[:, None])
    if m.grid.sheets:
        u, v = (np.stack([getattr(s, name) for s in m.grid.sheets])[m.grid.sheet] for name in "uv")
        corners = np.stack([points + 0.5 * (a * u + b * v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))], axis=1)
        # Neighbours share corners, to a millionth of the scene.
        flat = corners.reshape(-1, 3)
        step = max(np.ptp(flat, axis=0).max(), 1e-30) * 1e-6
        _, first, number = np.unique(np.round(flat / step), axis=0, return_index=True, return_inverse=True)
        points, cells = flat[first], ("quad", number.reshape(-1, 4))
    meshio.vtu.write(path, meshio.Mesh(points, [cells], cell_data=data))


# ---- Picture ---------------------------------------------------------------------------------------


def _png(m, path):
    """False colours with isolines and a scale, a panel for each of the largest sheets."""
    optional("matplotlib", "a picture of a measurement", "evaluation")
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    values = m.values if m.lux else m.values.mean(axis=1)
    area = np.array([np.linalg.norm(np.cross(s.u, s.v)) * s.rows * s.columns for s in m.grid.sheets])
    largest = np.argsort(-area, kind="stable")[:PANELS]
    shown = np.sort(largest[area[largest] >= LEAST * area.max()])
    high = np.nanmax(values, initial=0)
    levels = MaxNLocator(LEVELS).tick_values(0, high if high > 0 else 1)
    columns = int(np.ceil(len(shown) ** 0.5))
    rows = -(-len(shown) // columns)
    widths, heights = (
        [np.linalg.norm(getattr(s, w)) * getattr(s, n) for s in m.grid.sheets]
        for w, n in (("u", "columns"), ("v", "rows"))
    )
    aspect = np.clip(columns * np.max(widths) / (rows * np.max(heights)), 0.4, 2.5)
    figure = Figure(figsize=(6 * aspect**0.5 + 1.4, 6 / aspect**0.5 + 0.6), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in panels[len(shown) :]:
        axis.set_axis_off()
    for axis, number in zip(panels, shown):
        here = m.grid.sheet == number
        drawn = _panel(axis, m.grid.sheets[number], m.grid.cell[here], values[here], levels)
    label = "illuminance, lx" if m.lux else "irradiance, mean of the channels, W/m²"
    figure.colorbar(drawn, ax=panels.tolist(), label=label, shrink=0.8)
    mean, low = np.nanmean(values) if high > 0 else 0.0, np.nanmin(values, initial=np.inf)
    figure.suptitle(f"mean {mean:.4g} {m.unit}, min / mean {low / mean if mean > 0 else 0:.3f}", fontsize=11)
    figure.savefig(path, format="png", dpi=110)


def _panel(axis, sheet, cells, values, levels):
    image = np.full(sheet.rows * sheet.columns, np.nan)
    image[cells] = values
    image = image.reshape(sheet.rows, sheet.columns)
    start = [
        float(sheet.corner @ w / np.linalg.norm(w)) if name else 0.0 for w, name in zip((sheet.u, sheet.v), sheet.axes)
    ]
    x, y = (
        s + np.arange(n + 1) * np.linalg.norm(w)
        for s, n, w in zip(start, (sheet.columns, sheet.rows), (sheet.u, sheet.v))
    )
    drawn = axis.pcolormesh(x, y, image, cmap="viridis", vmin=0, vmax=levels[-1])
    if min(image.shape) > 1:
        lines = axis.contour(
            (x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2, image, levels=levels[1:-1], colors="w", linewidths=0.8
        )
        axis.clabel(lines, fontsize=8, fmt="%g")
    axis.set(aspect="equal", xlabel=f"{sheet.axes[0]} [m]".strip(), ylabel=f"{sheet.axes[1]} [m]".strip())
    # As one sees it who looks against the normal.
    if np.dot(np.cross(sheet.u, sheet.v), sheet.normal) < 0:
        axis.invert_yaxis()
    return drawn


_WRITERS: dict[str, Callable[[Measurement, str], None]] = {".csv": _csv, ".vtu": _vtu, ".png": _png}
