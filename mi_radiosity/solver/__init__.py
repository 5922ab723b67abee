"""Hierarchical Monte Carlo radiosity: from patches to a mesh, and solve() ─► Solution."""

from .field import Field
from .solution import LUMENS_PER_WATT, LUMINANCE, Leaves, Solution
from .solve import solve

__all__ = ["LUMENS_PER_WATT", "LUMINANCE", "Field", "Leaves", "Solution", "solve"]
