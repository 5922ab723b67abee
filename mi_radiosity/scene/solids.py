"""Which sides without a patch are the inside of a solid, and which have a room behind them.

The back of a one-sided face exchanges no light. A closed mesh with outward normals is a solid if nothing is inside of
it, and a room if emitters are: geometry alone does not tell. Light does: light paths from the emitters reach the inside
of a room, and never that of a solid.
"""

import numpy as np

from .faces import Faces
from .overlap import surfaces

MIN_HITS = 2  # of a smooth surface: a single hit may be a ray that slipped into a solid between two faces
SMOOTH = 0.7  # cosine between normals of neighbouring faces up to which they are one smooth surface


def seen_by_light(faces: Faces, hits: np.ndarray) -> np.ndarray:
    """Sides that light paths hit at least MIN_HITS times, together with the rest of their smooth surface, as paths do
    not hit all faces of a fine mesh (bool [2 · faces]).

    hits: of sides 2 · face + (1 for the back), see `LightPaths`.
    """
    if not hits.any():
        return np.zeros(len(hits), dtype=bool)
    surface = surfaces(faces.vertex, faces.normal, SMOOTH)
    of_side = np.column_stack([2 * surface, 2 * surface + 1]).ravel()
    return (np.bincount(of_side, weights=hits) >= MIN_HITS)[of_side]
