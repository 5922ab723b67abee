"""Counter-based low-discrepancy points, and the streams they are drawn from.

A four-dimensional Kronecker sequence (Roberts' R₄: point n is frac(s + n·(φ⁻¹, φ⁻², φ⁻³, φ⁻⁴)), φ⁵ = φ + 1)
has what both of its users need: any run of consecutive points is again well spread, so the rays of
one element are stratified whatever their number, and so are the lines of one pair for any S.
The shift s is a hash of a key, which makes the estimates unbiased over seeds and independent
between keys, threads and array sizes.
"""

from enum import IntEnum

import drjit as dr
import mitsuba as mi

_PHI = 1.1673039782614187
ROUNDS = 8  # of the hash: with Mitsuba's 4, the numbers of neighbouring keys and seeds go together
STEPS = tuple(round(_PHI ** -(d + 1) * 2**32) for d in range(4))


class Stream(IntEnum):
    """Who draws: no two of them see the same numbers. The order is part of what a seed means."""

    POWER = 0  # rays that carry the power of the solution
    PAIRS = 1  # lines between the elements of a pair
    PILOT = 2  # rays that discover pairs; one stream each
    COVER = 3  # points that show what of a leaf is covered
    GATHER = 4  # lines and rays of leaves that gather
    REACH = 5  # rays that look for light while a scene is read
    MEASURE = 6  # irradiance at points of the user's
    ALBEDO = 7  # directions that the albedo of a diffuse lobe is found with
    PIXELS = 9  # camera samples
    LOBES = 8  # what lobes rays draw on their way
    FACTORS = 10  # rays and lines that view factors are made of
    SIGHT = 11  # points of leaves that walls cross, from which their light is looked for
    AVERAGE = 12  # points that reflectance and emission of faces and elements are averaged over


def stream_seed(seed: int, stream: Stream, number: int = 0) -> int:
    """The 32-bit seed of a stream: a mix of the user's seed, of who draws, and of a number of his (Python int)."""
    mixed = (seed & 0xFFFFFFFF) ^ (0x9E3779B97F4A7C15 * (1 + stream + 64 * number) & 0xFFFFFFFFFFFFFFFF)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):  # SplitMix64's finaliser
        mixed = ((mixed ^ (mixed >> shift)) * factor) & 0xFFFFFFFFFFFFFFFF
    return (mixed ^ (mixed >> 31)) & 0xFFFFFFFF


def kronecker(
    index: "mi.UInt32", key: "mi.UInt32", seed: "mi.UInt32", owner: "mi.UInt32 | None" = None
) -> "tuple[mi.Float, ...]":
    """Four uniform numbers in [0, 1) per entry: point ``index`` of the sequence shifted by ``key``.

    index: UInt32 [n]; seed: UInt32 (use an opaque literal); key: UInt32 [n] or one for all; or, with
    owner (UInt32 [n]), UInt32 [m], the key of entry k being key[owner[k]]. Returns 4 Float [n].
    """
    shifts = [*mi.sample_tea_32(key, seed, ROUNDS), *mi.sample_tea_32(key ^ 0x9E3779B9, seed, ROUNDS)]
    if owner is not None or dr.width(key) == 1:
        dr.eval(shifts)  # hash once per key, not once per point
    if owner is not None:
        shifts = [dr.gather(mi.UInt32, shift, owner) for shift in shifts]
    return tuple(mi.Float((shift + index * mi.UInt32(step)) >> 8) * 2.0**-24 for shift, step in zip(shifts, STEPS))


def paired_nets(
    index: "mi.UInt32", count: "mi.UInt32", key: "mi.UInt32", seed: "mi.UInt32", owner: "mi.UInt32"
) -> "tuple[mi.Float, ...]":
    """Four uniform numbers in [0, 1) per entry: two (0,2)-sequences, paired in random order.

    index: UInt32 [n], point of the set of key[owner]; count: UInt32 [n], size of that set; owner: UInt32 [n]; key:
    UInt32 [m]; seed: UInt32 (use an opaque literal). Returns 4 Float [n]. Their counts in any region vary hardly more
    than those of independent points. The lattice of `kronecker` has regions where the variance is 5 times as large,
    so errors that assume independent points would be too small there.
    """
    shifts = [*mi.sample_tea_32(key, seed, ROUNDS), *mi.sample_tea_32(key ^ 0x9E3779B9, seed, ROUNDS)]
    shifts.append(hash_pair(key ^ 0x3C6EF372, seed))
    dr.eval(shifts)  # hash once per key, not once per point
    a, b, c, d, order = (dr.gather(mi.UInt32, shift, owner) for shift in shifts)
    other = permuted(index, count, order)
    first = mi.radical_inverse_2(index, a), mi.sobol_2(index, b)
    return *first, mi.radical_inverse_2(other, c), mi.sobol_2(other, d)


