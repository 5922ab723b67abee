"""Hierarchical Monte Carlo radiosity: from patches to a mesh, and solve() ─► Solution."""

from .cost import SOLVING_SHARE
from .field import Field
from .solution import Leaves, Solution
from .solve import solve

__all__ = ["SOLVING_SHARE", "Field", "Leaves", "Solution", "solve"]
