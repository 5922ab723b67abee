"""How power gets about: emitted, deposited, tallied, summed up; and gathered where it is asked for."""

from .factors import Closure, ViewFactors, view_factors
from .gather import Gatherer
from .problem import Flow, Problem
from .series import PILOT, Shooting, Transport
from .starved import Starved

__all__ = [
    "PILOT",
    "Closure",
    "Flow",
    "Gatherer",
    "Problem",
    "Shooting",
    "Starved",
    "Transport",
    "ViewFactors",
    "view_factors",
]
