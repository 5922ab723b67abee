"""View factors: F_ij, the part of the light of facet i that comes straight to facet j."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.balance import balance, like
from ..core.errors import RadiosityError, interruptible
from ..core.extras import optional
from ..core.numbers import whole_number
from ..mesh import Elements, Tree
from ..scene import Model
from .contour import exchange_area
from .facets import OUTSIDE, Counts, Facets, count_rays
from .sample_lines import LINES, visible_sums

RAYS = {"shape": 1 << 17, "face": 1 << 10, "leaf": 1 << 10}  # per row, by default
FEW = 8  # rays that connect two cells from which sample lines are worth their cost
RAMP = (
    16,
    64,
)  # expected rays between two cells: below the first, rays alone decide; from the second, sample lines alone
UNSEEN = 2  # rays or sample lines that every error allows for beyond the observed ones (Agresti and Coull)


@dataclass(frozen=True)
class Closure:
    """What was done to a matrix of view factors so that its rows sum to 1 and A_i F_ij = A_j F_ji."""

    raw_row_error: float  # largest |Σ_j F_ij − 1| before,
    row_error: float  # and after; more than rounding where no matrix with these zeros has such sums
    largest: float  # change of an entry
    mean: float  # ... in the mean over the entries, |F_closed − F|


@dataclass(frozen=True)
class ViewFactors:
    """View factors between the facets of a scene.

    F: [rows, columns], SciPy CSR; column j < rows is facet j, and any further ones are, in this order and where rays
    end there: "sky", "ground", and "backs", sides that have no material. error: standard errors, in the same places: at
    least 95 % of the entries lie within two of them. Where F has no entry, no ray connected the two facets: it is below
    3 / rays in 95 % of such cases, rays being those of the row that start on its visible area. names: of the columns.
    areas: visible areas of the facets, without what lies under others or inside solids, m² [rows]. closure: what was
    adjusted. stats: rays, lines, seconds.
    """

    F: Any
    error: Any
    names: tuple[str, ...]
    areas: np.ndarray
    closure: Closure
    stats: dict

    @property
    def between(self) -> Any:
        """F without sky, ground and backs: SciPy CSR [rows, rows]."""
        return self.F[:, : len(self.areas)]

    def radiosity(
        self, emission: np.ndarray, reflectance: np.ndarray, outside: np.ndarray | float = 0.0, accuracy: float = 1e-9
    ) -> np.ndarray:
        """B = E + ρ (F B + F_outside B_outside), W/m²: [rows], or [rows, cases] for many right-hand sides at once.

        emission: E, so shaped. reflectance: ρ < 1 [rows]; in infrared it is 1 − ε, and E = ε σ T⁴. outside: B of sky,
        ground and backs, as far as there are such columns: one number, [columns] or [columns, cases]. The Neumann
        series is summed until nothing changes by more than ``accuracy``, relatively.
        """
        emission = np.asarray(emission, dtype=np.float64)
        rho = np.asarray(reflectance, dtype=np.float64).reshape(-1, *[1] * (emission.ndim - 1))
        if len(emission) != len(self.areas) or len(rho) not in (1, len(emission)) or not (rho < 1).all():
            raise RadiosityError(f"give {len(self.areas)} emissions and as many reflectances below 1")
        between, beyond = self.between, self.F[:, len(self.areas) :]
        if beyond.shape[1]:
            sky = np.asarray(outside, dtype=np.float64)
            sky = sky[:, None] if sky.ndim == 1 and emission.ndim == 2 else sky
            emission = emission + rho * (beyond @ np.broadcast_to(sky, (beyond.shape[1], *emission.shape[1:])))
        B = more = emission
        while np.abs(more).max(initial=0) > accuracy * np.abs(B).max(initial=0):
            more = rho * (between @ more)
            B = B + more
        return B


@interruptible()
def view_factors(
    scene: "mi.Scene | Model",
    level: str = "face",
    rays: int | None = None,
    *,
    elements: Elements | None = None,
    seed: int = 0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    progress: Callable[[str, int, int | None], None] | None = None,
) -> ViewFactors:
    """View factors of a scene, which needs no lamp: F_ij = 1/A_i ∫∫ V cos θ_i cos θ_j / (π r²) dA_j dA_i.

    level: "shape", "face", or "leaf" where a mesh of ``elements`` is given. rays: cosine-distributed rays from every
    facet, 1,024 by default, and 131,072 from shapes. up: what tells the sky from the ground. progress: called with
    (stage, done, total).

    Where few rays connect two faces (or leaves), the share of rays that connect them is the estimate. Where many do,
    the estimate is the exchange area in full view, by contour integrals, times the visible share of sample lines that
    are distributed like the kernel. Raises RadiosityError for options and scenes that cannot be used.
    """
    start = time.perf_counter()
    rays = RAYS.get(level, 1) if rays is None else whole_number("rays", rays)
    seed, up = whole_number("seed", seed, None), _direction(up)
    report = progress or (lambda stage, done, total: None)
    model = scene if isinstance(scene, Model) else Model(scene, lit=False)
    if level == "leaf" and elements is None:
        raise RadiosityError("a scene has no leaves before it is solved: ask its solution, or choose level='face'")
    facets = Facets(
        model, Tree(model.patches, model.materials, model.lights).freeze() if elements is None else elements, level
    )
    counts = count_rays(facets, rays, seed, up, lambda done, total: report("trace", done, total))
    flow = _Exchange(facets, counts, seed, lambda done, total: report("connect", done, total))
    return _closed(facets, counts, flow, start)


def _direction(up):
    """Three finite numbers, not all 0, as Python floats."""
    try:
        axis = np.asarray(up, dtype=np.float64)
    except (TypeError, ValueError):
        axis = np.zeros(0)
    if axis.shape != (3,) or not np.isfinite(axis).all() or not axis.any():
        raise RadiosityError(f"up must be a direction, not {up}: give three numbers, such as (0, 0, 1)")
    return tuple(axis.tolist())


class _Exchange:
    """Exchange areas A_i F_ij between cells: a symmetric SciPy CSR ``area`` [cells, cells], m².

    In the same places: ``variance``, the sample variance, and ``unit``, the exchange area that one ray or sample line
    stands for. ``density``: rays per m² [cells]; ``lines``: how many sample lines were traced.
    """

    def __init__(self, facets: Facets, counts: Counts, seed: int, progress: Callable[[int, int], None]) -> None:
        self.facets, self.progress = facets, progress
        self.density = counts.cast / facets.area
        self.area = counts.met + counts.met.T
        self._of = np.repeat(np.arange(len(facets), dtype=np.int32), np.diff(self.area.indptr))
        count = self.area.data
        self._by_rays()
        self.lines = 0
        chosen = np.flatnonzero(count >= FEW)
        chosen = chosen[self._of[chosen] < self.area.indices[chosen]]
        if len(chosen):
            self._refine(chosen, seed)

    def _by_rays(self):
        """From how many rays connect them, both ways; each way is binomial."""
        # The diagonal has been counted twice, as has its density.
        j, each = self.area.indices, np.diff(self.area.indptr)
        both = np.repeat(self.density, each)
        both += self.density[j]
        area = self.area.data / both
        part = self.density / self.facets.area
        variance = np.repeat(part, each)
        variance += part[j]
        variance *= area
        np.subtract(both, variance, out=variance)
        variance *= area
        variance /= both
        variance /= both
        self.variance = np.maximum(variance, 0, dtype=np.float32)
        self.unit = np.reciprocal(both, dtype=np.float32)
        self.area = like(self.area, area)

    def _refine(self, chosen, seed):
        """Replace the ray estimates of pairs i < j by those of sample lines, where enough rays are expected.

        There are as many lines as rays would connect the cells in full view. Σ k V / Σ k is the visible share. The
        weight of each half of the lines depends on the other half only: a weight that depended on the estimate itself
        would shift its mean.
        """
        i, j = self._of[chosen], self.area.indices[chosen]
        whole, both = exchange_area(self.facets.corners[i], self.facets.corners[j]), self.density[i] + self.density[j]
        blocks = 2 * np.ceil((1 + whole * both) / (2 * LINES)).astype(np.int64)
        self.lines = LINES * int(blocks.sum())
        k, k2, seen, seen2 = sums = visible_sums(self.facets, i, j, whole, blocks, seed, self.progress)
        share = _ratio(seen, k)
        weight = np.clip((whole * both * share - RAMP[0]) / (RAMP[1] - RAMP[0]), 0, 1)[::-1]
        by_rays = 1 - weight.mean(axis=0)
        area = by_rays * self.area.data[chosen] + whole * (weight * share).mean(axis=0)
        k, k2, seen, seen2 = sums.sum(axis=1)
        share = _ratio(seen, k)
        spread = whole**2 * _ratio((1 - share) ** 2 * seen2 + share**2 * (k2 - seen2), k**2)
        variance = by_rays**2 * self.variance[chosen] + (weight**2).mean(axis=0) * spread
        # A line counts for more where few lines hold most of the kernel: k² / k on average.
        unit = np.maximum(by_rays * self.unit[chosen], weight.mean(axis=0) * whole * _ratio(k2, k**2))
        for places in (chosen, self._places(j, i)):
            self.area.data[places], self.variance[places], self.unit[places] = area, variance, unit

    def _places(self, i, j):
        """Where in the data entries (i, j) are (int [n])."""
        keys = (self._of.astype(np.int64) << 32) | self.area.indices
        return np.searchsorted(keys, (i.astype(np.int64) << 32) | j)

    def rows(self, n):
        """Exchange areas (SciPy CSR), and their variances and units, between the ``n`` rows of the facets."""
        if n == len(self.facets):
            return self.area, self.variance, self.unit
        i, j = self.facets.row[self._of], self.facets.row[self.area.indices]
        # Two cells of one row are there twice, with one error.
        variance = self.variance * np.where((i == j) & (self._of != self.area.indices), 2, 1)
        kind = optional("scipy.sparse", "a matrix of view factors", "factors").coo_array
        area, variance = (kind((data, (i, j)), (n, n)).tocsr() for data in (self.area.data, variance))
        keys, entry = np.unique(i.astype(np.int64) * n + j, return_inverse=True)
        unit = np.zeros(len(keys))
        np.maximum.at(unit, entry, self.unit)
        return area, variance.data, unit


# ---- From exchange areas to a matrix -----------------------------------------------------------------


def _closed(facets, counts, flow, start):
    """The matrix of the rows, closed."""
    n, row = len(facets.names), facets.row
    X, V, unit = flow.rows(n)
    V = V + UNSEEN * unit**2
    # Where rays end outside, and starts on covered area: what the rows sum to is known, how much is covered is not.
    columns = np.column_stack([counts.outside, counts.cast - counts.kept])
    there = np.flatnonzero(columns.any(axis=0))
    binomial = columns * (1 - columns / np.maximum(counts.cast, 1)[:, None])
    ray = 1 / flow.density  # m² per ray
    unseen = np.zeros(n)
    np.maximum.at(unseen, row, ray)

    def by_rows(values, per_ray):
        return np.array([np.bincount(row, weights=values[:, k] * per_ray, minlength=n) for k in there]).reshape(-1, n)

    O, P = by_rows(columns, ray), by_rows(binomial, ray**2) + UNSEEN * unseen**2  # exchange areas and their variances
    whole = np.bincount(row, weights=facets.area, minlength=n)
    closed, beyond = balance(X, _ratio(V, X.data), O, _ratio(P, O), whole)
    outside = there < len(OUTSIDE)
    covered = np.where(O[~outside] > 0, P[~outside], 0).sum(axis=0)  # variance of the areas
    kept = np.bincount(row, weights=counts.kept, minlength=n) > 0
    areas = np.where(kept, np.maximum(whole - beyond[~outside].sum(axis=0), 0), 0)
    O, P, beyond = O[outside], P[outside], beyond[outside]
    over = _ratio(np.ones(n), areas)

    def matrix(inner, outer):
        """Entries over the areas of the rows, with columns for the outside."""
        inner = inner * np.repeat(over, np.diff(X.indptr)).astype(inner.dtype)
        return _with_columns(like(X, inner), outer * over)

    F = matrix(closed, beyond)
    of_areas = np.repeat(covered * over**2, np.diff(X.indptr))
    error = matrix(np.sqrt(V + of_areas * closed**2), np.sqrt(P + covered * over**2 * beyond**2))
    raw = _ratio(X.sum(axis=1) + O.sum(axis=0), areas)
    closed -= X.data
    closed *= np.repeat(over, np.diff(X.indptr))
    change = [np.abs(closed), np.abs((beyond - O) * over).ravel()]
    return ViewFactors(
        F=F,
        error=error,
        names=(*facets.names, *(OUTSIDE[k] for k in there[outside])),
        areas=areas,
        closure=Closure(
            raw_row_error=float(np.abs(raw - 1)[areas > 0].max(initial=0)),
            row_error=float(np.abs(F.sum(axis=1) - 1)[areas > 0].max(initial=0)),
            largest=float(max(x.max(initial=0) for x in change)),
            mean=float(sum(x.sum() for x in change) / max(F.nnz, 1)),
        ),
        stats={"rays": int(counts.cast.sum()), "lines": flow.lines, "seconds": time.perf_counter() - start},
    )


def _with_columns(matrix, columns):
    """A CSR matrix [n, m] with dense columns [k, n] behind its own."""
    (n, m), k = matrix.shape, len(columns)
    if k == 0:
        return matrix
    row = np.repeat(np.arange(n, dtype=np.int32), np.diff(matrix.indptr))
    own = np.arange(matrix.nnz) + k * row
    added = matrix.indptr[1:] + k * np.arange(n) + np.arange(k)[:, None]
    data, indices = np.empty(matrix.nnz + k * n, matrix.dtype), np.empty(matrix.nnz + k * n, np.int32)
    data[own], indices[own] = matrix.data, matrix.indices
    data[added], indices[added] = columns, m + np.arange(k)[:, None]
    return type(matrix)((data, indices, matrix.indptr + k * np.arange(n + 1)), shape=(n, m + k))


def _ratio(a, b):
    """a / b, 0 where b is."""
    return np.where(b > 0, a / np.where(b > 0, b, 1), 0)
