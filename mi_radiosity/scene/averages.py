"""Means of reflectance and emission over faces and over parts of faces, unbiased whatever the textures are."""

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned, runs
from ..core.points import ROUNDS, Stream, hash_pair, stream_seed, triangle
from .faces import Faces

# Points are shared out by area, so that a mean over any share s of the textured area has about s · POINTS points at
# every depth of the mesh. A texture much finer than the points with a relative deviation of one half then leaves an
# error of 0.5 / √(s · POINTS): 0.16 % for s = 20 %. POINTS bounds the work of every depth, beside the LEAST points
# that every face or element has.
POINTS = 1 << 19
LEAST, MOST = 2, 9  # points of a face or of an element, as powers of 4: 16 to 262,144
CHUNK = 256  # points that one thread adds up

Value = Callable[["mi.UInt32", "mi.Float", "mi.Float", "mi.Bool"], "mi.Color3f"]


class Averages:
    """Averages colours over triangles of faces.

    ``varies`` (bool [faces]) says where a colour is not constant. There the triangle is divided into cells of equal
    area, and each cell has one random point. No period of a texture can be in step with such points, because every
    point is random within its cell. Random numbers come from the face's canonical rank and from the place of the
    triangle, so results depend neither on Mitsuba's order of shapes nor on the number of threads.
    """

    def __init__(self, faces: Faces, varies: np.ndarray) -> None:
        area = np.where(varies, faces.area, 0)
        wanted = np.maximum(POINTS * area / max(area.sum(), np.finfo(float).tiny), 1)
        exponent = np.clip(np.ceil(np.log2(wanted) / 2), LEAST, MOST)
        self._exponent = owned(mi.UInt32, np.where(varies, exponent, 0))
        self._rank = owned(mi.UInt32, faces.rank)
        self._any = bool(varies.any())

    def mean(
        self, value: Value, face: "mi.UInt32", back: "mi.Bool", u0: "mi.Float", v0: "mi.Float", scale: "mi.Float"
    ) -> "mi.Color3f":
        """Means over the triangles (u0 + scale a, v0 + scale b), a, b ≥ 0, a + b ≤ 1, of faces (Color3f [n]).

        value(face, u, v, back): the colour at points of faces (UInt32, Float, Float, Bool [m] ─► Color3f [m]). scale:
        ±2^(−depth). The mean of a constant colour is that colour to the bit.
        """
        n, third = dr.width(face), 1 / 3
        result = mi.Color3f(value(face, u0 + scale * third, v0 + scale * third, back)) + dr.zeros(mi.Color3f, n)
        dr.eval(result)
        exponent = dr.gather(mi.UInt32, self._exponent, face)
        various = dr.compress(exponent > 0) if self._any else mi.UInt32()
        if dr.width(various) == 0:
            return result
        entry = [dr.gather(type(x), x, various) for x in (face, back, u0, v0, scale, result)]
        depth = 127 - ((dr.reinterpret_array(mi.UInt32, entry[4]) >> 23) & 0xFF)  # of the power of two that scale is
        exponent = dr.gather(mi.UInt32, exponent, various)
        exponent = dr.select(exponent > depth + LEAST, exponent - depth, LEAST)
        sums = self._sums(value, entry, exponent)
        for channel, total in zip(result, sums):
            start = dr.gather(mi.Float, channel, various)
            dr.scatter(channel, start + owned(mi.Float, total), various)
        dr.eval(result)
        return result

    def _sums(self, value, entry, exponent):
        """Means of value − first over the points of triangles, 4^exponent each (three NumPy [n]).

        entry: face, back, u0, v0, scale and first.
        """
        face, back, u0, v0, scale, first = entry
        count = 4 ** np.array(exponent, dtype=np.int64)
        owner, number = runs(-(-count // CHUNK))
        key = self._keys(face, u0, v0, scale)
        row, k = owned(mi.UInt32, owner), owned(mi.UInt32, number * CHUNK)
        face, back, u0, v0, scale, first, exponent, key = (
            dr.gather(type(x), x, row) for x in (face, back, u0, v0, scale, first, exponent, key)
        )
        end = dr.minimum(k + CHUNK, mi.UInt32(1) << (2 * exponent))
        dr.eval(face, back, u0, v0, scale, first, exponent, key, k, end)

        def step(k, total):
            x, y = (mi.Float(random >> 8) * 2.0**-24 for random in mi.sample_tea_32(key, k, ROUNDS))
            side = mi.Float(mi.UInt32(1) << exponent)
            column, line = k & ((mi.UInt32(1) << exponent) - 1), k >> exponent
            a, b = triangle((mi.Float(column) + x) / side, (mi.Float(line) + y) / side)
            return k + 1, total + (value(face, u0 + scale * a, v0 + scale * b, back) - first)

        state = k, dr.zeros(mi.Color3f, dr.width(k))
        _, total = dr.while_loop(state, lambda k, _: k < end, step)
        dr.eval(total)
        start = np.flatnonzero(number == 0)
        return [np.add.reduceat(np.array(channel, dtype=np.float64), start) / count for channel in total]

    def _keys(self, face, u0, v0, scale):
        """What the random numbers of triangles are drawn by (UInt32 [n])."""
        key = hash_pair(dr.gather(mi.UInt32, self._rank, face), dr.opaque(mi.UInt32, stream_seed(0, Stream.AVERAGE)))
        for place in (u0, v0, scale):
            key = hash_pair(key, dr.reinterpret_array(mi.UInt32, place + 0.0))
        return key
