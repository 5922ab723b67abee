"""Points to measure at: over a plane, over a shape, or from a file."""

import csv
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import RadiosityError
from ..core.numbers import real_number
from ..scene import Model
from ..scene.overlap import EDGE, surfaces

MOST = 4_000_000  # points of a grid
CELLS = 20  # along the longest side of a grid, if no spacing is asked for
COLUMNS = ("x", "y", "z", "nx", "ny", "nz")  # of a file of points
AXES = {"x": ("y", "z"), "y": ("x", "z"), "z": ("x", "y")}  # of a plane's picture


@dataclass(frozen=True)
class Sheet:
    """A flat grid of rows × columns cells: corner + (column + ½) u + (row + ½) v are their centres."""

    corner: np.ndarray  # [3] m
    u: np.ndarray  # [3] m, along a row, from cell to cell
    v: np.ndarray  # [3] m, from row to row
    columns: int
    rows: int
    normal: np.ndarray  # [3] unit
    axes: tuple[str, str] = ("", "")  # names of the coordinates along u and v

    def points(self) -> np.ndarray:
        """Centres of the cells, row by row [rows · columns, 3]."""
        row, column = (x.ravel()[:, None] for x in np.indices((self.rows, self.columns)) + 0.5)
        return self.corner + column * self.u + row * self.v


@dataclass(frozen=True)
class Grid:
    """Points and unit normals [n, 3]; ``cell``: the number of each in its sheet, and ``sheet`` which one [n]; a grid
    without ``sheets`` is a list of points."""

    points: np.ndarray
    normals: np.ndarray
    sheets: tuple[Sheet, ...] = ()
    sheet: np.ndarray | None = None
    cell: np.ndarray | None = None


def plane_grid(model: Model, text: str, spacing: float | None = None) -> Grid:
    """Points over a plane such as "z=0.8" that faces +z, or "-z=0.8" that faces −z, as far as the scene's bounding box
    goes. Raises RadiosityError for what is no plane, or lies outside of the scene."""
    found = re.fullmatch(r"\s*([+-]?)([xyz])\s*=\s*(\S+)\s*", text)
    try:
        sign, axis, height = found[1], found[2], float(found[3])  # type: ignore[index]
    except (TypeError, ValueError):
        raise RadiosityError(f"'{text}' is no plane: write z=0.8, or -z=0.8 for one that faces down") from None
    low, high = model.faces.low, model.faces.high
    k, i, j = ("xyz".index(name) for name in (axis, *AXES[axis]))
    if not low[k] <= height <= high[k]:
        raise RadiosityError(
            f"the plane {text} lies outside of the scene: {axis} goes from {low[k]:.6g} to {high[k]:.6g}"
        )
    step = _checked_spacing(spacing, max(high[i] - low[i], high[j] - low[j]))
    columns, rows = (_cells(high[a] - low[a], step) for a in (i, j))
    corner, unit = low.copy(), np.eye(3)
    corner[k] = height
    u, v = unit[i] * (high[i] - low[i]) / columns, unit[j] * (high[j] - low[j]) / rows
    sheet = Sheet(corner, u, v, columns, rows, -unit[k] if sign == "-" else unit[k], AXES[axis])
    return _grid([(sheet, np.arange(_checked_count(rows * columns)))])


def shape_grid(model: Model, name: str, spacing: float | None = None) -> Grid:
    """Points over a shape, known by its id: each of its flat surfaces has a grid along its own edges, of one point at
    least. Raises RadiosityError that lists the names if there is no such shape."""
    faces, shapes = model.faces, model.scene.shapes()
    names = [{part.shape.id(), shapes[part.number].id()} for part in faces.parts]  # of members of instances, two
    named = [number for number, own in enumerate(names) if name in own]
    if not named:
        known = ", ".join(sorted(set().union(*names) - {""}))
        raise RadiosityError(f"there is no shape '{name}': choose one of {known}")
    chosen = np.flatnonzero(np.isin(faces.shape, named) & ~faces.degenerate)
    if not len(chosen):
        raise RadiosityError(f"the shape '{name}' has no area: nothing can be measured on it")
    corners, normal = faces.corners[chosen], faces.normal[chosen]
    group = surfaces(faces.vertex[chosen], normal)
    size = np.ptp(corners.reshape(-1, 3), axis=0)
    step = _checked_spacing(spacing, size.max())
    _checked_count(int(faces.area[chosen].sum() / step**2))
    lit = 2 * np.array(model.patches.face, dtype=np.int64) + np.array(model.patches.back)
    side = np.where(np.isin(2 * chosen + 1, lit) & ~np.isin(2 * chosen, lit), -1.0, 1.0)
    order = np.argsort(group, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(group[order])) + 1)
    return _grid([_on_surface(corners[part], normal[part[0]], side[part[0]], step) for part in parts])


