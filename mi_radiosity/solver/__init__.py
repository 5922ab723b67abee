"""Hierarchical Monte Carlo radiosity: from patches to a mesh, and solve() ─► Solution."""

from .field import Field
from .solution import Leaves, Solution
from .solve import solve

__all__ = ["Field", "Leaves", "Solution", "solve"]
