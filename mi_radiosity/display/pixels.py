"""Camera samples: well spread over pixels, lenses, lamps and directions, and unbiased."""

import time
from collections.abc import Callable, Iterator
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ..core.arrays import opaque_index
from ..core.points import ROUNDS, Stream, permuted, stream_seed

AT_ONCE = 1 << 23  # camera samples in one launch
GROWTH = 4  # by which passes grow


class PixelPoints:
    """Uniform numbers for the camera samples of an image, in place of a mi.Sampler.

    Every pair of numbers is, over the samples of a pixel, a (0, 2)-sequence under a random digital shift, in an order
    of its own (Kollig and Keller 2002), so that each is well spread and no two go together. Unbiased for any number
    of samples, unlike Mitsuba's stratified sampler at few. Another pass goes on where the last one ended.

    Of every sample its ``pixel``, its number there in this pass, ``index``, how many the pass has in ``total`` and how
    many there were ``before`` (UInt32 [samples]).
    """

    _count = 0

    def __init__(
        self, pixel: "mi.UInt32", index: "mi.UInt32", total: "mi.UInt32", before: "mi.UInt32", seed: int
    ) -> None:
        self._pixel, self._index, self._before, self._dimension = pixel, index, before, 0
        self._total = dr.maximum(total, 1)  # lanes beyond the last sample divide by it, too
        self._seed = dr.opaque(mi.UInt32, stream_seed(seed, Stream.PIXELS))

    @classmethod
    def of_all(cls, pixels: int, first: int, count: int, total: int, before: int, seed: int) -> "PixelPoints":
        """``count`` samples of each of so many pixels, from number ``first`` of the pass on; ordered by pixel."""
        k, each = dr.arange(mi.UInt32, pixels * count), opaque_index(count)
        index = opaque_index(first) + k % each
        points = cls(k // each, index, opaque_index(total), opaque_index(before), seed)
        points._count = count
        return points

    def sample_count(self) -> int:
        return self._count

    def _next(self):
        """The order and two shifts of the next pair of numbers."""
        self._dimension += 1
        order, x = mi.sample_tea_32(self._pixel, self._seed + self._dimension, ROUNDS)
        y, _ = mi.sample_tea_32(self._pixel ^ 0x5EED5EED, self._seed + self._dimension, ROUNDS)
        return self._before + permuted(self._index, self._total, order), x, y

    def next_1d(self) -> "mi.Float":
        index, x, _ = self._next()
        return mi.radical_inverse_2(index, x)

    def next_2d(self) -> "mi.Point2f":
        index, x, y = self._next()
        return mi.Point2f(mi.radical_inverse_2(index, x), mi.sobol_2(index, y))


def launches(pixels: int, before: int, spp: int, seed: int) -> Iterator[PixelPoints]:
    """A pass of ``spp`` samples of each of so many pixels, AT_ONCE at a time, after so many ``before``."""
    most = max(1, AT_ONCE // pixels)
    for first in range(0, spp, most):
        yield PixelPoints.of_all(pixels, first, min(most, spp - first), spp, before, seed)


def camera_rays(
    sensor: "mi.Sensor", width: int, height: int, pixel: "mi.UInt32", points: PixelPoints
) -> "tuple[mi.RayDifferential3f, mi.Color3f]":
    """Rays through points of pixels (UInt32 [n]) of a grid over all that the film shows, and their weights, as Mitsuba
    draws those of all pixels."""
    at = mi.Point2f(pixel % opaque_index(width), pixel // opaque_index(width)) + points.next_2d()
    lens = points.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0)
    time = sensor.shutter_open() + dr.zeros(mi.Float, dr.width(pixel))
    if sensor.shutter_open_time() > 0:
        time += points.next_1d() * sensor.shutter_open_time()
    scale = mi.Vector2f(*(dr.opaque(mi.Float, 1 / size) for size in (width, height)))
    return sensor.sample_ray_differential(time, 0, at * scale, lens)


class FilmPicture:
    """A picture on the film of a sensor that takes more and more camera samples of
    ``sample(sampler, ray)`` (radiance, valid, …)."""

    least = 1

    def __init__(self, scene: "mi.Scene", sensor: "mi.Sensor", sample: Callable, seed: int) -> None:
        self._scene, self._sensor, self._sample, self._film = scene, sensor, sample, sensor.film()
        self._seed, self._done = seed, 0
        self._film.prepare([])
        border = 2 * self._film.rfilter().border_size() if self._film.sample_border() else 0
        self._pixels = int(dr.prod(self._film.crop_size() + border))

    def add(self, spp: int) -> int:
        """Take ``spp`` more samples per pixel; returns how many were taken."""
        from mitsuba.python.ad.integrators.common import ADIntegrator  # there once a variant is

        for sampler in launches(self._pixels, self._done, spp, self._seed):
            ray, weight, position = ADIntegrator.sample_rays(None, self._scene, self._sensor, sampler)
            radiance, valid, _ = self._sample(sampler, ray)
            block = self._film.create_block()
            block.set_coalesce(block.coalesce() and sampler.sample_count() >= 4)
            alpha = dr.select(valid, mi.Float(1), mi.Float(0))
            ADIntegrator._splat_to_block(
                block, self._film, position, radiance * weight, 1.0, alpha, [], ray.wavelengths
            )
            self._film.put_block(block)
            dr.eval(block.tensor())
        self._done += spp
        return spp

    def image(self, seconds: float | None = None) -> "mi.TensorXf":
        """What the film holds now [height, width, channels]."""
        return self._film.develop()

    preview = image

    def finishing(self, seconds: float, spp: int) -> float:
        """How many of so many seconds `image` should take of so many samples."""
        return 0.0


class Growing(Protocol):
    """A FilmPicture, or one that is denoised: takes more and more samples, ``least`` of them at first; ``image`` is as
    good as it gets in so many seconds, and ``preview`` takes little; ``finishing`` is what an image should take of all
    seconds."""

    least: int

    def add(self, spp: int) -> int: ...

    def image(self, seconds: float | None = None) -> "mi.TensorXf": ...

    def preview(self) -> "mi.TensorXf": ...

    def finishing(self, seconds: float, spp: int) -> float: ...


def grow(picture: Growing, seconds: float, show: Callable[[Callable, int], None]) -> int:
    """Take samples until ``seconds`` are over, in passes that grow as far as they fit; returns how many per pixel.

    show(image, samples) is told after every pass; image() is the picture then. What a pass takes is judged by those
    before.
    """
    taken: list[tuple[int, float]] = []  # samples and seconds of passes
    start, done, spp = time.perf_counter(), 0, picture.least
    while True:
        before = time.perf_counter()
        spp = picture.add(spp)
        dr.sync_thread()
        taken.append((spp, time.perf_counter() - before))
        done += spp
        show(picture.preview, done)
        once, each = _costs(taken)
        left, each = 0.95 * (seconds - (time.perf_counter() - start)) - once, max(each, 1e-9)
        fits = left / each
        for _ in range(2):  # what the image takes depends on how many samples there will be
            fits = (left - picture.finishing(seconds, done + int(max(fits, 0)))) / each
        if fits < 1:
            return done
        spp = (GROWTH if len(taken) > 1 else 2) * spp
        if fits < GROWTH * spp:  # rather one pass of all that fits than a small one at the end
            spp = int(fits)


def _costs(taken):
    """What a pass takes whatever its size, and per sample, from (samples, seconds) of those before."""
    (n, took), before = taken[-1], taken[1:-1]  # the first one compiles, and tells nothing
    each = took / n
    if before and n > before[-1][0]:
        each = min(max((took - before[-1][1]) / (n - before[-1][0]), 0.5 * each), each)
    return took - each * n, each
