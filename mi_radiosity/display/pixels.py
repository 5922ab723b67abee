"""Camera samples: well spread over pixels, lenses, lamps and directions, and unbiased."""

from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi

from ..core.points import ROUNDS, Stream, stream_seed

AT_ONCE = 1 << 23  # camera samples in one launch


class PixelPoints:
    """Uniform numbers for the camera samples of an image, in place of a mi.Sampler.

    Every pair of numbers is, over the samples of a pixel, a (0, 2)-sequence under a random digital shift, in an order
    of its own (Kollig and Keller 2002), so that each is well spread and no two go together. Unbiased for any number
    of samples, unlike Mitsuba's stratified sampler at few.

    pixels: how many; ``count`` samples of each, from number ``first`` of ``total``; ordered by pixel.
    """

    def __init__(self, pixels: int, first: int, count: int, total: int, seed: int) -> None:
        self._count, self._total, self._dimension = count, total, 0
        k = dr.arange(mi.UInt32, pixels * count)
        each = dr.opaque(mi.UInt32, count)
        self._pixel, self._index = k // each, dr.opaque(mi.UInt32, first) + k % each
        self._seed = dr.opaque(mi.UInt32, stream_seed(seed, Stream.PIXELS))

    def sample_count(self) -> int:
        return self._count

    def _next(self):
        """The order and two shifts of the next pair of numbers."""
        self._dimension += 1
        order, x = mi.sample_tea_32(self._pixel, self._seed + self._dimension, ROUNDS)
        y, _ = mi.sample_tea_32(self._pixel ^ 0x5EED5EED, self._seed + self._dimension, ROUNDS)
        return mi.permute_kensler(self._index, self._total, order), x, y

    def next_1d(self) -> "mi.Float":
        index, x, _ = self._next()
        return mi.radical_inverse_2(index, x)

    def next_2d(self) -> "mi.Point2f":
        index, x, y = self._next()
        return mi.Point2f(mi.radical_inverse_2(index, x), mi.sobol_2(index, y))


def passes(pixels: int, spp: int, seed: int) -> Iterator[PixelPoints]:
    """``spp`` samples of each of so many pixels, in launches of AT_ONCE samples."""
    most = max(1, AT_ONCE // pixels)
    for first in range(0, spp, most):
        yield PixelPoints(pixels, first, min(most, spp - first), spp, seed)


def picture(
    scene: "mi.Scene", sensor: "mi.Sensor", spp: int, seed: int, sample: Callable, develop: bool = True
) -> "mi.TensorXf | None":
    """The film of a sensor after ``spp`` samples per pixel of ``sample(scene, sampler, ray)`` (radiance, valid, …)."""
    from mitsuba.python.ad.integrators.common import ADIntegrator  # there once a variant is

    film = sensor.film()
    film.prepare([])
    size = film.crop_size() + (2 * film.rfilter().border_size() if film.sample_border() else 0)
    for sampler in passes(int(dr.prod(size)), spp, seed):
        ray, weight, position = ADIntegrator.sample_rays(None, scene, sensor, sampler)
        radiance, valid, _ = sample(scene, sampler, ray)
        block = film.create_block()
        block.set_coalesce(block.coalesce() and sampler.sample_count() >= 4)
        alpha = dr.select(valid, mi.Float(1), mi.Float(0))
        ADIntegrator._splat_to_block(block, film, position, radiance * weight, 1.0, alpha, [], ray.wavelengths)
        film.put_block(block)
        dr.eval(block.tensor())
    return film.develop() if develop else None
