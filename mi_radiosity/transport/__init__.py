"""How power gets about: emitted, deposited, tallied, summed up; and gathered where it is asked for."""

from .gather import Gatherer
from .problem import Flow, Problem
from .series import PILOT, Shooting, Transport
from .starved import Starved

__all__ = ["PILOT", "Flow", "Gatherer", "Problem", "Shooting", "Starved", "Transport"]
