"""Counter-based low-discrepancy points.

A four-dimensional Kronecker sequence (Roberts' R₄: point n is frac(s + n·(φ⁻¹, φ⁻², φ⁻³, φ⁻⁴)), φ⁵ = φ + 1)
has what both of its users need: any run of consecutive points is again well spread, so the rays of
one element are stratified whatever their number, and so are the lines of one pair for any S.
The shift s is a hash of a key, which makes the estimates unbiased over seeds and independent
between keys, threads and array sizes.
"""

import drjit as dr
import mitsuba as mi

_PHI = 1.1673039782614187
ROUNDS = 8  # of the hash: with Mitsuba's 4, the numbers of neighbouring keys and seeds go together
STEPS = tuple(round(_PHI ** -(d + 1) * 2**32) for d in range(4))


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


def hash_pair(a: "mi.UInt32", b: "mi.UInt32") -> "mi.UInt32":
    """One well mixed number from two (UInt32 [n])."""
    return mi.sample_tea_32(a, b, ROUNDS)[0]


def triangle(u: "mi.Float", v: "mi.Float") -> "tuple[mi.Float, mi.Float]":
    """Uniform barycentric coordinates (Float u, Float v) of a triangle from two uniform numbers."""
    point = mi.warp.square_to_uniform_triangle(mi.Point2f(u, v))
    return point.x, point.y


def cosine_direction(normal: "mi.Vector3f", u: "mi.Float", v: "mi.Float") -> "mi.Vector3f":
    """Cosine-distributed unit direction about ``normal`` (Vector3f [n])."""
    return mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(mi.Point2f(u, v)))
