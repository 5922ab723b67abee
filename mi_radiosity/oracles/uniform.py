"""The control: a mesh that knows nothing of the light."""

import drjit as dr
import mitsuba as mi

from .base import KernelSamples, Oracle, Pair


class Uniform(Oracle):
    """σ_ij = max(A_i, A_j), in m², alone: the largest element that sees another one is split."""

    name = "uniform"
    uses_lines = False

    def sigma(self, samples: KernelSamples, pair: Pair) -> "mi.Float64":
        return dr.maximum(pair.area_receiver, pair.area_source)

    def value(self, sigma: "mi.Float", pair: Pair) -> "mi.Float":
        return sigma
