"""Points: uniform, independent between keys and seeds, well spread in any run, the same in arrays of any size.

All seeds are fixed, so a test passes always or never; limits are those of a stated confidence.
"""

from itertools import combinations, product
from statistics import NormalDist

from mi_radiosity.core.arrays import opaque_index
from mi_radiosity.core.points import (
    STEPS,
    Stream,
    cosine_direction,
    hash_pair,
    kronecker,
    permuted,
    stream_seed,
    triangle,
    uniform,
)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.fast

KEYS = 1 << 18
CONFIDENCE = 0.999  # of all comparisons of one test together


def sigmas(comparisons):
    """How many standard deviations none of so many normal numbers exceeds, with CONFIDENCE."""
    return NormalDist().inv_cdf(1 - (1 - CONFIDENCE) / 2 / comparisons)


def points(index, key, seed=0, owner=None):
    """`kronecker` with NumPy arrays or numbers (float64 [4, n])."""
    index, key, seed, owner = (
        None if a is None else mi.UInt32(np.atleast_1d(np.asarray(a, dtype=np.int64)).astype(np.uint32))
        for a in (index, key, seed, owner)
    )
    return np.array(kronecker(index, key, seed, owner), dtype=float).reshape(4, -1)


def accepted(domain, sample, pdf, tests, **options):
    """Does Pearson's χ² test, one of ``tests``, accept that sample(u) has the density pdf?"""
    test = mi.chi2.ChiSquareTest(domain, sample, pdf, sample_count=1_000_000, **options)
    return test.run(significance_level=1 - CONFIDENCE, test_count=tests, quiet=True), test.messages


def unit_square():
    return mi.chi2.PlanarDomain(mi.ScalarBoundingBox2f([0, 0], [1, 1]))


def is_uniform(sample, tests):
    """Is sample(n), a mi.Point2f in the unit square, uniform there?"""
    return accepted(unit_square(), lambda u: sample(dr.width(u)), lambda p: dr.full(mi.Float, 1, dr.width(p)), tests)


# ---- The sequence ----------------------------------------------------------------------------------


def test_steps_are_those_of_the_sequence():
    """φ⁻¹ … φ⁻⁴ of φ⁵ = φ + 1, in 32 bits."""
    phi = max(np.roots([1, 0, 0, 0, -1, -1]).real)
    np.testing.assert_allclose(np.array(STEPS) / 2**32, phi ** -np.arange(1.0, 5), rtol=0, atol=2.0**-33 * 1.01)


def test_points_go_on_by_the_steps():
    """Point n is the shift plus n steps, in integers modulo 1, beyond the last index as well."""
    index = np.array([0, 1, 2, 3, 1000, 10**6, 2**31, 2**32 - 2, 2**32 - 1])
    first = points(0, 5, 9)
    for d in range(4):
        steps = np.array([(int(n) * STEPS[d] % 2**32) / 2**32 for n in index])
        off = (points(index, 5, 9)[d] - first[d] - steps + 0.5) % 1 - 0.5
        assert np.abs(off).max() <= 2.0**-24


def test_points_lie_in_the_unit_cube():
    """0 ≤ x < 1 as float32 has it."""
    x = points(np.arange(1 << 20), 1)
    assert x.min() >= 0 and x.max() < 1 and x.astype(np.float32).max() < 1
    assert x.min() < 1e-5 and x.max() > 1 - 1e-5


# ---- Uniformity ------------------------------------------------------------------------------------


@pytest.mark.parametrize("d, e", list(combinations(range(4), 2)))
@pytest.mark.parametrize("index", [0, 7])
def test_any_point_is_uniform_over_keys(d, e, index):
    def sample(n):
        x = kronecker(dr.full(mi.UInt32, index, n), dr.arange(mi.UInt32, n), mi.UInt32(3))
        return mi.Point2f(x[d], x[e])

    passed, why = is_uniform(sample, tests=12)
    assert passed, why


