"""Lightmaps: irradiance gathered at the points where texels of an atlas lie."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned
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
    through: τ H of the other side of faces that transmit diffusely, part of B, W/m² [size, size, 3]. albedo: ρ + τ
    [size, size, 3].
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
    through: np.ndarray
    albedo: np.ndarray

    @property
    def radiosity(self) -> np.ndarray:
        return self.emission + self.scattered

    @property
    def scattered(self) -> np.ndarray:
        """Radiosity without emission, ρ H + τ H of the other side, W/m² [size, size, 3]."""
        return self.reflectance * self.irradiance + self.through

    @property
    def effective(self) -> np.ndarray:
        """What times ρ + τ is `scattered`: H itself where faces do not transmit, W/m² [size, size, 3]."""
        transmits = self.albedo > self.reflectance
        return np.where(transmits, self.scattered / np.where(transmits, self.albedo, 1), self.irradiance)

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
    light, through = texels.irradiance, texels.through
    if denoise:
        light, through = _denoised(light), _denoised(through) if through.any() else through
    return replace(texels, irradiance=level_seams(solution.model, atlas, light, texels.open), through=through)


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
    rho, albedo, through, more = _other_side(
        solution, points, normals, patch, uv, valid.ravel(), samples, seed, progress
    )
    rho, albedo = (x.reshape(n, k, 3).mean(axis=1) for x in (rho, albedo))
    through = through.reshape(n, k, 3).sum(axis=1) / np.maximum(count, 1)
    area = (atlas.texel_area(model)[where.piece] * (valid.reshape(n, k) & where.inside)).mean(axis=1)
    E = emission(model, patch, uv).reshape(n, k, 3).mean(axis=1)

    def image(values, kind=np.float64):
        out = np.zeros((atlas.size**2, *np.shape(values)[1:]), dtype=kind)
        out[where.texel] = values
        return out.reshape(atlas.size, atlas.size, *out.shape[1:])

    chart = np.full(atlas.size**2, -1)
    chart[where.texel] = where.chart
    known = image(count[:, 0] > 0, bool)
    fields = np.concatenate([image(x) for x in (mean, rho, E, through, albedo)], axis=2)
    fields = fill(fields, known, chart.reshape(known.shape))
    H, rho, E, through, albedo = np.split(fields, 5, axis=2)
    rays = 2 * (len(chosen) + more) * -(-samples // 16) * 16
    return Lightmap(atlas, H, rho, E, known, image(area), image(deviation), rays, through, albedo)


def _other_side(solution, points, normals, patch, uv, valid, samples, seed, progress):
    """ρ, ρ + τ, and τ H of the other side at points of patches (three [n, 3]), and how many points gathered that H."""
    patches, rho = solution.model.patches, reflectance(solution.model, patch, uv)
    through, here = np.zeros_like(rho), owned(mi.UInt32, patch)
    behind = patches.behind(here)
    if behind is None:
        return rho, rho, through, 0
    tau, there = np.array(behind[1]).T, np.array(behind[2]).astype(bool)
    own, albedo = (np.array(dr.gather(mi.Color3f, x, here)).T for x in (patches.reflectance, patches.albedo))
    rho = np.where(there[:, None], own, rho)
    chosen = np.flatnonzero(valid & there)
    H = solution.irradiance(points[chosen], -normals[chosen], samples=samples, seed=seed, progress=progress)
    through[chosen] = tau[chosen] * H
    return rho, np.where(there[:, None], albedo, rho), through, len(chosen)


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
