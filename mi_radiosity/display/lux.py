"""`--shading lux`: illuminance in false colours."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned
from ..core.color import LUMENS_PER_WATT, LUMINANCE
from ..solver import Solution
from .shaders import Gouraud, Look

# Viridis (CC0, by Stéfan van der Walt and Nathaniel Smith) at 17 places, sRGB in thousandths.
VIRIDIS = (
    (267, 5, 329), (282, 95, 417), (279, 175, 483), (259, 252, 525), (230, 322, 546), (199, 388, 555), (173, 449, 558),
    (149, 508, 557), (128, 567, 551), (121, 626, 533), (158, 684, 502), (246, 739, 452), (369, 789, 383),
    (516, 831, 294), (678, 864, 190), (846, 887, 100), (993, 906, 144),
)  # fmt: skip
ROUND = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)


def lux_scale(solution: Solution) -> float:
    """What the brightest colour stands for, lx: more than the illuminance of 99 % of the lit area, a round number."""
    leaves = solution.leaves()
    E = LUMENS_PER_WATT * leaves.irradiance @ np.array(LUMINANCE)
    order = np.argsort(E)
    below = np.cumsum(leaves.open_area[order], dtype=np.float64)
    most = float(E[order[np.searchsorted(below, 0.99 * below[-1])]])
    if most <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * next((r for r in ROUND if r * power >= most), 10))


class Lux(Gouraud):
    """E = 179 lm/W (0.2126 H_R + 0.7152 H_G + 0.0722 H_B), lx, from violet (0) to yellow (``scale`` and more)."""

    name = "lux"
    colors = True

    def __init__(self, solution: Solution):
        super().__init__(solution)
        self.scale = lux_scale(solution)
        self._table = [owned(mi.Float, column) for column in np.array(VIRIDIS).T / 1000]

    @classmethod
    def legend(cls, solution: Solution) -> str:
        return f"lux: from violet, 0 lx, to yellow, {lux_scale(solution):g} lx and more"

    def radiance(self, look: Look) -> "mi.Color3f":
        """Colours, so that the sRGB picture has those of the table (Color3f [rays])."""
        H = self.irradiance(look)
        E = LUMENS_PER_WATT * sum(weight * h for weight, h in zip(LUMINANCE, H))
        place = dr.clip(E / dr.opaque(mi.Float, self.scale), 0, 1) * (len(VIRIDIS) - 1)
        low = dr.minimum(mi.UInt32(place), len(VIRIDIS) - 2)
        colors = (
            dr.lerp(dr.gather(mi.Float, c, low), dr.gather(mi.Float, c, low + 1), place - low) for c in self._table
        )
        return mi.Color3f(*(dr.select(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) for c in colors))
