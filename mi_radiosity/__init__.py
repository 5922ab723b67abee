"""Hierarchical Monte Carlo radiosity for Mitsuba 3, refined by generalised mutual information."""

from .core.llvm import choose_llvm as _choose_llvm

_choose_llvm()  # before anything imports drjit

import mitsuba as _mi

from .core.errors import RadiosityError, RadiosityWarning
from .core.plugins import welcome_installed as _welcome_installed
from .display import Shader
from .display import register as _register
from .export import export
from .export import view as _view
from .export.factors import read_factors, write_factors
from .oracles import GMI, KS, MI, KernelSamples, Oracle, Pair, Power, Uniform, information_gap
from .scene import Light, mesher
from .solver import Solution, solve
from .transport import Gathering, Shooting, Transport, ViewFactors, view_factors

__version__ = "0.2.0"
__all__ = [
    "GMI",
    "KS",
    "MI",
    "Gathering",
    "KernelSamples",
    "Light",
    "Oracle",
    "Pair",
    "Power",
    "RadiosityError",
    "RadiosityWarning",
    "Shader",
    "Shooting",
    "Solution",
    "Transport",
    "Uniform",
    "ViewFactors",
    "export",
    "information_gap",
    "mesher",
    "read_factors",
    "solve",
    "view_factors",
    "write_factors",
]

Solution.view = _view  # type: ignore[attr-defined]  # rooms below do not know of this one


def _follow_variant(*_: object) -> None:
    if _mi.variant():
        _register()
        _welcome_installed()


_follow_variant()
_mi.detail.add_variant_callback(_follow_variant)
