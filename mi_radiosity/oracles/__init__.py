"""Refinement criteria: statistics of one pair of elements ─► one number σ, one criterion per file."""
from ..errors import RadiosityError
from .base import KernelSamples, Oracle, Pair
from .information import GMI, MI, information_gap
from .power import Power
from .smoothness import KS
from .uniform import Uniform

ORACLES = {"ks": KS, "mi": MI, "gmi": GMI, "power": Power, "uniform": Uniform}


def make_oracle(name, alpha=None):
    """The oracle called ``name``; ``alpha`` (default 0.5) belongs to ``gmi`` alone."""
    if name not in ORACLES:
        raise RadiosityError(f"unknown oracle '{name}': choose one of {', '.join(ORACLES)}")
    if name == "gmi":
        return GMI(0.5 if alpha is None else alpha)
    if alpha is not None:
        raise RadiosityError(f"the oracle '{name}' has no alpha: leave it out or choose gmi")
    return ORACLES[name]()


__all__ = ["Oracle", "Pair", "KernelSamples", "KS", "MI", "GMI", "Power", "Uniform", "information_gap", "ORACLES", "make_oracle"]
