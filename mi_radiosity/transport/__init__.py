"""How power gets about: emitted, deposited, tallied, summed up; and gathered where it is asked for."""

from .factors import Closure, ViewFactors, view_factors
from .gather import Gatherer, Places
from .gathering import Gathering
from .paths import PathEnd, Paths
from .problem import Flow, Problem
from .series import PILOT, Shooting, Transport

__all__ = [
    "PILOT",
    "Closure",
    "Flow",
    "Gatherer",
    "Gathering",
    "PathEnd",
    "Paths",
    "Places",
    "Problem",
    "Shooting",
    "Transport",
    "ViewFactors",
    "view_factors",
]
