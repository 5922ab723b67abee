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
    of samples, unlike Mitsuba's stratified sampler at few.

    pixels: how many; ``count`` samples of each, from number ``first`` of ``total``; ordered by pixel.
    """

    def __init__(self, pixels: int, first: int, count: int, total: int, seed: int) -> None:
        self._count, self._total, self._dimension = count, opaque_index(total), 0
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
        return permuted(self._index, self._total, order), x, y

    def next_1d(self) -> "mi.Float":
        index, x, _ = self._next()
        return mi.radical_inverse_2(index, x)

    def next_2d(self) -> "mi.Point2f":
        index, x, y = self._next()
        return mi.Point2f(mi.radical_inverse_2(index, x), mi.sobol_2(index, y))


def spans(pixels: int, spp: int, apart: int = 0) -> Iterator[tuple[int, int]]:
    """``spp`` samples of each of so many pixels in launches of AT_ONCE samples, the first ``apart`` of them by
    themselves: where each begins, and how many it takes."""
    most, first = max(1, AT_ONCE // pixels), 0
    while first < spp:
        count = min(most, (apart if first < apart else spp) - first)
        yield first, count
        first += count


def passes(pixels: int, spp: int, seed: int, apart: int = 0) -> Iterator[PixelPoints]:
    """The same as points."""
    for first, count in spans(pixels, spp, apart):
        yield PixelPoints(pixels, first, count, spp, seed)


class FilmPicture:
    """A picture on the film of a sensor that takes more and more camera samples of
    ``sample(scene, sampler, ray)`` (radiance, valid, …)."""

    step = 1

    def __init__(self, scene: "mi.Scene", sensor: "mi.Sensor", sample: Callable) -> None:
        self._scene, self._sensor, self._sample, self._film = scene, sensor, sample, sensor.film()
        self._film.prepare([])
        border = 2 * self._film.rfilter().border_size() if self._film.sample_border() else 0
        self._pixels = int(dr.prod(self._film.crop_size() + border))

    def add(self, spp: int, seed: int) -> None:
        """Take ``spp`` more samples per pixel; another seed every time."""
        from mitsuba.python.ad.integrators.common import ADIntegrator  # there once a variant is

        for sampler in passes(self._pixels, spp, seed):
            ray, weight, position = ADIntegrator.sample_rays(None, self._scene, self._sensor, sampler)
            radiance, valid, _ = self._sample(self._scene, sampler, ray)
            block = self._film.create_block()
            block.set_coalesce(block.coalesce() and sampler.sample_count() >= 4)
            alpha = dr.select(valid, mi.Float(1), mi.Float(0))
            ADIntegrator._splat_to_block(
                block, self._film, position, radiance * weight, 1.0, alpha, [], ray.wavelengths
            )
            self._film.put_block(block)
            dr.eval(block.tensor())

    def image(self, seconds: float | None = None) -> "mi.TensorXf":
        """What the film holds now [height, width, channels]."""
        return self._film.develop()

    preview = image

    def finishing(self, seconds: float, spp: int) -> float:
        """How many of so many seconds `image` should take of so many samples."""
        return 0.0


class Growing(Protocol):
    """A FilmPicture, or one that is denoised: takes samples in multiples of ``step``; ``image`` is as good as it gets
    in so many seconds, and ``preview`` takes little; ``finishing`` is what an image should take of all seconds."""

    step: int

    def add(self, spp: int, seed: int) -> None: ...

    def image(self, seconds: float | None = None) -> "mi.TensorXf": ...

    def preview(self) -> "mi.TensorXf": ...

    def finishing(self, seconds: float, spp: int) -> float: ...


def grow(picture: Growing, seed: int, seconds: float, show: Callable[[Callable, int], None]) -> int:
    """Take samples until ``seconds`` are over, in passes that grow as far as they fit; returns how many per pixel.

    show(image, samples) is told after every pass; image() is the picture then. At least one step of samples is taken;
    what a pass takes is judged by those before.
    """
    taken: list[tuple[int, float]] = []  # samples and seconds of passes
    start, done, spp = time.perf_counter(), 0, picture.step
    while True:
        before = time.perf_counter()
        picture.add(spp, stream_seed(seed, Stream.PIXELS, 1 + len(taken)))
        dr.sync_thread()
        taken.append((spp, time.perf_counter() - before))
        done += spp
        show(picture.preview, done)
        once, each = _costs(taken)
        left, each = 0.95 * (seconds - (time.perf_counter() - start)) - once, max(each, 1e-9)
        fits = left / each
        for _ in range(2):  # what the image takes depends on how many samples there will be
            fits = (left - picture.finishing(seconds, done + int(max(fits, 0)))) / each
        fits = int(fits) // picture.step * picture.step
        if fits < 1:
            return done
        spp = (GROWTH if len(taken) > 1 else 2) * spp
        if fits < GROWTH * spp:  # rather one pass of all that fits than a small one at the end
            spp = fits


def _costs(taken):
    """What a pass takes whatever its size, and per sample, from (samples, seconds) of those before."""
    (n, took), before = taken[-1], taken[1:-1]  # the first one compiles, and tells nothing
    each = took / n
    if before and n > before[-1][0]:
        each = min(max((took - before[-1][1]) / (n - before[-1][0]), 0.5 * each), each)
    return took - each * n, each