@pytest.mark.parametrize("d", range(4))
def test_any_point_is_uniform_over_seeds(d):
    """And independent of that of the next seed: users take 0, 1, 2, …"""

    def sample(n):
        index, key, seed = dr.zeros(mi.UInt32, n), dr.full(mi.UInt32, 11, n), dr.arange(mi.UInt32, n)
        return mi.Point2f(kronecker(index, key, seed)[d], kronecker(index, key, seed + 1)[d])

    passed, why = is_uniform(sample, tests=4)
    assert passed, why


def test_triangle_is_uniform():
    """(u + v)² and u/(u + v) are uniform in the unit square where (u, v) is in the triangle."""

    def sample(u):
        a, b = triangle(u.x, u.y)
        return mi.Point2f(dr.square(a + b), a / (a + b))

    passed, why = accepted(unit_square(), sample, lambda p: dr.full(mi.Float, 1, dr.width(p)), tests=1)
    assert passed, why


def test_triangle_stays_inside():
    u, v = (mi.Float(x) for x in np.array(list(product([0, 1e-7, 0.3, 1 - 2.0**-24], repeat=2)), dtype=np.float32).T)
    a, b = (np.array(x, dtype=float) for x in triangle(u, v))
    assert a.min() >= 0 and b.min() >= 0 and (a + b).max() <= 1 + 1e-6


NORMALS = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0), (0.36, -0.48, 0.8), (-0.6, 0.64, -0.48)]


@pytest.mark.parametrize("normal", NORMALS)
def test_cosine_direction(normal):
    passed, why = accepted(
        mi.chi2.SphericalDomain(),
        lambda u: cosine_direction(mi.Vector3f(normal), u.x, u.y),
        lambda w: dr.maximum(dr.dot(w, mi.Vector3f(normal)), 0) * dr.inv_pi,
        tests=len(NORMALS),
        res=51,
        ires=16,
    )
    assert passed, why


@pytest.mark.parametrize("normal", NORMALS)
def test_directions_are_unit_vectors_on_their_side(normal):
    u, v = (mi.Float(x) for x in points(np.arange(10_000), 1)[:2].astype(np.float32))
    w = np.array(cosine_direction(mi.Vector3f(normal), u, v))
    np.testing.assert_allclose((w**2).sum(axis=0), 1, atol=1e-6)
    assert (np.array(normal) @ w).min() >= 0


# ---- Independence ----------------------------------------------------------------------------------


def correlations(x, y):
    """Correlation of every row of x with every row of y, in standard deviations of independent uniform numbers."""
    return (x - 0.5) @ (y - 0.5).T * 12 / x.shape[1] ** 0.5


@pytest.mark.parametrize("seed", [0, 1, 2**32 - 1])
def test_neighbouring_keys_are_independent(seed):
    lags = [1, 2, 3, 4, 64, 1 << 10, 1 << 17]
    x = points(np.zeros(KEYS), np.arange(KEYS), seed)
    found = np.abs([correlations(x[:, :-lag], x[:, lag:]) for lag in lags])
    assert found.max() < sigmas(found.size)


@pytest.mark.parametrize("change", [1, 2, 1 << 16, 1 << 31])
def test_seeds_are_independent(change):
    keys = np.arange(KEYS)
    found = np.abs([correlations(points(0 * keys, keys, s), points(0 * keys, keys, s ^ change)) for s in (0, 1, 12345)])
    assert found.max() < sigmas(found.size)


def test_coordinates_are_independent():
    x = points(np.zeros(KEYS), np.arange(KEYS))
    found = np.abs(correlations(x, x)[~np.eye(4, dtype=bool)])
    assert found.max() < sigmas(6)


def test_hash_pair_changes_half_of_its_bits():
    """Whatever one bit of its arguments does: the mean over 4,096 pairs for each of 64 input and 32 output bits."""
    random, n = np.random.default_rng(1), 1 << 12
    a, b = random.integers(0, 2**32, (2, n), dtype=np.uint64).astype(np.uint32)
    before, flips = np.array(hash_pair(mi.UInt32(a), mi.UInt32(b))), []
    for bit in range(32):
        mask = np.uint32(1 << bit)
        for x, y in ((a ^ mask, b), (a, b ^ mask)):
            changed = before ^ np.array(hash_pair(mi.UInt32(x), mi.UInt32(y)))
            flips.append([(changed >> k & 1).mean() for k in range(32)])
    assert (np.abs(np.array(flips) - 0.5) * 2 * n**0.5).max() < sigmas(64 * 32)


