"""Many hours of light from one solution."""

from collections.abc import Sequence

import numpy as np

from ..core.errors import RadiosityError
from ..solver import Solution
from ..solver.layers import Scales


def irradiance_over(solution: Solution, hours: Sequence[Scales]) -> np.ndarray:
    """Irradiance of the leaves in every hour, W/m² per channel (float32 [hours, leaves, 3]), in one matrix product.

    solution: solved with layers=True. hours: for each, what the lamps' emission is multiplied by, as in
    `Solution.relight`. The rows are those of `Solution.leaves`. Raises RadiosityError as that does.
    """
    if solution.layers is None:
        raise RadiosityError("this solution keeps no light by lamp: solve with layers=True")
    layers, leaves = solution.layers, np.array(solution.elements.leaves)
    scales = np.array([layers.read(hour) for hour in hours], dtype=np.float32).reshape(-1, len(layers.names), 3)
    light = layers.direct[:, :, leaves] + layers.indirect[:, :, leaves]  # [lamps, 3, leaves]
    return np.stack([scales[:, :, c] @ light[:, c] for c in range(3)], axis=2)
