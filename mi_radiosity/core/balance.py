"""Balancing a symmetric matrix: its rows get given sums, at the cost of the entries known worst."""

from typing import Any

import numpy as np

from .extras import optional

ROUNDS = 60  # of Newton's method
CLOSE = 1e-13  # relative error of the sums that is as good as none
ACCURACY = 1e-7, 1e-2  # of the linear systems, which goes with the error
LEAST = 1e-10  # of the largest sum: smallest weight, so that sure entries give way if nothing else can


def balance(matrix: Any, weight: np.ndarray, outside: np.ndarray, give: np.ndarray, sums: np.ndarray) -> tuple:
    """X'_ij = X_ij g(w_ij (y_i + y_j)) and O'_ki = O_ki g(v_ki y_i) with Σ_j X'_ij + Σ_k O'_ki = s_i.

    g(t) is 1 + t for t > 0 and exp(t) for t < 0: entries grow as in least squares, and shrink without changing sign.
    An exponential on both sides would let one entry of large variance explode where a sure row needs a large y.

    matrix: X, symmetric and ≥ 0 (SciPy CSR [n, n]); weight: w of its entries, symmetric: variance over value;
    outside, give: O and v [k, n]; sums: s ≥ 0 [n]. X' is symmetric and ≥ 0, and keeps zeros. Entries change by their
    variance times y_i + y_j, which to first order is the least change in units of their errors. y minimises the convex
    function whose gradient is the excess of the sums, by Newton's method. Returns the data of X', and O'. Rows that are
    empty, or whose sum is 0, stay as they are. The best y found is used where none fits, as with two facets of
    different size that see nothing but each other.
    """
    linalg = optional("scipy.sparse.linalg", "the closing of view factors", "factors")
    least = LEAST * sums.max(initial=0)
    weight, give = np.maximum(weight, least), np.maximum(give, least)
    ones, each = np.ones(len(sums)), np.diff(matrix.indptr)
    idle = (matrix @ ones + outside.sum(axis=0) <= 0) | (sums <= 0)
    target = np.where(idle, 1.0, sums)
    inner, slopes = (like(matrix, np.empty(matrix.nnz)) for _ in range(2))  # filled again and again

    def at(y):
        """Fill X' and ∂X'/∂y; O' and ∂O'/∂y, and by how much rows miss their sums."""
        data = np.take(y, matrix.indices, out=inner.data, mode="clip")
        data += np.repeat(y, each)
        data *= weight
        np.exp(np.minimum(data, 0, out=slopes.data), out=slopes.data)
        np.maximum(data, 0, out=data)
        data += slopes.data
        data *= matrix.data
        slopes.data *= matrix.data
        slopes.data *= weight
        shrunk = np.exp(np.minimum(give * y, 0))
        outer = outside * (np.maximum(give * y, 0) + shrunk)
        return outer, outside * shrunk * give, np.where(idle, 0.0, inner @ ones + outer.sum(axis=0) - target)

    y = best = np.zeros(len(sums))
    (outer, outer_slopes, miss), least = at(y), np.inf
    for _ in range(ROUNDS):
        error = np.abs(miss / target).max(initial=0)
        if error < least:
            best, least = y, error
        if error < CLOSE:
            break
        diagonal = np.where(idle, 1.0, slopes @ ones + outer_slopes.sum(axis=0))
        hessian = linalg.LinearOperator(matrix.shape, lambda v: diagonal * v + slopes @ v)
        jacobi = linalg.LinearOperator(matrix.shape, lambda v: v / diagonal)
        with np.errstate(all="ignore"):  # singular where no y fits
            accuracy = np.clip(error, *ACCURACY)
            step = np.nan_to_num(linalg.cg(hessian, -miss, rtol=accuracy, maxiter=300, M=jacobi)[0])
        slope, length = miss @ step, 1.0
        outer, outer_slopes, miss = at(y + step)
        # The slope along the step only grows: halve until it is small enough.
        while abs(miss @ step) > 0.9 * abs(slope) and length > 1e-6:
            length /= 2
            outer, outer_slopes, miss = at(y + length * step)
        y = y + length * step
    if y is not best:
        outer, *_ = at(best)
    return inner.data, outer


def like(matrix: Any, data: np.ndarray) -> Any:
    """Other values in the same places."""
    return type(matrix)((data, matrix.indices, matrix.indptr), shape=matrix.shape)
