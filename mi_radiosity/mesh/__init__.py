"""Elements and pairs: what a scene is divided into, and who exchanges power with whom."""

from .clusters import Clusters
from .elements import Elements, Tree
from .exposure import Exposure
from .pairs import Pairs

__all__ = ["Clusters", "Elements", "Exposure", "Pairs", "Tree"]
