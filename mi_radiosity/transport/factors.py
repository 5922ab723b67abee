"""View factors: F_ij, the part of the light of facet i that comes straight to facet j."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import opaque_index, owned, runs
from ..core.balance import balance, like
from ..core.errors import RadiosityError, interruptible
from ..core.extras import optional
from ..core.numbers import whole_number
from ..core.points import Stream, hash_pair, kronecker, stream_seed, triangle
from ..mesh import Elements, Tree
from ..scene import Model
from ..scene.rays import kernel_in_full_view
from .contour import exchange_area
from .facets import AT_ONCE, OUTSIDE, Counts, Facets, count_rays

RAYS = {"shape": 1 << 17, "face": 1 << 10, "leaf": 1 << 10}  # per row, by default
FEW = 8  # rays between two cells that lines are worth
RAMP = 16, 64  # rays to expect between two cells from where on lines count, and decide alone
LINES = 8  # lines come in blocks of so many


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
    end there: "sky", "ground", and "backs", sides that have no material. error: standard errors, in the same places;
    where F has no entry it is below some 3 / rays. names: of the columns. areas: of the facets, without what lies under
    others or inside solids, m² [rows]. closure: what was adjusted. stats: rays, lines, seconds.
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

    Where few rays connect two faces (or leaves) their number is the estimate; where many do, it is their exchange area
    in full view, by contour integrals, times the share of as many lines between them that nothing blocks, weighted by
    the kernel. Raises RadiosityError for options and scenes that cannot be used.
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
    """Exchange areas A_i F_ij: a symmetric SciPy CSR ``area`` [cells, cells], and the ``variance`` of its data."""

    def __init__(self, facets: Facets, counts: Counts, seed: int, progress: Callable[[int, int], None]) -> None:
        self.facets, self.progress = facets, progress
        self.seed = opaque_index(stream_seed(seed, Stream.FACTORS, 1))
        self.density = counts.cast / facets.area  # rays per m²
        self.area = counts.met + counts.met.T
        self._of = np.repeat(np.arange(len(facets), dtype=np.int32), np.diff(self.area.indptr))
        count = self.area.data
        self._by_rays()
        self.lines = 0
        chosen = np.flatnonzero(count >= FEW)
        chosen = chosen[self._of[chosen] < self.area.indices[chosen]]
        if len(chosen):
            self._refine(chosen, count[chosen])

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
        self.area = like(self.area, area)

    def _refine(self, chosen, count):
        """Blend in what lines say of pairs i < j that ``count`` rays connect.

        What decides is how many rays should connect them by what the lines say, not how many do: a weight that goes
        with one of the estimates would shift the mean. Pairs that lines decide have FEW rays all but certainly.
        """
        i, j, corners = self._of[chosen], self.area.indices[chosen], self.facets.corners
        whole, blocks = exchange_area(corners[i], corners[j]), -(-count // LINES)
        self.lines = LINES * int(blocks.sum(dtype=np.int64))
        by_lines, spread = self._visible(i, j, whole, blocks)
        a = np.clip((by_lines * (self.density[i] + self.density[j]) - RAMP[0]) / (RAMP[1] - RAMP[0]), 0, 1)
        area = a * by_lines + (1 - a) * self.area.data[chosen]
        variance = a**2 * spread + (1 - a) ** 2 * self.variance[chosen]
        for places in (chosen, self._places(j, i)):
            self.area.data[places], self.variance[places] = area, variance

    def _places(self, i, j):
        """Where in the data entries (i, j) are (int [n])."""
        keys = (self._of.astype(np.int64) << 32) | self.area.indices
        return np.searchsorted(keys, (i.astype(np.int64) << 32) | j)

    def rows(self, n):
        """The same between the ``n`` rows of the facets."""
        if n == len(self.facets):
            return self.area, self.variance
        i, j = self.facets.row[self._of], self.facets.row[self.area.indices]
        # Two cells of one row are there twice, with one error.
        variance = self.variance * np.where((i == j) & (self._of != self.area.indices), 2, 1)
        kind = optional("scipy.sparse", "a matrix of view factors", "factors").coo_array
        area, variance = (kind((data, (i, j)), (n, n)).tocsr() for data in (self.area.data, variance))
        return area, variance.data

    def _visible(self, i, j, whole, blocks):
        """Exchange areas by ``blocks`` of lines, and their variances (two float64 [pairs]).

        The kernel k along lines, in units of its mean, and what of it is seen, k V: the mean of k V + β (1 − k), where
        β = cov(k V, k) / var(k). So in full view all variance is gone, and of other pairs that of k near edges that
        touch, where it is infinite. What n lines all agree on may still be wrong for one in n + 2.
        """
        pair, number = runs(blocks)
        unit = self.facets.area[i] * self.facets.area[j] / np.where(whole > 0, whole, np.inf)
        sums, most = np.zeros((4, len(pair))), AT_ONCE // LINES
        for start in range(0, len(pair), most):
            part = slice(start, start + most)
            columns = (owned(mi.UInt32, x) for x in (i[pair[part]], j[pair[part]], number[part]))
            values = self._kernels(*columns, owned(mi.Float, unit[pair[part]]))
            sums[:, part] = [np.array(dr.block_sum(x, LINES)) for x in values]
            self.progress(min(start + most, len(pair)), len(pair))
        lines = LINES * blocks
        k, k2, seen, seen2 = np.add.reduceat(sums, np.cumsum(blocks) - blocks, axis=1) / lines
        variance, covariance = k2 - k**2, seen2 - seen * k
        beta = np.clip(_ratio(covariance, np.where(variance > 1e-6 * k2, variance, 0)), 0, 1)
        beta = np.where(seen >= k, 1, beta)
        rest = np.maximum(seen2 - seen**2 - 2 * beta * covariance + beta**2 * variance, 0)
        share = np.clip(seen + beta * (1 - k), 0, 1)
        return whole * share, whole**2 * (rest / lines + 1 / (lines + 2.0) ** 2)

    def _kernels(self, i, j, number, unit):
        """k and k² along the lines of blocks, and the same of what is seen of it (four Float [LINES · blocks])."""
        e, p, rays = self.facets.elements, self.facets.model.patches, self.facets.model.rays
        i, j = (dr.gather(mi.UInt32, self.facets.cells, k) for k in (i, j))
        k = dr.arange(mi.UInt32, LINES * dr.width(i))
        of = k // LINES
        index = LINES * dr.gather(mi.UInt32, number, of) + k % LINES
        x0, x1, y0, y1 = kronecker(index, hash_pair(e.key(i), e.key(j)), self.seed, of)
        i, j = dr.gather(mi.UInt32, i, of), dr.gather(mi.UInt32, j, of)
        x, y = e.patch_point(i, *triangle(x0, x1)), e.patch_point(j, *triangle(y0, y1))
        i, j = dr.gather(mi.UInt32, e.patch, i), dr.gather(mi.UInt32, e.patch, j)
        n_i, n_j = (dr.gather(mi.Vector3f, p.normal, k) for k in (i, j))
        k = kernel_in_full_view(p.point(i, *x), n_i, p.point(j, *y), n_j) * dr.gather(mi.Float, unit, of)
        seen = dr.select(rays.kernel(i, *x, j, *y) > 0, k, 0)
        return k, k * k, seen, seen * seen


# ---- From exchange areas to a matrix -----------------------------------------------------------------


def _closed(facets, counts, flow, start):
    """The matrix of the rows, closed."""
    n, row = len(facets.names), facets.row
    X, V = flow.rows(n)
    ray = 1 / flow.density  # m² per ray
    areas = np.bincount(row, weights=counts.kept * ray, minlength=n)
    there = np.flatnonzero(counts.outside.any(axis=0))

    def outer(values, per_ray):
        return np.array([np.bincount(row, weights=values[:, k] * per_ray, minlength=n) for k in there]).reshape(-1, n)

    O, P = outer(counts.outside, ray), outer(_binomial(counts), ray**2)  # exchange areas and their variances
    closed, beyond = balance(X, _relative(V, X.data), O, _relative(P, O), areas)
    over = np.where(areas > 0, 1 / np.where(areas > 0, areas, 1), 0)

    def matrix(inner, outer):
        """Entries over the areas of the rows, with columns for the outside."""
        inner = inner * np.repeat(over, np.diff(X.indptr)).astype(inner.dtype)
        return _with_columns(like(X, inner), outer * over)

    F, error = matrix(closed, beyond), matrix(np.sqrt(V) * _ratio(closed, X.data), np.sqrt(P) * _ratio(beyond, O))
    closed -= X.data
    closed *= np.repeat(over, np.diff(X.indptr))
    change = [np.abs(closed), np.abs((beyond - O) * over).ravel()]
    return ViewFactors(
        F=F,
        error=error,
        names=(*facets.names, *(OUTSIDE[k] for k in there)),
        areas=areas,
        closure=Closure(
            raw_row_error=float(np.abs((X.sum(axis=1) + O.sum(axis=0)) * over - 1)[areas > 0].max(initial=0)),
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


def _binomial(counts):
    """Variances of how many rays go where outside [cells, OUTSIDE]."""
    return counts.outside * (1 - counts.outside / np.maximum(counts.kept, 1)[:, None])


def _relative(variance, value):
    return _ratio(variance, value**2)


def _ratio(a, b):
    """a / b, 0 where b is."""
    return np.where(b > 0, a / np.where(b > 0, b, 1), 0)
