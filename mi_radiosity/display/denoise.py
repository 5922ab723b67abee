"""Pictures of few samples without their noise, by Open Image Denoise."""

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.extras import optional
from .pixels import passes

FINE = 2  # parts of a pixel along each side, which are denoised one by one
LEAST_FINE = 8  # samples per pixel, from which on that gains something
FEATURE_SPP = 32  # samples per pixel of albedo and normals, which need no more
LATE = 1.3  # times what is left of the time, which the last image may take


class Way(NamedTuple):
    """A way to denoise: what, how well, how long it takes beside the cheapest, and the share of all time, where that is
    limited, up to which it is planned."""

    parts: int  # of a pixel along each side
    quality: str
    cost: float
    share: float


WAYS = (  # better and better
    Way(1, "Balanced", 1.0, 1.0),
    Way(1, "High", 2.0, 0.3),
    Way(FINE, "Balanced", 2.8, 0.6),
    Way(FINE, "High", 6.0, 0.3),
)


def require_denoiser() -> Any:
    """The library. Raises RadiosityError if it is missing."""
    return optional("mitsuba_oidn", "denoising", "denoise")


class CleanPicture:
    """A picture [height, width, 3] of ``sample(scene, sampler, ray)`` that takes more and more samples, denoised.

    Samples are averaged over quarters of pixels, as the denoiser needs numbers that are independent, with albedo and
    normals of the surfaces seen. The film's own filter is applied afterwards, to quarters, if there are enough samples
    to denoise these: edges are then as smooth as it makes them. draw: `passes`, or another source of samples.
    """

    step = FINE**2  # samples per pixel are multiples of it
    _pace = 1e-6  # seconds that the cheapest way takes per pixel; as it was last time

    def __init__(self, scene: "mi.Scene", sensor: "mi.Sensor", sample: Callable, draw: Callable = passes) -> None:
        self._denoiser, self._scene, self._sensor, self._sample = require_denoiser(), scene, _Fine(sensor), sample
        if sensor.film().sample_border():
            raise RadiosityError("films that sample their border cannot be denoised: set sample_border to false")
        self._draw, self._rfilter = draw, sensor.film().rfilter()
        width, height = self._sensor.film().crop_size()
        # Sums of radiance, albedo and normals; and of how many samples of each part.
        self._sums, self._count, self._seen = np.zeros((3, height, width, 3), np.float32), 0, 0

    def add(self, spp: int, seed: int) -> None:
        """Take ``spp`` more samples per pixel, rounded up to a multiple of ``step``; another seed every time."""
        each, enough = -(-spp // self.step), FEATURE_SPP // self.step
        pixels = self._sums[0, ..., 0].size
        for points in self._draw(pixels, each, seed, min(max(enough - self._seen, 0), each)):
            look = self._seen < enough
            planes = _plane_sums(self._scene, self._sensor, points, self._sample, look)
            self._sums[: len(planes)] += planes.reshape(-1, *self._sums.shape[1:])
            self._count += points.sample_count()
            self._seen += points.sample_count() if look else 0

    def image(self, seconds: float | None = None) -> "mi.TensorXf":
        """What has been sampled, without its noise; as well as ``seconds`` allow, if given."""
        most = np.inf if seconds is None else LATE * seconds
        way = self._way(self._count * self.step, lambda way: self._takes(way) <= most)
        start, counts = time.perf_counter(), np.array([self._count, self._seen, self._seen], np.float32)
        planes = self._sums / counts.reshape(3, 1, 1, 1)
        if way.parts == 1:
            planes = np.mean([planes[:, i::FINE, j::FINE] for i in range(FINE) for j in range(FINE)], axis=0)
        color, albedo, normal = planes
        how = {"hdr": True, "clean_aux": True, "quality": getattr(self._denoiser.Quality, way.quality)}
        clean = self._denoiser.denoise(color, albedo=np.clip(albedo, 0, 1), normal=normal, **how)
        image = mi.TensorXf(_filtered(np.asarray(clean), self._rfilter, way.parts))
        CleanPicture._pace *= (time.perf_counter() - start) / self._takes(way)
        return image

    def preview(self) -> "mi.TensorXf":
        """The same in little time."""
        return self.image(0)

    def finishing(self, seconds: float, spp: int) -> float:
        """How many of so many seconds the last `image` takes of so many samples, as far as that is known."""
        return self._takes(self._way(spp, lambda way: self._takes(way) <= way.share * seconds))

    def _takes(self, way):
        """Seconds that a way takes, by what the last one did."""
        return way.cost * self._pace * self._sums[0, ..., 0].size / FINE**2

    def _way(self, spp, allowed):
        """The best way to denoise ``spp`` samples per pixel of those that are allowed, or the cheapest."""
        ways = [way for way in WAYS if allowed(way) and (way.parts == 1 or spp >= LEAST_FINE)]
        return (ways or WAYS[:1])[-1]


class _Fine:
    """A sensor whose pixels are FINE times smaller, and all that counts."""

    def __init__(self, sensor: "mi.Sensor") -> None:
        film, box = sensor.film(), mi.load_dict({"type": "box"})
        size, offset = FINE * mi.ScalarVector2u(film.crop_size()), FINE * mi.ScalarPoint2u(film.crop_offset())
        self._sensor = sensor
        self._film = SimpleNamespace(
            crop_size=lambda: mi.ScalarVector2u(size),
            crop_offset=lambda: offset,
            rfilter=lambda: box,
            sample_border=lambda: False,
        )

    def film(self) -> SimpleNamespace:
        return self._film

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sensor, name)