def test_hash_pair_has_no_more_collisions_than_chance():
    """2^18 pairs of small numbers: eight equal pairs expected, more than 24 once in 10⁵ times."""
    a, b = np.divmod(np.arange(1 << 18), 1 << 9)
    hashes = np.array(hash_pair(mi.UInt32(a.astype(np.uint32)), mi.UInt32(b.astype(np.uint32))))
    assert len(hashes) - len(np.unique(hashes)) <= 24


# ---- Spread ----------------------------------------------------------------------------------------

RUNS = [5, 10, 16, 64, 300, 1024]  # lines of a pair, rays of an element


def wraparound_discrepancy(x):
    """Squared L₂ discrepancy of points [d, n] over the boxes of the torus (Hickernell 1998); shifts keep it."""
    distance = np.abs(x[:, :, None] - x[:, None])
    return (1.5 - distance * (1 - distance)).prod(axis=0).mean() - (4 / 3) ** len(x)


@pytest.mark.parametrize("start", [0, 1, 12345, 2**32 - 7])
@pytest.mark.parametrize("n", RUNS)
def test_any_run_is_better_spread_than_random_points(n, start):
    """Discrepancy in 4, and in the 2 coordinates of each end of a line; random points have ((3/2)^d − (4/3)^d)/n."""
    x = points((start + np.arange(n)) % 2**32, 77)
    for chosen, share in (([0, 1, 2, 3], 0.75), ([0, 1], 0.65), ([2, 3], 0.65)):
        random = (1.5 ** len(chosen) - (4 / 3) ** len(chosen)) / n
        assert wraparound_discrepancy(x[chosen]) < share * random


FUNCTIONS = {  # with their variances
    "x": (lambda x: x[0], 1 / 12),
    "x + y + z + w": (lambda x: x.sum(axis=0), 4 / 12),
    "xy": (lambda x: x[0] * x[1], 1 / 9 - 1 / 16),
    "x + y < 1": (lambda x: (x[0] + x[1] < 1).astype(float), 1 / 4),
    "z + w < 1": (lambda x: (x[2] + x[3] < 1).astype(float), 1 / 4),
    "xyzw": (lambda x: x.prod(axis=0), 1 / 81 - 1 / 256),
}


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("n", RUNS)
def test_estimates_have_less_variance_than_with_random_points(n, name):
    """Over 2,000 keys and starts, whose variance is known to 3 %."""
    function, variance = FUNCTIONS[name]
    starts = np.random.default_rng(n).integers(0, 2**32, 2000)
    index = (starts[:, None] + np.arange(n)) % 2**32
    means = function(points(index.ravel(), np.arange(2000), owner=np.repeat(np.arange(2000), n))).reshape(-1, n)
    assert means.mean(axis=1).var() < 0.95 * variance / n


@pytest.mark.parametrize("n", [1, 7, 10, 64])
def test_unbiased_over_seeds(n):
    """Means over 20,000 seeds of what n points of one key estimate are within the confidence of their spread."""
    seeds = np.repeat(np.arange(20_000), n)
    x = points(np.tile(100 + np.arange(n), 20_000), np.full(len(seeds), 4), seeds)
    exact = {"x": 1 / 2, "x + y + z + w": 2, "xy": 1 / 4, "x + y < 1": 1 / 2, "z + w < 1": 1 / 2, "xyzw": 1 / 16}
    for name, (function, _) in FUNCTIONS.items():
        means = function(x).reshape(-1, n).mean(axis=1)
        assert abs(means.mean() - exact[name]) < sigmas(len(FUNCTIONS)) * means.std() / len(means) ** 0.5, name


# ---- Arrays ----------------------------------------------------------------------------------------


