"""Pictures of few samples without their noise, by Open Image Denoise."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import lower_bound, opaque_index, owned
from ..core.color import srgb
from ..core.errors import RadiosityError
from ..core.extras import optional
from .film import has_alpha, on_film
from .pixels import AT_ONCE, PixelPoints, camera_rays

LEAST_SIDE = 4  # pixels of a film: Open Image Denoise makes the one pixel of a meter 40 % too bright
FINE = 2  # parts of a pixel along each side, which are denoised one by one
FEATURE_SPP = 32  # samples per pixel of albedo and normals, which need no more
APART = 1 << 20  # samples without them that are worth a launch of their own
LEAST_ERROR = 0.1  # of the mean, that every pixel is taken to have
MOST = 16  # times the mean that a pixel gets of all samples
TELLING = 0.3  # of the time of samples, that may be spent on where they are needed
DEARER = 1.2  # times what others take: samples there, as much of it is gloss and glass
COARSE = 2  # pixels along each side, that are denoised as one to tell where samples are needed
SMOOTH = 1.5  # pixels that the error of one is judged by


class Way(NamedTuple):
    """A way to denoise: what, how well, how long it takes beside the cheapest, the share of all time, where that is
    limited, up to which it is planned, and the samples per pixel from which on it gains something, or, of the way that
    is there to save time, more than further samples do."""

    parts: int  # of a pixel along each side
    quality: str
    cost: float
    share: float
    least: int


WAYS = (  # better and better
    Way(1, "Balanced", 1.0, 1.0, 1),
    Way(1, "High", 2.4, 0.25, 1),
    Way(FINE, "Fast", 2.0, 0.6, 12),
    Way(FINE, "Balanced", 4.0, 0.25, 8),
    Way(FINE, "High", 9.6, 0.2, 8),
)
GLANCE = WAYS[0]._replace(quality="Fast")  # to tell two pictures apart, both at half the resolution


def require_denoiser() -> Any:
    """The library. Raises RadiosityError if it is missing."""
    return optional("mitsuba_oidn", "denoising", "denoise")


class CleanPicture:
    """A picture [height, width, 3] of ``sample(points, ray, met=…)`` that takes more and more samples, denoised; met:
    what rays meet first, as ``see(ray)`` tells, where that is known.

    The channels are those of the sensor's film; alpha, where the film has it, is filtered but not denoised.
    Samples are averaged over quarters of pixels, as the denoiser needs numbers that are independent, with albedo and
    normals of the surfaces seen. The film's own filter is applied afterwards, to quarters, if there are enough samples
    to denoise these: edges are then as smooth as it makes them.

    After the first samples more are taken where two pictures, of a half of them each, differ once they are denoised:
    not where noise is, but where the denoiser cannot tell it from what is there. draw: what makes the points of given
    samples, if not `PixelPoints`.
    """

    least = FINE**2  # samples per pixel of the first pass: one of every part
    _pace = 1e-6  # seconds that the cheapest way takes per pixel; as it was last time

    def __init__(
        self, see: Callable, sensor: "mi.Sensor", sample: Callable, seed: int, draw: Callable = PixelPoints
    ) -> None:
        self._denoiser, self._see, self._sensor, self._sample = require_denoiser(), see, sensor, sample
        film = sensor.film()
        if film.sample_border():
            raise RadiosityError("films that sample their border cannot be denoised: set sample_border to false")
        if min(film.crop_size()) < LEAST_SIDE:
            raise RadiosityError(
                f"a film of {' x '.join(map(str, film.crop_size()))} pixels is too small to be denoised"
            )
        self._draw, self._seed, self._film = draw, seed, film
        width, height = (FINE * int(size) for size in film.crop_size())
        # Of every part sums over samples of radiance, of that of one half of them less the other, of albedo and of
        # normals; and how many have the first two, and the others.
        self._sums = [dr.zeros(mi.Color3f, height * width) for _ in range(4)]
        self._alpha = [dr.zeros(mi.Color3f, height * width)] if has_alpha(film) else []  # its sum, grey
        self._counts = np.zeros((2, height, width), np.int64)
        self._spp, self._spent, self._needed = 0, 0.0, None  # samples per pixel in the mean, and seconds they took

    def add(self, spp: int) -> int:
        """Take ``spp`` more samples per pixel, everywhere; or as many in the mean where they are needed, once it takes
        little of the time to tell. The first time fewer, as they take longer there. Returns how many."""
        each, telling = self._spent / max(self._spp, 1), self._takes(GLANCE)
        if self._spp and telling <= TELLING * spp * each:
            if self._needed is None:
                spp = max(1, int((spp - telling / each) / DEARER))
            self._needed = self._where_needed()
        spp = max(spp, self.least - self._spp)
        self._add(spp)
        return spp

    def take(self, spp: int) -> None:
        """All samples of a picture, ``spp`` per pixel: a quarter everywhere, the others where they are needed, as seen
        at first and when half of them are there."""
        first = max(self.least, spp // 4 // self.least * self.least)
        self._add(first)
        for more in ((spp - first) // 2, (spp - first + 1) // 2):
            if more > 0:
                self._needed = self._where_needed()
                self._add(more)

    def _add(self, spp):
        """Take so many more samples per pixel in the mean."""
        start, before = time.perf_counter(), self._counts[0].copy()
        counts = self._of_parts(self._shares(spp))
        look = np.clip(FEATURE_SPP // FINE**2 - self._counts[1], 0, counts)
        if look.any() and (counts - look).sum() < APART:
            look = counts
        self._take(look, counts, before, True)
        self._take(counts - look, counts, before, False)
        self._spp += spp
        self._spent += time.perf_counter() - start

    def _of_parts(self, spp):
        """Samples of parts (int [height, width]) of so many of pixels. Two parts that begin with different halves get
        one more where parts would get a fraction, by chance: halves of pixels are as many."""
        chance = np.random.default_rng([self._seed & 0xFFFFFFFF, int(self._spp)]).random(spp.shape)
        rows = [np.int64(spp / FINE**2 + (row + chance) / FINE) for row in range(FINE)]
        return np.stack(rows, axis=1).reshape(-1, spp.shape[1]).repeat(FINE, axis=1)

    def _take(self, counts, total, before, look):
        """Take ``counts`` more samples of parts, of a pass of ``total``, which had so many ``before`` (int [height,
        width])."""
        height, width = counts.shape
        first = (self._counts[0] - before).ravel()
        counts, total, before = (x.ravel() for x in (counts, total, before))
        chosen = np.flatnonzero(counts)
        launch = (np.cumsum(counts[chosen]) - 1) // AT_ONCE
        for parts in np.split(chosen, np.flatnonzero(np.diff(launch)) + 1):
            if len(parts) == 0:
                return
            count = counts[parts]
            end = np.cumsum(count)
            k = dr.arange(mi.UInt32, int(end[-1]))
            alike = count.min() == count.max()
            tables = parts, end - count, end, first[parts], total[parts], before[parts]
            rows, starts, ends, *tables = (owned(mi.UInt32, table) for table in tables)
            row = k // opaque_index(int(count[0])) if alike else lower_bound(ends, k + 1)
            part, start, index, of, done = (dr.gather(mi.UInt32, table, row) for table in (rows, starts, *tables))
            index += k - start
            dr.eval(part, index, of, done)
            points = self._draw(part, index, of, done, self._seed)
            planes, valid = self._planes(points, *camera_rays(self._sensor, width, height, part, points), look)
            # Halves take turns in every part, and begin with neighbouring parts: in a pixel they are as many.
            wide = opaque_index(width)
            planes.insert(1, planes[0] * (1 - 2 * mi.Float((part % wide + part // wide + index) & 1)))
            if self._alpha:
                planes.insert(2, mi.Color3f(dr.select(valid, mi.Float(1), mi.Float(0))))
            _add_runs([*self._sums[:2], *self._alpha, *self._sums[2:]], planes, rows, starts, ends)
            dr.sync_thread()  # lest launches wait side by side, with all their samples
            if len(parts) == parts[-1] + 1 - parts[0]:
                parts = slice(parts[0], parts[-1] + 1)  # which is faster
            self._counts.reshape(2, -1)[: 1 + look, parts] += count

    def _planes(self, points, ray, weight, look):
        """Radiance of samples, and if there is a ``look``, albedo and normal (Color3f [n]); and did rays hit anything
        that the picture shows (Bool [n])?"""
        met = self._see(ray) if look else None
        radiance, hit, _ = self._sample(points, ray, met=met)
        planes = [mi.Color3f(radiance * weight)]
        if look:
            si = met.compute_surface_interaction(ray, mi.RayFlags.All)
            valid, normal = si.is_valid(), mi.Vector3f(si.sh_frame.n)
            albedo = dr.select(valid, si.bsdf(ray).eval_diffuse_reflectance(si, valid), 0)
            albedo = dr.select(dr.isfinite(albedo), dr.clip(albedo, 0, 1), 1)
            planes += [mi.Color3f(albedo), mi.Color3f(dr.select(valid, normal, 0))]
        return planes, hit

    def _where_needed(self):
        """What samples of pixels (float32 [height, width]) go with, for the sum of errors to be least;
        judged by how far two denoised halves are apart in 8-bit sRGB."""
        ndimage: Any = optional("scipy.ndimage", "denoising", "denoise")
        color, apart, *features = (_blocks(self._mean(k), COARSE * FINE) for k in range(4))
        one, other = (srgb(self._denoised([half, *features], GLANCE)) for half in (color + apart, color - apart))
        error = np.nan_to_num(np.mean((one - other) ** 2, axis=2)).repeat(COARSE, axis=0).repeat(COARSE, axis=1)
        taken = self._taken()
        error = ndimage.gaussian_filter(error[: taken.shape[0], : taken.shape[1]], SMOOTH)
        # That of well spread samples falls about as the square of how many they are.
        return np.cbrt(np.maximum(error, LEAST_ERROR * error.mean() + 1e-9) * taken**2).astype(np.float32)

    def _shares(self, spp):
        """How many of ``spp`` more samples in the mean every pixel gets (float32 [height, width])."""
        taken = self._taken()
        if self._needed is None:
            return np.full_like(taken, spp)
        low, high = 0.0, (spp + taken.max()) / self._needed.min()
        for _ in range(30):
            scale = (low + high) / 2
            more = np.clip(np.minimum(scale * self._needed, MOST * (self._spp + spp)) - taken, 0, None)
            low, high = (scale, high) if more.mean() < spp else (low, scale)
        return more

    def _taken(self):
        """Samples of pixels (float32 [height, width])."""
        return FINE**2 * _blocks(np.float32(self._counts[0, ..., None]), FINE)[..., 0]

    def _mean(self, k):
        """Mean of what the sums number k are of [height, width, 3]."""
        return _over(self._sums[k], self._counts[k // 2])

    def _denoised(self, planes, way):
        """Radiance without its noise, of it with albedo and normals, at the quality of a way."""
        color, albedo, normal = (np.ascontiguousarray(plane, np.float32) for plane in planes)
        how = {"hdr": True, "clean_aux": True, "quality": getattr(self._denoiser.Quality, way.quality)}
        return np.asarray(self._denoiser.denoise(color, albedo=np.clip(albedo, 0, 1), normal=normal, **how))

    def image(self, seconds: float | None = None) -> "mi.TensorXf":
        """What has been sampled, without its noise; as well as ``seconds`` allow, if given."""
        most = np.inf if seconds is None else seconds
        way = self._way(self._spp, lambda way: self._takes(way) <= most)
        start, planes = time.perf_counter(), [self._mean(k) for k in (0, 2, 3)]
        clean = self._denoised(planes if way.parts > 1 else [_blocks(plane, FINE) for plane in planes], way)
        rfilter = self._film.rfilter()
        alpha = [_filtered(_over(total, self._counts[0]), rfilter, FINE)[..., 0] for total in self._alpha]
        rgb = _filtered(clean, rfilter, way.parts)
        image = mi.TensorXf(on_film(rgb, alpha[0] if alpha else None, self._film))
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
        return way.cost * self._pace * self._counts[0].size / FINE**2

    def _way(self, spp, allowed):
        """The best way to denoise ``spp`` samples per pixel of those that are allowed, or the cheapest."""
        ways = [way for way in WAYS if allowed(way) and spp >= way.least]
        return (ways or WAYS[:1])[-1]


def _over(total, count):
    """Sums (Color3f) over counts [height, width]: means [height, width, 3]."""
    return np.array(total).T.reshape(*count.shape, 3) / count[..., None].astype(np.float32)


def _add_runs(sums, planes, row, start, end):
    """Add colours from ``start`` to ``end`` to rows of sums, in this order (UInt32 [runs])."""
    dr.eval(planes)
    state = start, *(dr.gather(mi.Color3f, total, row) for total in sums[: len(planes)])

    def add(k, *totals):
        return k + 1, *(total + dr.gather(mi.Color3f, plane, k) for total, plane in zip(totals, planes))

    _, *totals = dr.while_loop(state, lambda k, *_: k < end, add)
    for total, more in zip(sums, totals):
        dr.scatter(total, more, row)
    dr.eval(sums)


def _blocks(image, side):
    """Means over blocks of ``side`` by ``side`` of an image; its last rows and columns count for what lies beyond."""
    height, width, _ = image.shape
    image = np.pad(image, ((0, -height % side), (0, -width % side), (0, 0)), mode="edge")
    return sum(image[i::side, j::side] for i in range(side) for j in range(side)) / side**2


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
