"""Hierarchical Monte Carlo radiosity for Mitsuba 3, refined by generalised mutual information."""

from .core.llvm import choose_llvm as _choose_llvm

_choose_llvm()  # before anything imports drjit

import mitsuba as _mi

from .core.errors import RadiosityError
from .display import Shader
from .display import register as _register
from .export.factors import read_factors, write_factors
from .oracles import GMI, KS, MI, KernelSamples, Oracle, Pair, Power, Uniform, information_gap
from .scene import Light, mesher
from .solver import Solution, solve
from .transport import Shooting, Transport, ViewFactors, view_factors

__version__ = "0.2.0"
__all__ = [
    "GMI",
    "KS",
    "MI",
    "KernelSamples",
    "Light",
    "Oracle",
    "Pair",
    "Power",
    "RadiosityError",
    "Shader",
    "Shooting",
    "Solution",
    "Transport",
    "Uniform",
    "ViewFactors",
    "information_gap",
    "mesher",
    "read_factors",
    "solve",
    "view_factors",
    "write_factors",
]

_register()
_mi.detail.add_variant_callback(_register)
