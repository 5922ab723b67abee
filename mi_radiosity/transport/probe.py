"""Irradiance at any points, with its standard error."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import opaque_index, owned_vectors
from ..core.points import Stream, cosine_direction, hash_pair, kronecker, lamp_lot, stream_seed
from ..scene import Model
from .gather import Gatherer, Places

RUNS = 16  # of samples per point, whose spread is the error
AT_ONCE = 1 << 22  # samples, which bounds memory


def probe(
    gatherer: Gatherer,
    model: Model,
    points: np.ndarray,
    normals: np.ndarray,
    samples: int,
    seed: int,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[np.ndarray, np.ndarray]:
    """H at points, and its standard error (two float64 [n, 3], W/m²).

    points [n, 3] of the scene; normals [n, 3] of unit length; samples: lines to the lamps, and as many rays into the
    room, per point, rounded up to a multiple of 16. A point's samples are one low-discrepancy sequence; the error is
    the spread of 16 runs of it, as if these were independent, and so rather too large than too small.
    """
    n, run = len(points), -(-samples // RUNS)
    samples = RUNS * run
    mean, error, at_once = np.zeros((n, 3)), np.zeros((n, 3)), max(1, AT_ONCE // samples)
    stream, each = opaque_index(stream_seed(seed, Stream.MEASURE)), opaque_index(samples)
    for first in range(0, n, at_once):
        part = slice(first, min(first + at_once, n))
        k = dr.arange(mi.UInt32, (part.stop - first) * samples)
        of, line = k // each, k % each
        x = dr.gather(mi.Point3f, owned_vectors(mi.Point3f, points[part] - model.faces.centre), of)
        normal = dr.gather(mi.Vector3f, owned_vectors(mi.Vector3f, normals[part]), of)
        places = Places(x, normal)
        key = hash_pair(opaque_index(first) + dr.arange(mi.UInt32, part.stop - first), 0)
        lot = lamp_lot(line, key, stream, of)
        a, b, s, t = kronecker(line, key, stream, of)
        number = k + opaque_index(first * samples)
        H, _ = gatherer.lines(places, lot, a, b, 1.0)
        for met in gatherer.rays(places, cosine_direction(normal, s, t), number, stream, 1.0):
            H += met
        runs = np.array([dr.block_sum(c, run) for c in H], dtype=np.float64).reshape(3, -1, RUNS) / run
        mean[part], error[part] = runs.mean(axis=2).T, runs.std(axis=2, ddof=1).T / RUNS**0.5
        progress(part.stop)
    return mean, error
