"""How power gets about: emitted, deposited, tallied, summed up; and gathered where it is asked for."""

from .gather import Gatherer, Places
from .gathering import Gathering
from .problem import Flow, Problem
from .series import PILOT, Shooting, Transport

__all__ = ["PILOT", "Flow", "Gatherer", "Gathering", "Places", "Problem", "Shooting", "Transport"]
