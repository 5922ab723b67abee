"""How far an image is from a reference that is noisy itself."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.color import LUMINANCE, srgb

EQUAL = (1 / 3, 1 / 3, 1 / 3)
PERCEPTUAL = LUMINANCE
LAGS = 3  # pixels over which a reconstruction filter correlates noise


def mean_square(difference: np.ndarray, weights: Sequence[float] = EQUAL) -> float:
    """Mean over pixels of the weighted squares of [height, width, 3] differences."""
    return float((difference**2 @ np.asarray(weights)).mean())


def rmse(a: ArrayLike, b: ArrayLike, weights: Sequence[float] = EQUAL) -> float:
    """Root mean square error of two linear images, measured as 8-bit sRGB (0…255)."""
    return mean_square(srgb(a) - srgb(b), weights) ** 0.5


def psnr(error: float) -> float:
    """Peak signal-to-noise ratio of an RMSE: 20 log10(255 / RMSE), in dB."""
    return float(20 * np.log10(255 / error)) if error > 0 else float("inf")


def relative_error(image: ArrayLike, reference: ArrayLike) -> float:
    """relMSE, linear, for HDR: mean of (x − r)² / (r² + 0.01)."""
    x, r = np.asarray(image, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    return float(((x - r) ** 2 / (r**2 + 0.01)).mean())


@dataclass(frozen=True)
class Errors:
    """Errors of an image. _a weighs channels equally, _p by luminance; ``clean`` is RMSE_a with the
    reference's noise removed, ± ``clean_error`` (one standard error of what that noise decides)."""

    rmse_a: float
    rmse_p: float
    psnr_a: float
    psnr_p: float
    rel_mse: float
    rmse_a_clean: float
    rmse_a_clean_error: float

    def asdict(self) -> dict[str, float]:
        return asdict(self)


def compare(image: ArrayLike, halves: np.ndarray) -> Errors:
    """Errors of ``image`` against a reference in two independent halves ([2, height, width, 3], linear).

    With x the image, r₀ and r₁ the halves, all sRGB-encoded, the mean of (x − r₀)(x − r₁) is
    RMSE² − noise² to the letter, and free of the reference's noise in expectation: the two noises
    are independent. With e = x − (r₀ + r₁)/2 and d = r₀ − r₁, the square of q = e·d, averaged over
    channels, is an unbiased estimate of a pixel's variance; products of neighbouring q account for
    the film's filter, which spreads noise over LAGS pixels.
    """
    reference = np.mean(halves, axis=0)
    x, r0, r1 = srgb(image), srgb(halves[0]), srgb(halves[1])
    error_a, error_p = rmse(image, reference), rmse(image, reference, PERCEPTUAL)
    clean = float(max(((x - r0) * (x - r1)).mean(), 0.0) ** 0.5)
    q = ((x - (r0 + r1) / 2) * (r0 - r1)).mean(axis=2)
    variance = max(_sum_of_neighbours(q), float((q**2).sum())) / q.size**2
    return Errors(
        error_a,
        error_p,
        psnr(error_a),
        psnr(error_p),
        relative_error(image, reference),
        clean,
        variance**0.5 / (2 * max(clean, 1e-9)),
    )


def _sum_of_neighbours(q: np.ndarray) -> float:
    """Σ q(p) q(p + lag) over pixels p and all lags within LAGS."""
    padded = np.pad(q, LAGS)
    height, width = q.shape
    return float(
        sum(
            (q * padded[LAGS + dy : LAGS + dy + height, LAGS + dx : LAGS + dx + width]).sum()
            for dy in range(-LAGS, LAGS + 1)
            for dx in range(-LAGS, LAGS + 1)
        )
    )


def reference_noise(halves: np.ndarray) -> float:
    """RMSE_a of a reference itself, estimated from its halves: half the RMSE between them."""
    return rmse(halves[0], halves[1]) / 2
