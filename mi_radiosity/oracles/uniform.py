"""The control: a mesh that knows nothing of the light."""

import drjit as dr

from .base import Oracle


class Uniform(Oracle):
    """σ_ij = max(A_i, A_j), in m², alone: the largest element that sees another one is split."""

    name = "uniform"
    uses_lines = False

    def sigma(self, samples, pair):
        return dr.maximum(pair.area_receiver, pair.area_source)

    def value(self, sigma, pair):
        return sigma
