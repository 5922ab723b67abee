"""Balancing a symmetric matrix: its rows get given sums, at the cost of the entries known worst."""

from typing import Any

import numpy as np

from .extras import optional

ROUNDS = 60  # of Newton's method
CLOSE = 1e-13  # relative error of the sums that is as good as none
ACCURACY = 1e-5  # of the linear systems
LEAST = 1e-10  # weight; what is certain gives way if nothing else can


def balance(matrix: Any, weight: np.ndarray, outside: np.ndarray, give: np.ndarray, sums: np.ndarray) -> tuple:
    """X'_ij = X_ij exp(w_ij (y_i + y_j)) and O'_ki = O_ki exp(v_ki y_i) with Σ_j X'_ij + Σ_k O'_ki = s_i.

    matrix: X, symmetric and ≥ 0 (SciPy CSR [n, n]); weight: w of its entries, symmetric, their relative variances;
    outside, give: O and v [k, n]; sums: s ≥ 0 [n]. X' is symmetric and ≥ 0, and keeps zeros; entries change in
    proportion to their variance, which to first order is the least change in units of their errors. y minimises the
    convex Σ ½ X'/w + Σ O'/v − Σ s y, by Newton's method. Returns the data of X', and O'. Rows that are empty, or whose
    sum is 0, stay as they are; the best y met is used where none fits, as with two facets of different size that see
    nothing but each other.
    """
    linalg = optional("scipy.sparse.linalg", "the closing of view factors", "factors")
    weight, give = np.maximum(weight, LEAST), np.maximum(give, LEAST)
    row = np.repeat(np.arange(len(sums), dtype=np.int32), np.diff(matrix.indptr))
    ones = np.ones(len(sums))
    idle = (matrix @ ones + outside.sum(axis=0) <= 0) | (sums <= 0)
    target = np.where(idle, 1.0, sums)

    def at(y):
        """X' and O', and by how much rows miss their sums."""
        with np.errstate(over="ignore", invalid="ignore"):
            data = y[row]
            data += y[matrix.indices]
            data *= weight
            np.exp(data, out=data)
            data *= matrix.data
            inner, outer = like(matrix, data), outside * np.exp(give * y)
            return inner, outer, np.where(idle, 0.0, inner @ ones + outer.sum(axis=0) - target)

    y = np.zeros(len(sums))
    inner, outer, miss = at(y)
    best, least = (inner.data, outer), np.inf
    for _ in range(ROUNDS):
        error = np.abs(miss / target).max(initial=0)
        if error < least:
            best, least = (inner.data, outer), error
        if error < CLOSE:
            break
        slopes = like(inner, inner.data * weight)
        diagonal = np.where(idle, 1.0, slopes @ ones + (outer * give).sum(axis=0))
        hessian = linalg.LinearOperator(matrix.shape, lambda v: diagonal * v + slopes @ v)
        jacobi = linalg.LinearOperator(matrix.shape, lambda v: v / diagonal)
        with np.errstate(all="ignore"):  # singular where no y fits
            step = np.nan_to_num(linalg.cg(hessian, -miss, rtol=ACCURACY, maxiter=300, M=jacobi)[0])
        slope, length = miss @ step, 1.0
        while True:  # until the slope along the step, which only grows, is small enough
            trial = at(y + length * step)
            if not abs(trial[2] @ step) > 0.9 * abs(slope) or length < 1e-6:
                break
            length /= 2
        y, (inner, outer, miss) = y + length * step, trial
    return best


def like(matrix: Any, data: np.ndarray) -> Any:
    """Other values in the same places."""
    return type(matrix)((data, matrix.indices, matrix.indptr), shape=matrix.shape)
