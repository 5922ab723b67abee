"""Kernel smoothness."""

import drjit as dr
import mitsuba as mi

from .base import KernelSamples, Oracle, Pair


class KS(Oracle):
    """σ_ij = max(F_max − F_avg, F_avg − F_min) A_j  (eq. 4; the paper prints F_max twice by mistake).

    F_max, F_min and F_avg are taken over the S lines of the pair; σ has no unit.
    Source: Gortler, Schröder, Cohen, Hanrahan, "Wavelet radiosity", SIGGRAPH 1993.
    """

    name = "ks"

    def sigma(self, samples: KernelSamples, pair: Pair) -> "mi.Float64":
        mean = samples.mean()
        return dr.maximum(samples.max() - mean, mean - samples.min()) * pair.area_source
