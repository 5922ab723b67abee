"""Hierarchical Monte Carlo radiosity: from patches to a mesh, and solve() ─► Solution."""

from .solution import Leaves, Solution
from .solve import solve

__all__ = ["Leaves", "Solution", "solve"]