def lamp_lot(index: "mi.UInt32", key: "mi.UInt32", seed: "mi.UInt32", owner: "mi.UInt32") -> "mi.Float":
    """What draws the lamp of line ``index`` of key[owner] (Float [n]): a sequence beside `kronecker`'s, of van der
    Corput's numbers, any run of which is spread over the lamps."""
    scramble = hash_pair(key ^ 0xA511E9B3, seed)
    dr.eval(scramble)  # hash once per key, not once per point
    return mi.radical_inverse_2(index, dr.gather(mi.UInt32, scramble, owner))


def hash_pair(a: "mi.UInt32", b: "mi.UInt32") -> "mi.UInt32":
    """One well mixed number from two (UInt32 [n])."""
    return mi.sample_tea_32(a, b, ROUNDS)[0]


def uniform(key: "mi.UInt32", seed: "mi.UInt32") -> "mi.Float":
    """One uniform number in [0, 1) per key (Float [n])."""
    return mi.sample_tea_float32(key, seed, ROUNDS)


def triangle(u: "mi.Float", v: "mi.Float") -> "tuple[mi.Float, mi.Float]":
    """Uniform barycentric coordinates (Float u, Float v) of a triangle from two uniform numbers."""
    point = mi.warp.square_to_uniform_triangle(mi.Point2f(u, v))
    return point.x, point.y


def coordinates(x: "mi.Vector3f", e1: "mi.Vector3f", e2: "mi.Vector3f") -> "tuple[mi.Float, mi.Float]":
    """(u, v) of x = u e₁ + v e₂ in the plane of a triangle, x taken from its corner (two Float [n])."""
    normal = dr.cross(e1, e2)
    n2 = dr.squared_norm(normal)
    return dr.dot(dr.cross(x, e2), normal) / n2, dr.dot(dr.cross(e1, x), normal) / n2


def cosine_direction(normal: "mi.Vector3f", u: "mi.Float", v: "mi.Float") -> "mi.Vector3f":
    """Cosine-distributed unit direction about ``normal`` (Vector3f [n])."""
    return mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u, v)))


@dr.syntax
def permuted(index: "mi.UInt32", count: "mi.UInt32", order: "mi.UInt32") -> "mi.UInt32":
    """Where each of 0…count − 1 goes in the permutation that ``order`` names (UInt32 [n]).

    Mitsuba's `permute_kensler` has the count in its kernel, so that every number of samples compiles anew. Source:
    Kensler, "Correlated multi-jittered sampling", 2013.
    """
    count = dr.maximum(count, 1)  # lanes that pad the last vector gather 0, and an integer division by 0 aborts
    mask = count - 1
    for shift in (1, 2, 4, 8, 16):
        mask |= mask >> shift
    place, outside = mi.UInt32(index), dr.full(mi.Bool, True, dr.width(index))
    while outside:
        place = _scrambled(place, mask, order)
        outside = place >= count
    return (place + order) % count


def _scrambled(x, mask, order):
    """One round of it, within the bits of the mask."""
    x = (x ^ order) * 0xE170893D
    x ^= order >> 16
    x ^= (x & mask) >> 4
    x = (x ^ (order >> 8)) * 0x0929EB3F
    x ^= order >> 23
    x ^= (x & mask) >> 1
    x *= 1 | (order >> 27)
    for factor, shift in ((0x6935FA69, 11), (0x74DCB303, 2), (0x9E501CC3, 2)):
        x *= factor
        x ^= (x & mask) >> shift
    x = (x * 0xC860A3DF) & mask
    return x ^ (x >> 5)