def test_the_same_points_in_arrays_of_any_size():
    """A point depends on its index, key and seed alone."""
    index, key = np.arange(1000) * 17, np.arange(1000) * 31
    whole = points(index, key, 8)
    for part in (slice(0, 1), slice(3, 4), slice(500, 1000), slice(None, None, 7)):
        np.testing.assert_array_equal(points(index[part], key[part], 8), whole[:, part])
    np.testing.assert_array_equal(points(np.repeat(index, 3), np.repeat(key, 3), 8), np.repeat(whole, 3, axis=1))


@pytest.mark.parametrize("count", [1, 2, 50])
def test_keys_of_owners(count):
    """One key for all, or one per owner, as one key per point."""
    owner, index, key = np.arange(300) % count, np.arange(300), 1000 + np.arange(count)
    each = points(index, key[owner], 8)
    np.testing.assert_array_equal(points(index, key, 8, owner), each)
    if count == 1:
        np.testing.assert_array_equal(points(index, key, 8), each)


# ---- Streams ---------------------------------------------------------------------------------------


def test_streams_do_not_collide():
    """All streams, 64 numbers and 40 seeds, of either sign and beyond 32 bits, have seeds of their own."""
    seeds = [*range(-8, 24), 1234, 10**6, 2**31 - 1, 2**31, 2**32 - 9, 99999, 424242, 2**24]
    cases = list(product(seeds, Stream, range(64)))
    found = {stream_seed(*case) for case in cases}
    assert all(0 <= seed < 2**32 for seed in found)
    # Of n random 32-bit numbers, n²/2³³ pairs are expected to be equal: 0.04 for these.
    assert len(found) == len(cases)


def test_a_seed_is_32_bits():
    assert stream_seed(-1, Stream.POWER) == stream_seed(2**32 - 1, Stream.POWER)
    assert stream_seed(2**32 + 5, Stream.PILOT, 3) == stream_seed(5, Stream.PILOT, 3)


@pytest.mark.parametrize("what", ["seed", "stream", "number"])
def test_neighbouring_streams_share_no_bits(what):
    """Each of the 32 bits flips in half of the cases when seed, stream or number goes on by one."""
    cases = range(2000)
    if what == "stream":
        pairs = [(stream_seed(k, a), stream_seed(k, b)) for k in cases for a, b in zip(Stream, list(Stream)[1:])]
    else:
        step = {"seed": lambda k: stream_seed(k, Stream.POWER), "number": lambda k: stream_seed(1, Stream.PILOT, k)}[
            what
        ]
        pairs = [(step(k), step(k + 1)) for k in cases]
    flips = np.array([[(a ^ b) >> bit & 1 for bit in range(32)] for a, b in pairs]).mean(axis=0)
    assert np.abs(flips - 0.5).max() < sigmas(32) * 0.5 / len(pairs) ** 0.5


def test_uniform_is_uniform():
    """Over keys for a seed, and over seeds for a key: pairs of neighbours fill the square."""

    def neighbours(n):
        k = 2 * dr.arange(mi.UInt32, n)
        return mi.Point2f(uniform(k, mi.UInt32(3)), uniform(k + 1, mi.UInt32(3)))

    def seeds(n):
        k = 2 * dr.arange(mi.UInt32, n)
        return mi.Point2f(uniform(mi.UInt32(3), k), uniform(mi.UInt32(3), k + 1))

    for sample in (neighbours, seeds):
        ok, why = is_uniform(sample, 2)
        assert ok, why
    x = np.array(uniform(dr.arange(mi.UInt32, KEYS), mi.UInt32(0)))
    assert x.min() >= 0 and x.max() < 1


@pytest.mark.parametrize("count", [1, 2, 3, 16, 24, 100])
def test_permutations_are_mitsubas(count):
    """Any number of samples, in one kernel; and each is a permutation."""
    index = dr.arange(mi.UInt32, 50 * count)
    order, index = mi.sample_tea_32(index // count, mi.UInt32(3))[0], index % count
    found = np.array(permuted(index, opaque_index(count), order))
    np.testing.assert_array_equal(found, np.array(mi.permute_kensler(index, count, order)))
    assert (np.sort(found.reshape(50, count), axis=1) == np.arange(count)).all()
