"""Transported power."""

import mitsuba as mi

from .base import KernelSamples, Oracle, Pair


class Power(Oracle):
    """σ_ij = F_avg A_i A_j, in m²: with ρ_i B_j, the power that travels from j to i and is reflected.

    Source: Hanrahan, Salzman, Aupperle, "A rapid hierarchical radiosity algorithm", SIGGRAPH 1991
    (their BF refinement).
    """

    name = "power"

    def sigma(self, samples: KernelSamples, pair: Pair) -> "mi.Float64":
        return samples.mean() * pair.area_receiver * pair.area_source
