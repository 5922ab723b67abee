"""Pictures of few samples without their noise, by Open Image Denoise."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.extras import optional
from .pixels import passes


def require_denoiser() -> Any:
    """The library. Raises RadiosityError if it is missing."""
    return optional("mitsuba_oidn", "denoising", "denoise")


class CleanPicture:
    """A picture [height, width, 3] of ``sample(scene, sampler, ray)`` that takes more and more samples, denoised.

    Samples are averaged pixel by pixel, as the denoiser needs pixels that are independent, with albedo and normals
    of the surfaces seen; the film's own filter is applied afterwards, pixel to pixel.
    """

    def __init__(self, scene: "mi.Scene", sensor: "mi.Sensor", sample: Callable) -> None:
        self._denoiser, self._scene, self._sensor, self._sample = require_denoiser(), scene, sensor, sample
        self._width, self._height = (int(n) for n in sensor.film().crop_size())
        if sensor.film().sample_border():
            raise RadiosityError("films that sample their border cannot be denoised: set sample_border to false")
        self._sums, self._count = np.zeros((3, self._height * self._width, 3)), 0

    def add(self, spp: int, seed: int) -> None:
        """Take ``spp`` more samples per pixel; another seed every time."""
        for points in passes(self._width * self._height, spp, seed):
            self._sums += _sums(self._scene, self._sensor, points, self._sample)
        self._count += spp

    def image(self) -> "mi.TensorXf":
        """What has been sampled, without its noise."""
        planes = (s.reshape(self._height, self._width, 3) / self._count for s in self._sums)
        color, albedo, normal = (np.ascontiguousarray(plane, np.float32) for plane in planes)
        clean = self._denoiser.denoise(color, albedo=np.clip(albedo, 0, 1), normal=normal, hdr=True, clean_aux=True)
        return mi.TensorXf(_filtered(np.asarray(clean), self._sensor.film().rfilter()))


def _sums(scene, sensor, points, sample):
    """Sums over samples of radiance, albedo and normal [3, pixels, 3]."""
    from mitsuba.python.ad.integrators.common import ADIntegrator  # there once a variant is

    ray, weight, _ = ADIntegrator.sample_rays(None, scene, sensor, points)
    radiance, _, _ = sample(scene, points, ray)
    si = scene.ray_intersect(ray)
    valid, normal = si.is_valid(), mi.Vector3f(si.sh_frame.n)
    albedo = dr.select(valid, si.bsdf(ray).eval_diffuse_reflectance(si, valid), 0)
    albedo = dr.select(dr.isfinite(albedo), dr.clip(albedo, 0, 1), 1)
    planes = mi.Color3f(radiance * weight), mi.Color3f(albedo), dr.select(valid, normal, 0)
    return np.array(
        [[dr.block_sum(c, points.sample_count()) for c in plane] for plane in planes], dtype=np.float64
    ).swapaxes(1, 2)


def _filtered(image, rfilter):
    """An image of box-filtered pixels under a reconstruction filter, along rows and columns."""
    reach = int(np.ceil(rfilter.radius() - 0.5))
    if rfilter.is_box_filter() or reach < 1:
        return image
    weight = np.array([float(rfilter.eval(float(k))[0]) for k in range(-reach, reach + 1)])
    for axis in (0, 1):
        pad = [(reach, reach) if a == axis else (0, 0) for a in range(3)]
        padded, n = np.pad(image, pad, mode="edge"), image.shape[axis]
        image = sum(w * np.take(padded, range(k, k + n), axis=axis) for k, w in enumerate(weight / weight.sum()))
    return image.astype(np.float32)
