"""Pictures of few samples without their noise, by Open Image Denoise."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.extras import optional
from .pixels import passes

FEATURE_SPP = 32  # samples per pixel of albedo and normals, which need no more


def require_denoiser() -> Any:
    """The library. Raises RadiosityError if it is missing."""
    return optional("mitsuba_oidn", "denoising", "denoise")


class CleanPicture:
    """A picture [height, width, 3] of ``sample(scene, sampler, ray)`` that takes more and more samples, denoised.

    Samples are averaged pixel by pixel, as the denoiser needs pixels that are independent, with albedo and normals
    of the surfaces seen; the film's own filter is applied afterwards, pixel to pixel. draw: `passes`, or
    another source of samples.
    """

    def __init__(self, scene: "mi.Scene", sensor: "mi.Sensor", sample: Callable, draw: Callable = passes) -> None:
        self._draw = draw
        self._denoiser, self._scene, self._sensor, self._sample = require_denoiser(), scene, sensor, sample
        self._width, self._height = (int(n) for n in sensor.film().crop_size())
        if sensor.film().sample_border():
            raise RadiosityError("films that sample their border cannot be denoised: set sample_border to false")
        self._color, self._count = np.zeros((self._height * self._width, 3)), 0
        self._features, self._seen = np.zeros((2, self._height * self._width, 3)), 0

    def add(self, spp: int, seed: int) -> None:
        """Take ``spp`` more samples per pixel; another seed every time."""
        for points in self._draw(self._width * self._height, spp, seed, min(max(FEATURE_SPP - self._seen, 0), spp)):
            look = self._seen < FEATURE_SPP
            planes = _sums(self._scene, self._sensor, points, self._sample, look)
            self._color += planes[0]
            self._count += points.sample_count()
            if look:
                self._features += planes[1:]
                self._seen += points.sample_count()

    def image(self) -> "mi.TensorXf":
        """What has been sampled, without its noise."""
        planes = [self._color / self._count, *self._features / self._seen]
        color, albedo, normal = (p.reshape(self._height, self._width, 3).astype(np.float32) for p in planes)
        clean = self._denoiser.denoise(color, albedo=np.clip(albedo, 0, 1), normal=normal, hdr=True, clean_aux=True)
        return mi.TensorXf(_filtered(np.asarray(clean), self._sensor.film().rfilter()))


def _sums(scene, sensor, points, sample, look):
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
    return np.array(sums, dtype=np.float64).swapaxes(1, 2)


def _filtered(image, rfilter):
    """An image of box-filtered pixels under a reconstruction filter, along rows and columns."""
    reach = int(np.ceil(rfilter.radius() - 0.5))
    if rfilter.is_box_filter() or reach < 1:
        return image
    weight = _over_pixels(rfilter, reach)
    for axis in (0, 1):
        pad = [(reach, reach) if a == axis else (0, 0) for a in range(3)]
        padded, n = np.pad(image, pad, mode="edge"), image.shape[axis]
        image = sum(w * np.take(padded, range(k, k + n), axis=axis) for k, w in enumerate(weight))
    return image.astype(np.float32)


def _over_pixels(rfilter, reach):
    """Weights of pixels −reach…reach that make of box-filtered ones what the filter would have: as wide, not wider."""

    def at(x):
        return np.array([float(rfilter.eval(float(y))[0]) for y in x])

    pixels, fine = np.arange(-reach, reach + 1), np.linspace(-reach - 0.5, reach + 0.5, 201)
    curve = at(fine)
    rest = max((curve @ fine**2) / curve.sum() - 1 / 12, 0)  # of the variance, beside that of a pixel
    if rest <= 0.5:
        return np.where(np.abs(pixels) == 1, rest / 2, np.where(pixels == 0, 1 - rest, 0.0))
    weight = at(pixels) / at(pixels).sum()
    share = min(rest / (weight @ pixels**2), 1)
    return share * weight + (1 - share) * (pixels == 0)
