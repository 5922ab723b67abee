"""What an oracle is given and what it answers."""
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


@dataclass
class Pair:
    """Geometry of pairs of elements, one entry per pair. Areas are in m²."""
    area_receiver: "mi.Float64"     # A_i [pairs]
    area_source: "mi.Float64"       # A_j [pairs]
    total_area: float               # A_T of all patches


class KernelSamples:
    """Samples of F(x, y), in 1/m², along the S random lines of every pair; a blocked line counts 0.

    values: Float or Float64 [pairs · lines], the lines of one pair side by side.
    """

    def __init__(self, values, lines):
        self.values, self.lines = mi.Float64(values), lines
        self.pairs = dr.width(values) // lines

    def _line(self, number):
        first = dr.arange(mi.UInt32, self.pairs) * self.lines
        return dr.gather(mi.Float64, self.values, first + number)

    def reduce(self, combine, function=lambda f: f):
        """Fold ``combine`` over function(F) of the lines of each pair (Float64 [pairs])."""
        result = function(self._line(0))
        for number in range(1, self.lines):
            result = combine(result, function(self._line(number)))
        return result

    def mean(self, function=lambda f: f):
        """Mean of function(F), exact when all samples of a pair are equal (Float64 [pairs])."""
        first = function(self._line(0))
        return first + self.reduce(lambda a, b: a + b, lambda f: function(f) - first) / self.lines

    def max(self):
        return self.reduce(dr.maximum)

    def min(self):
        return self.reduce(dr.minimum)


class Oracle:
    """A refinement criterion: a pair (i, j) is accepted when ρ_i σ_ij B_j < ε.

    A subclass defines ``sigma``. Set ``weighted = False`` if σ alone decides, and
    ``uses_lines = False`` if σ needs no samples of F (then ``samples`` is None and no ray is traced).
    """
    name = "oracle"
    alpha = None
    weighted = True
    uses_lines = True

    def sigma(self, samples, pair):
        """σ_ij ≥ 0 from KernelSamples and Pair (Float64 [pairs])."""
        raise NotImplementedError(f"{type(self).__name__} must define sigma(samples, pair)")

    def __str__(self):
        return self.name
