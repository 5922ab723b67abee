"""Hierarchical Monte Carlo radiosity for Mitsuba 3, refined by generalised mutual information."""

from .core.llvm import choose_llvm as _choose_llvm

_choose_llvm()  # before anything imports drjit

import mitsuba as _mi

from .display import register as _register
from .core.errors import RadiosityError
from .oracles import GMI, KS, MI, KernelSamples, Oracle, Pair, Power, Uniform, information_gap
from .solver import Solution, solve

__version__ = "0.1.0"
__all__ = [
    "solve",
    "Solution",
    "Oracle",
    "Pair",
    "KernelSamples",
    "GMI",
    "KS",
    "MI",
    "Power",
    "Uniform",
    "information_gap",
    "RadiosityError",
]

_register()
_mi.detail.add_variant_callback(_register)