def _plane_sums(scene, sensor, points, sample, look):
    """Sums over samples of radiance, and if there is one more ``look`` of albedo and normal [1 or 3, pixels, 3]."""
    from mitsuba.python.ad.integrators.common import ADIntegrator  # there once a variant is

    ray, weight, _ = ADIntegrator.sample_rays(None, scene, sensor, points)
    radiance, _, _ = sample(scene, points, ray)
    if not look:
        return _pixel_sums([mi.Color3f(radiance * weight)], points.sample_count())
    si = scene.ray_intersect(ray)
    valid, normal = si.is_valid(), mi.Vector3f(si.sh_frame.n)
    albedo = dr.select(valid, si.bsdf(ray).eval_diffuse_reflectance(si, valid), 0)
    albedo = dr.select(dr.isfinite(albedo), dr.clip(albedo, 0, 1), 1)
    planes = [mi.Color3f(radiance * weight), mi.Color3f(albedo), dr.select(valid, normal, 0)]
    return _pixel_sums(planes, points.sample_count())


def _pixel_sums(planes, count):
    """Sums of so many samples of each pixel [planes, pixels, 3]."""
    dr.eval(planes)  # in one go: sums one by one would trace all again
    sums = [[dr.block_sum(c, count) for c in plane] for plane in planes]
    return np.array(sums, dtype=np.float32).swapaxes(1, 2)


def _filtered(image, rfilter, parts):
    """Pixels of an image of box-filtered ``parts`` of them under a reconstruction filter, along rows and columns."""
    weight = _over_parts(rfilter, parts)
    beyond = (len(weight) - parts) // 2
    for axis in (0, 1):
        pad = [(beyond, beyond) if a == axis else (0, 0) for a in range(3)]
        rows, n = np.moveaxis(np.pad(image, pad, mode="edge"), axis, 0), image.shape[axis]
        image = np.moveaxis(sum(w * rows[k : k + n : parts] for k, w in enumerate(weight.tolist())), 0, axis)
    return np.ascontiguousarray(image)


def _over_parts(rfilter, parts):
    """Weights of parts of pixels, as many before those of the pixel itself as after, that make of box-filtered ones
    what the filter would have: as wide, not wider."""

    def at(x):
        return np.array([float(rfilter.eval(float(y))[0]) for y in x])

    beyond = 0 if rfilter.is_box_filter() else int(np.ceil(parts * (rfilter.radius() - 0.5)))
    place = (np.arange(parts + 2 * beyond) - beyond + 0.5) / parts - 0.5
    within = (np.abs(place) < 0.5) / parts
    if not beyond:
        return within
    fine = np.linspace(-rfilter.radius(), rfilter.radius(), 401)
    curve, weight = at(fine), at(place) / at(place).sum()
    rest = (curve @ fine**2) / curve.sum() - 1 / (12 * parts**2)  # of the variance, beside that of a part
    narrow, wide = within, weight
    if weight @ place**2 < rest:
        narrow, wide = weight, np.full(len(place), 1 / len(place))
    least, most = narrow @ place**2, wide @ place**2
    share = np.clip((rest - least) / max(most - least, 1e-6), 0, 1)
    return share * wide + (1 - share) * narrow
