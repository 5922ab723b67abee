"""Oracles from generalised mutual information (Havrda-Charvát-Tsallis), and their common kernel."""

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import RadiosityError
from ..core.llvm import require_variant
from ..core.numbers import real_number
from .base import KernelSamples, Oracle, Pair

NEAR_ONE = 2.0**-5  # |u − 1| below which φ_α is summed as a series
TERMS = 9  # of the series: the first left out is below 1e-14 of the sum


def _expm1_ratio(z):
    """(e^z − 1)/z without cancellation (Float64). Kahan: rounding of e^z cancels in the quotient."""
    e = dr.exp(z)
    log_e = dr.log(e)
    exact = dr.select(dr.abs(z) < 1e-5, 1 + z / 2 + z * z / 6, (e - 1) / dr.select(log_e == 0, 1, log_e))
    return dr.select(dr.abs(z) > 1, (e - 1) / z, exact)


def _phi(u, d, alpha):
    """φ_α(u) = (u^α − 1 − α(u − 1)) / (α − 1) ≥ 0, φ_1(u) = u ln u − u + 1 (Float64).

    Away from u = 1 as u ln u · (e^z − 1)/z − (u − 1) with z = (α − 1) ln u, which holds for α = 1
    too; near u = 1 as α (d²/2! + (α − 2) d³/3! + (α − 2)(α − 3) d⁴/4! + …) with d = u − 1,
    which the caller computes from what u was made of.
    """
    log_u = dr.log(dr.select(u > 0, u, 1))
    far = u * log_u * _expm1_ratio((alpha - 1) * log_u) - d
    near = alpha * d * d * _series(d, alpha)
    return dr.select(u > 0, dr.select(dr.abs(d) < NEAR_ONE, near, dr.maximum(far, 0)), 1)


def _series(d, alpha):
    """1/2! + (α − 2) d/3! + (α − 2)(α − 3) d²/4! + … by Horner's rule."""
    total = mi.Float64(0)
    for k in range(TERMS + 2, 2, -1):
        total = (alpha - k + 1) * d / k * (1 + total)
    return (1 + total) / 2


def information_gap(F: KernelSamples | ArrayLike, alpha: float) -> "mi.Float64":
    """Loss of information by discretising pairs: δ_α/(1 − α) (eq. 15 with the factor of eq. 14).

        δ_α = (mean F)^α − mean F^α

    evaluated as m^α · mean φ_α(F/m), m = mean F, in which no term cancels. It is ≥ 0, exactly 0 for
    equal samples, and continuous in α; at α = 1 it is mean(F ln F) − m ln m.

    F: samples of the kernel in 1/m², ≥ 0: KernelSamples, or anything NumPy takes as [pairs, lines].
    alpha: index α > 0. Returns Float64 [pairs], in m^(−2α).
    Raises RadiosityError for α ≤ 0 and for NaN, infinite or negative samples in a [pairs, lines] array.
    Source: Rigau, Feixas, Sbert, "A generalised-mutual-information-based oracle for hierarchical radiosity".
    """
    alpha = real_number("alpha", alpha, 0)
    require_variant()
    samples = F if isinstance(F, KernelSamples) else _samples(F)
    if samples.pairs == 0:
        return mi.Float64()
    alpha = dr.opaque(mi.Float64, alpha)
    mean = samples.mean()
    scale = dr.select(mean > 0, mean, 1)
    gap = samples.reduce(lambda a, b: a + b, lambda f: _phi(f / scale, (f - mean) / scale, alpha)) / samples.lines
    return dr.select(mean > 0, dr.exp(alpha * dr.log(scale)) * gap, 0)


def _samples(F):
    """KernelSamples from an array [pairs, lines], refusing what is no kernel value."""
    array = np.atleast_2d(np.asarray(F, dtype=np.float64))
    if array.ndim != 2 or not array.shape[1]:
        raise RadiosityError(f"F has the shape {array.shape}: give kernel samples as [pairs, lines]")
    if not np.isfinite(array).all() or (array < 0).any():
        raise RadiosityError("F has samples that are negative or not finite: kernel values are 0 or more")
    return KernelSamples(mi.Float64(array.ravel()), array.shape[1])


@dataclass(frozen=True)
class GMI(Oracle):
    """σ_ij = A_i A_j A_T^(α−2) δ_α/(1−α)  (eq. 14): the loss of generalised mutual information.

    Eq. 16 read literally drops 1/(1−α) and so never refines for α ≥ 1; with the factors kept, σ is
    ≥ 0, has no unit, does not depend on the scale of the scene and passes smoothly through α = 1.
    """

    alpha: float = 0.5
    name = "gmi"

    def __post_init__(self) -> None:
        object.__setattr__(self, "alpha", real_number("alpha", self.alpha, 0))

    def sigma(self, samples: KernelSamples, pair: Pair) -> "mi.Float64":
        scale = dr.opaque(mi.Float64, pair.total_area ** (self.alpha - 2))
        return pair.area_receiver * pair.area_source * scale * information_gap(samples, self.alpha)


@dataclass(frozen=True)
class MI(GMI):
    """σ_ij = A_i A_j / A_T (mean(F ln F) − F_avg ln F_avg): Shannon's limit α → 1 of GMI.

    Source: Feixas, Rigau, Bekaert, Sbert, "Information-theoretic oracle based on kernel smoothness
    for hierarchical radiosity", Eurographics 2002.
    """

    alpha: float = field(default=1.0, init=False)
    name = "mi"
