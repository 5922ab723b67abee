"""What an oracle is given and what it answers."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.errors import RadiosityError
from ..core.plugins import Registry

ORACLES = Registry("oracle")


@dataclass(frozen=True)
class Pair:
    """Pairs of elements as an oracle sees them, one entry per pair: receiver i, source j.

    ``rho`` and ``B`` are None while σ is asked for: they change, and σ is kept.
    """

    area_receiver: "mi.Float64"  # A_i, m² [pairs]
    area_source: "mi.Float64"  # A_j, m² [pairs]
    total_area: float  # A_T of all patches, m²
    level_receiver: "mi.UInt32" = None  # how often i and j were split from their patches [pairs]
    level_source: "mi.UInt32" = None
    rho: "mi.Color3f" = None  # ρ_i [pairs]
    B: "mi.Color3f" = None  # B_j known so far, emission included, W/m² [pairs]


class KernelSamples:
    """Samples of F(x, y), in 1/m², along the S random lines of every pair; a blocked line counts 0.

    values: Float or Float64 [pairs · lines], the lines of one pair side by side.
    """

    def __init__(self, values: "mi.Float64", lines: int):
        self.values, self.lines = mi.Float64(values), lines
        self.pairs = dr.width(values) // lines

    def _line(self, number: int) -> "mi.Float64":
        first = dr.arange(mi.UInt32, self.pairs) * self.lines
        return dr.gather(mi.Float64, self.values, first + number)

    def reduce(self, combine: Callable, function: Callable = lambda f: f) -> "mi.Float64":
        """Fold ``combine`` over function(F) of the lines of each pair (Float64 [pairs])."""
        result = function(self._line(0))
        for number in range(1, self.lines):
            result = combine(result, function(self._line(number)))
        return result

    def mean(self, function: Callable = lambda f: f) -> "mi.Float64":
        """Mean of function(F), exact when all samples of a pair are equal (Float64 [pairs])."""
        first = function(self._line(0))
        return first + self.reduce(lambda a, b: a + b, lambda f: function(f) - first) / self.lines

    def max(self) -> "mi.Float64":
        return self.reduce(dr.maximum)

    def min(self) -> "mi.Float64":
        return self.reduce(dr.minimum)


class Oracle:
    """A refinement criterion: a pair (i, j) is accepted when its value, ρ_i σ_ij B_j, is below ε.

    A subclass gives itself a ``name``, by which the command line, XML and comparisons know it from then on, and
    defines `sigma`; it may define `value`, too. Arguments of its constructor are its parameters: the first of
    them is what stands behind the colon of ``NAME:PARAMETER``. ``uses_lines = False`` says that σ needs no
    samples of F: then ``samples`` is None and no ray is traced.
    """

    name = ""
    alpha: float | None = None
    uses_lines = True

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "name" in vars(cls):
            ORACLES.add(cls.name, cls)

    def sigma(self, samples: KernelSamples, pair: Pair) -> "mi.Float64 | tuple[mi.Float64, ...]":
        """What is kept of every pair: σ_ij ≥ 0, or several numbers as a tuple (Float64 [pairs])."""
        raise NotImplementedError(f"{type(self).__name__} must define sigma(samples, pair)")

    def value(self, sigma: "mi.Float", pair: Pair) -> "mi.Float":
        """What is compared with ε: max over channels of ρ_i σ_ij B_j (Float [pairs]).

        sigma: what `sigma` said of these pairs, in float32. A value of 0 is never split.
        """
        return sigma * dr.max(pair.rho * pair.B)

    def __str__(self) -> str:
        """NAME, or NAME:PARAMETER if the first argument of the constructor is kept by its name."""
        value = next((getattr(self, p, None) for p in inspect.signature(type(self)).parameters), None)
        return f"{self.name}:{value:g}" if isinstance(value, (int, float)) else self.name


def parse(text: str) -> Oracle:
    """The oracle meant by ``NAME`` or ``NAME:PARAMETER``, such as 'ks' or 'gmi:0.75'.

    Raises RadiosityError for unknown names and for parameters the oracle does not take.
    """
    name, colon, parameter = (part.strip() for part in text.partition(":"))
    cls = ORACLES.find(name)
    try:
        parameters = list(inspect.signature(cls).parameters.values())
    except ValueError:
        parameters = []
    if not colon:
        missing = [p.name for p in parameters if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD]
        if missing:
            raise RadiosityError(f"the oracle '{name}' needs its {missing[0]}: write {name}:{missing[0].upper()}")
        return cls()
    if not parameters:
        raise RadiosityError(f"the oracle '{name}' has no parameter: leave out ':{parameter}'")
    try:
        return cls(float(parameter))
    except RadiosityError:
        raise
    except (TypeError, ValueError):
        raise RadiosityError(
            f"'{text}': the {parameters[0].name} of '{name}' must be a number, such as {name}:0.5"
        ) from None


def make_oracle(name: str, alpha: float | None = None) -> Oracle:
    """The oracle called ``name`` (or ``NAME:PARAMETER``); ``alpha`` is the parameter of those that have an alpha."""
    if alpha is None:
        return parse(name)
    cls = ORACLES.find(name.partition(":")[0].strip())
    if ":" in name or "alpha" not in inspect.signature(cls).parameters:
        raise RadiosityError(f"the oracle '{name}' has no alpha: leave it out or choose gmi")
    return cls(alpha=alpha)
