"""Refinement criteria: statistics of one pair of elements ─► one number σ, one criterion per file."""

from .base import ORACLES, KernelSamples, Oracle, Pair, make_oracle, parse
from .information import GMI, MI, information_gap
from .power import Power
from .smoothness import KS
from .uniform import Uniform

__all__ = [
    "GMI",
    "KS",
    "MI",
    "ORACLES",
    "KernelSamples",
    "Oracle",
    "Pair",
    "Power",
    "Uniform",
    "information_gap",
    "make_oracle",
    "parse",
]
