"""Elements and pairs: what a scene is divided into, and who exchanges power with whom."""

from .elements import Elements, Tree
from .exposure import Exposure
from .pairs import Pairs

__all__ = ["Elements", "Exposure", "Pairs", "Tree"]
