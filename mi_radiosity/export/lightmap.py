"""Lightmaps: irradiance gathered at the points where texels of an atlas lie."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..core.errors import RadiosityError
from ..core.extras import optional
from ..core.numbers import whole_number
from ..solver import Solution
from .atlas import SPOTS, Atlas, emission, on_surface, reflectance, spots, unwrap, whole
from .dividing import cut_at_walls
from .seams import level_seams
from .visible import blocked, hidden, on_top

SAMPLES = 256  # per texel
LEAST, MOST = 16, 8192  # texels along a side
RINGS = 2  # of texels around charts that are filled, for bilinear filtering and mipmaps

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Lightmap:
    """Irradiance over an atlas; the first row of the pictures is at the top, as in glTF.

    irradiance: H, W/m² [size, size, 3]. radiosity: B = E + ρ H, W/m² [size, size, 3]. reflectance: ρ [size, size, 3].
    open: texels that light was gathered for [size, size]; the others are filled from their neighbours, or black.
    area: what of the surface is open in each texel, m² [size, size]. error: standard error of H [size, size, 3].
    """

    atlas: Atlas
    irradiance: np.ndarray
    reflectance: np.ndarray
    emission: np.ndarray
    open: np.ndarray
    area: np.ndarray
    error: np.ndarray
    rays: int

    @property
    def radiosity(self) -> np.ndarray:
        return self.emission + self.reflectance * self.irradiance

    def mean(self) -> np.ndarray:
        """Mean irradiance of the open area, W/m² [3]."""
        return (self.irradiance * self.area[..., None]).sum(axis=(0, 1)) / self.area.sum()


def lightmap(
    solution: Solution,
    size: int,
    samples: int = SAMPLES,
    denoise: bool = False,
    seed: int = 0,
    progress: Progress = lambda stage, done, total: None,
) -> Lightmap:
    """Bake a lightmap of size × size texels.

    samples: lines to the lamps, and as many rays into the room, per texel. denoise: by Open Image Denoise. progress is
    called with ("unwrap" | "gather", done, total).
    Raises RadiosityError for a size that is impossible or too small, and if a library is missing.
    """
    size, samples, seed = (
        check_budget(size, samples, denoise),
        whole_number("samples", samples),
        whole_number("seed", seed, None),
    )
    progress("unwrap", 0, 1)
    atlas = unwrap(solution.model, whole(solution.model), size)
    where = spots(atlas)
    if pieces := cut_at_walls(solution, atlas, where):
        atlas = unwrap(solution.model, pieces, size)
        where = spots(atlas)
    progress("unwrap", 1, 1)
    texels = _gather(solution, atlas, where, -(-samples // len(SPOTS)), seed, progress)
    light = _denoised(texels.irradiance) if denoise else texels.irradiance
    return replace(texels, irradiance=level_seams(solution.model, atlas, light, texels.open))


def check_budget(size: int, samples: int, denoise: bool = False) -> int:
    """The size of a lightmap as a Python int. Raises RadiosityError for a lightmap that could not be baked."""
    size = whole_number("the size of a lightmap", size, None)
    if not LEAST <= size <= MOST:
        raise RadiosityError(f"a lightmap of {size} x {size} texels is impossible: choose {LEAST} to {MOST}")
    whole_number("samples", samples)
    for module in ("xatlas", "scipy"):
        optional(module, "a lightmap", "export")
    if denoise:
        optional("mitsuba_oidn", "denoising", "denoise")
    return size


def _gather(solution, atlas, where, samples, seed, progress):
    """A Lightmap of what the spots of texels gather."""
    model, n, k = solution.model, len(where.texel), len(SPOTS)
    points, normals, patch, uv = on_surface(model, atlas, where.piece.ravel(), where.weight.reshape(-1, 3))
    valid = on_top(model, patch, uv)
    chosen = np.flatnonzero(valid)
    found = solution.irradiance(
        points[chosen], normals[chosen], samples=samples, seed=seed, return_error=True, progress=progress
    )
    H, error = (np.zeros((n * k, 3)) for _ in range(2))
    H[chosen], error[chosen] = found
    valid[hidden(model, points, normals, H, valid)] = False
    valid = _in_one_place(model, points, normals, valid).ravel()
    H[~valid] = error[~valid] = 0
    count = valid.reshape(n, k).sum(axis=1)[:, None]
    mean = H.reshape(n, k, 3).sum(axis=1) / np.maximum(count, 1)
    deviation = np.sqrt((error**2).reshape(n, k, 3).sum(axis=1)) / np.maximum(count, 1)
    rho = reflectance(model, patch, uv).reshape(n, k, 3).mean(axis=1)
    area = (atlas.texel_area(model)[where.piece] * (valid.reshape(n, k) & where.inside)).mean(axis=1)
    E = emission(model, patch, uv).reshape(n, k, 3).mean(axis=1)

    def image(values, kind=np.float64):
        out = np.zeros((atlas.size**2, *np.shape(values)[1:]), dtype=kind)
        out[where.texel] = values
        return out.reshape(atlas.size, atlas.size, *out.shape[1:])

    chart = np.full(atlas.size**2, -1)
    chart[where.texel] = where.chart
    known = image(count[:, 0] > 0, bool)
    fields = np.concatenate([image(mean), image(rho), image(E)], axis=2)
    fields = fill(fields, known, chart.reshape(known.shape))
    H, rho, E = np.split(fields, 3, axis=2)
    rays = 2 * len(chosen) * -(-samples // 16) * 16
    return Lightmap(atlas, H, rho, E, known, image(area), image(deviation), rays)


def _in_one_place(model, points, normals, valid):
    """Those of the valid spots that the first one of their texel sees, lest texels mix two sides of a wall
    [texels, spots]."""
    k = len(SPOTS)
    valid = valid.reshape(-1, k)
    first = np.arange(len(valid)) * k + valid.argmax(axis=1)
    for spot in range(1, k):
        chosen = np.flatnonzero(valid[:, spot] & (valid.argmax(axis=1) < spot))
        if len(chosen):
            a, b = first[chosen], chosen * k + spot
            valid[chosen, spot] = ~blocked(model, points[a], points[b], normals[a], normals[b])
    return valid


def fill(values: np.ndarray, known: np.ndarray, chart: np.ndarray) -> np.ndarray:
    """Fill texels that nothing is known of from the nearest ones: those of charts, and RINGS around them.

    values: [size, size, …]; known: bool [size, size]; chart: numbers of the charts, −1 for none [size, size].
    """
    ndimage: Any = optional("scipy.ndimage", "a lightmap", "export")

    def nearest_to(which):
        return ndimage.distance_transform_cdt(~which, metric="chessboard", return_indices=True)

    if not known.any():
        return values
    _, (row, column) = nearest_to(known)
    inner = (chart >= 0) & (chart == chart[row, column])
    values = np.where(inner[..., None], values[row, column], values)
    distance, (row, column) = nearest_to(inner)
    return np.where((~inner & (distance <= RINGS))[..., None], values[row, column], values)


def _denoised(irradiance):
    """Irradiance without noise; what is black stays black."""
    denoiser: Any = optional("mitsuba_oidn", "denoising", "denoise")
    H = np.ascontiguousarray(irradiance, dtype=np.float32)
    smooth = np.array(denoiser.denoise(H, hdr=True), dtype=np.float64)
    return np.where(H > 0, np.maximum(smooth, 0), 0)
