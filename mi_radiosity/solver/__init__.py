"""Hierarchical Monte Carlo radiosity: elements, pairs, refinement, power; solve() ─► Solution."""

from .solution import Solution
from .solve import solve

__all__ = ["Solution", "solve"]
