"""Elements and pairs: what a scene is divided into, and who exchanges power with whom."""

from .clusters import Clusters, cluster_labels
from .elements import MAX_LEVEL, Elements, Tree
from .exposure import Exposure, crossed_leaves
from .pairs import Pairs
from .scattering import Scattering

__all__ = [
    "MAX_LEVEL",
    "Clusters",
    "Elements",
    "Exposure",
    "Pairs",
    "Scattering",
    "Tree",
    "cluster_labels",
    "crossed_leaves",
]
