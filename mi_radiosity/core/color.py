"""Linear RGB: luminance, and what screens take."""

import numpy as np
from numpy.typing import ArrayLike

LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709 weights of linear RGB
LUMENS_PER_WATT = 179.0  # Radiance's luminous efficacy of white light


def srgb(linear: ArrayLike) -> np.ndarray:
    """Linear values ─► 0…255 sRGB-encoded, clipped but not rounded (float64, of the same shape)."""
    x = np.clip(np.asarray(linear, dtype=np.float64), 0, 1)
    return 255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def srgb8(linear: ArrayLike) -> np.ndarray:
    """Linear values as 8-bit sRGB (uint8, of the same shape)."""
    return np.round(srgb(linear)).astype(np.uint8)