def file_grid(path: Path) -> Grid:
    """Points of a CSV file with the columns x, y, z, nx, ny, nz. Raises RadiosityError, naming line and cause."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = csv.DictReader(file, skipinitialspace=True)
            missing = [name for name in COLUMNS if name not in (rows.fieldnames or ())]
            if missing:
                raise RadiosityError(
                    f"{path} has no column {', '.join(missing)}: its first line must name x,y,z,nx,ny,nz"
                )
            values = [[float(row[name]) for name in COLUMNS] for row in rows]
    except OSError as error:
        raise RadiosityError(f"cannot read {path} ({error.strerror}): check the path") from None
    except (TypeError, ValueError) as error:
        if isinstance(error, RadiosityError):
            raise
        raise RadiosityError(f"{path}, line {rows.line_num}: a value is missing or no number: repair it") from None
    if not values:
        raise RadiosityError(f"{path} holds no points")
    table = np.array(values)
    return Grid(table[:, :3], table[:, 3:])


# ---- Sheets ----------------------------------------------------------------------------------------


def _grid(parts):
    """One Grid of (sheet, its cells) pairs."""
    sheets, cells = zip(*parts)
    return Grid(
        np.concatenate([sheet.points()[cell] for sheet, cell in parts]),
        np.concatenate([np.broadcast_to(sheet.normal, (len(cell), 3)) for sheet, cell in parts]),
        sheets,
        np.repeat(np.arange(len(sheets)), [len(cell) for cell in cells]),
        np.concatenate(cells),
    )


def _on_surface(corners, normal, side, step):
    """A sheet over coplanar faces [n, 3, 3], in the smallest box along one of their edges, and the cells on them."""
    edges = (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    edges = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    edges = edges[np.unique(np.round(np.abs(edges @ edges[0]), 3), return_index=True)[1]]
    across = np.cross(normal, edges)
    along, over = (corners.reshape(-1, 3) @ axes.T for axes in (edges, across))  # [corners, edges]
    best = np.argmin(np.ptp(along, axis=0) * np.ptp(over, axis=0))
    u, v = edges[best], across[best]
    low = np.array([along[:, best].min(), over[:, best].min()])
    extent = np.array([np.ptp(along[:, best]), np.ptp(over[:, best])])
    columns, rows = (_cells(length, step) for length in extent)
    height = corners[0, 0] @ normal
    corner = low[0] * u + low[1] * v + height * normal
    sheet = Sheet(corner, u * extent[0] / columns, v * extent[1] / rows, columns, rows, side * normal)
    cells = _cells_on(columns, rows, (corners @ np.column_stack([u, v]) - low) * [columns, rows] / extent)
    if len(cells):
        return sheet, cells
    # Too small for its grid: the middle of the largest face stands for it.
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    centre = corners[np.argmax(area)].mean(axis=0)
    u, v = sheet.u * columns, sheet.v * rows
    return Sheet(centre - (u + v) / 2, u, v, 1, 1, side * normal), np.arange(1)


def _cells_on(columns, rows, triangles):
    """Numbers of the cells whose centres lie on triangles [n, 3, 2], in units of cells."""
    found = np.zeros((rows, columns), dtype=bool)
    for p0, p1, p2 in triangles:
        first = np.maximum(np.floor(np.minimum(np.minimum(p0, p1), p2) - 0.51), 0).astype(int)
        last = np.ceil(np.maximum(np.maximum(p0, p1), p2) + 0.51).astype(int)
        part = found[first[1] : last[1], first[0] : last[0]]
        y, x = np.indices(part.shape) + 0.5
        a, b, x, y = p1 - p0, p2 - p0, x + first[0] - p0[0], y + first[1] - p0[1]
        area = a[0] * b[1] - a[1] * b[0]
        s, t = (x * b[1] - y * b[0]) / area, (a[0] * y - a[1] * x) / area
        part |= (s >= -EDGE) & (t >= -EDGE) & (s + t <= 1 + EDGE)
    return np.flatnonzero(found)


def _cells(length, step):
    return max(1, round(length / step))


def _checked_spacing(spacing, longest):
    if spacing is None:
        return longest / CELLS
    return real_number("spacing", spacing, 0)


def _checked_count(count):
    if count > MOST:
        raise RadiosityError(f"that spacing makes {count:,} points: make it larger, for {MOST:,} at most")
    return count
