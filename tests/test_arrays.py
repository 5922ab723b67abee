"""Searching, joining and summing arrays, against NumPy and exact fractions."""

from fractions import Fraction

from mi_radiosity.core.arrays import (
    ColorSums,
    Distribution,
    components,
    concat,
    lower_bound,
    lower_bound_within,
    opaque_index,
    owned,
    owned_vectors,
    power_of_two,
    runs,
    totals,
    unique,
)

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

pytestmark = pytest.mark.fast

EXAMPLES = settings(max_examples=100, deadline=None, derandomize=True)
TYPES = {"Float": np.float32, "Float64": np.float64, "UInt32": np.uint32, "UInt64": np.uint64, "Int64": np.int64}


def keys(bits, low=1, high=40):
    """Lists of unsigned numbers, close together (so that they repeat) or anywhere."""
    anywhere = st.one_of(st.integers(0, 9), st.integers(0, 2**bits - 1), st.just(2**bits - 1))
    return st.lists(anywhere, min_size=low, max_size=high)


# ---- concat ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("widths", [(3,), (1, 1), (0, 4), (4, 0), (2, 0, 0, 5, 1), (0,), (0, 0), (1000, 1)], ids=str)
def test_concat(name, widths):
    kind, random = getattr(mi, name), np.random.default_rng(1)
    parts = [random.integers(0, 1000, n).astype(TYPES[name]) for n in widths]
    joined = concat(*map(kind, parts))
    assert type(joined) is kind
    np.testing.assert_array_equal(np.array(joined), np.concatenate(parts))


def test_concat_of_colours():
    joined = concat(mi.Color3f([1, 2], [3, 4], [5, 6]), mi.Color3f(7, 8, 9), mi.Color3f(dr.zeros(mi.Float, 0)))
    assert type(joined) is mi.Color3f
    np.testing.assert_array_equal(np.array(joined), [[1, 2, 7], [3, 4, 8], [5, 6, 9]])


def test_concat_copies():
    """What is written to the parts later does not show."""
    part = mi.UInt32([1, 2, 3])
    joined = concat(part, mi.UInt32([4]))
    dr.scatter(part, mi.UInt32(9), mi.UInt32(0))
    np.testing.assert_array_equal(np.array(joined), [1, 2, 3, 4])


# ---- unique ----------------------------------------------------------------------------------------


@EXAMPLES
@given(keys(64))
def test_unique(values):
    np.testing.assert_array_equal(
        np.array(unique(mi.UInt64(np.array(values, dtype=np.uint64)))), np.unique(np.array(values, dtype=np.uint64))
    )


@pytest.mark.parametrize("n", [1, 2, 1000])
def test_unique_of_equal_keys(n):
    assert np.array(unique(dr.full(mi.UInt64, 2**64 - 1, n))).tolist() == [2**64 - 1]


def test_unique_of_nothing():
    assert dr.width(unique(mi.UInt64())) == 0


# ---- lower_bound -----------------------------------------------------------------------------------


@EXAMPLES
@given(keys(64), keys(64))
def test_lower_bound(table, wanted):
    """As searchsorted, but beyond the end the last position: repeated keys give the first of them."""
    table, wanted = np.sort(np.array(table, dtype=np.uint64)), np.array(wanted, dtype=np.uint64)
    expected = np.minimum(np.searchsorted(table, wanted), len(table) - 1)
    np.testing.assert_array_equal(np.array(lower_bound(mi.UInt64(table), mi.UInt64(wanted))), expected)


@pytest.mark.parametrize("name", TYPES)
def test_lower_bound_of_every_type(name):
    kind, table, wanted = getattr(mi, name), [1, 1, 2, 5, 5, 5, 9], [0, 1, 2, 3, 5, 9, 10]
    np.testing.assert_array_equal(np.array(lower_bound(kind(table), kind(wanted))), [0, 0, 2, 3, 3, 6, 6])


@pytest.mark.parametrize("wanted, at", [([0, 5, 9], [0, 0, 0]), ([5], [0])])
def test_lower_bound_in_a_table_of_one(wanted, at):
    np.testing.assert_array_equal(np.array(lower_bound(mi.UInt32([5]), mi.UInt32(wanted))), at)


def test_lower_bound_of_nothing():
    assert dr.width(lower_bound(mi.UInt32([1, 2]), mi.UInt32())) == 0


def test_a_table_without_entries_is_refused():
    with pytest.raises(RuntimeError):
        lower_bound(mi.UInt32(), mi.UInt32([1]))


def test_inactive_lanes_read_nothing():
    """Entries that are not active may point anywhere; the others are right."""
    table, active = mi.UInt32([2, 4, 6, 8]), mi.Bool([True, False, True])
    low, high = mi.UInt32([0, 10**9, 0]), mi.UInt32([3, 10**9 + 7, 3])
    found = np.array(lower_bound_within(table, mi.UInt32([5, 5, 8]), low, high, active))
    assert found[[0, 2]].tolist() == [2, 3]


@EXAMPLES
@given(st.lists(keys(32, high=12), min_size=1, max_size=8), st.data())
def test_lower_bound_within_segments(segments, data):
    """One key per segment of a table sorted in each of its segments only."""
    wanted = [data.draw(st.one_of(st.sampled_from(s), st.integers(0, 2**32 - 1))) for s in segments]
    ends = np.cumsum([len(s) for s in segments])
    starts = ends - [len(s) for s in segments]
    expected = [start + min(np.searchsorted(sorted(s), w), len(s) - 1) for start, s, w in zip(starts, segments, wanted)]
    table = np.concatenate([np.sort(s) for s in segments]).astype(np.uint32)
    found = lower_bound_within(
        mi.UInt32(table),
        mi.UInt32(np.array(wanted, dtype=np.uint32)),
        mi.UInt32(starts.astype(np.uint32)),
        mi.UInt32((ends - 1).astype(np.uint32)),
    )
    np.testing.assert_array_equal(np.array(found), expected)


def test_lower_bound_within_leaves_its_bounds_alone():
    low, high = mi.UInt32([0, 0]), mi.UInt32([3, 3])
    lower_bound_within(mi.UInt32([1, 2, 3, 4]), mi.UInt32([3, 4]), low, high)
    assert np.array(low).tolist() == [0, 0] and np.array(high).tolist() == [3, 3]


def test_lengths_need_no_new_kernels():
    """Tables and keys of any length run the kernels of the first; so do joins of as many parts."""

    def run(n, m):
        # Lists: Dr.Jit reads NumPy's memory in place and has its alignment in the kernels.
        table, wanted = mi.UInt64(list(range(0, 3 * n, 3))), mi.UInt64([7 * k % 99 for k in range(m)])
        dr.eval(lower_bound(table, wanted), concat(table, wanted), unique(wanted))

    run(500, 30)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        run(77, 1234)
        run(4096, 5)
        compiled = sum(not k["cache_hit"] for k in dr.kernel_history((dr.KernelType.JIT,)))
    assert compiled == 0


def test_opaque_index():
    assert opaque_index(7).state == dr.VarState.Evaluated and np.array(opaque_index(2**32 - 1)).tolist() == [2**32 - 1]


# ---- Sums ------------------------------------------------------------------------------------------


def fixed_point_sums(values, index, bins, bound):
    """What fixed-point sums are, in exact fractions: each value cut to the unit, towards 0 (lists [3][bins])."""
    sums = []
    for channel, b in zip(values, bound):
        unit, bin_sums = Fraction(power_of_two(b)) / 2**60, [Fraction(0)] * bins
        for value, k in zip(channel, index):
            bin_sums[k] += int(Fraction(float(value)) / unit) * unit
        sums.append(bin_sums)
    return sums


@st.composite
def deposits(draw):
    """Values [3, n] over twelve decades, the bins they go to, how many bins, and bounds their sums keep."""
    n, bins = draw(st.integers(1, 50)), draw(st.integers(1, 6))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    values = random.choice([-1, 1], (3, n)) * 10 ** random.uniform(-9, 3, (3, n))
    return values, random.integers(0, bins, n), bins, np.abs(values).sum(axis=1).tolist()


@EXAMPLES
@given(deposits())
def test_colour_sums_are_exact(case):
    """To the last bit what exact arithmetic makes of the fixed point, and to a rounding the sum itself."""
    values, index, bins, bound = case
    sums = ColorSums(bins, bound)
    sums.add([mi.Float64(v) for v in values], mi.UInt32(index.astype(np.uint32)))
    expected = fixed_point_sums(values, index, bins, bound)
    found = [np.array(s) for s in sums.gather(dr.arange(mi.UInt32, bins))]
    np.testing.assert_array_equal(found, [[float(s) for s in channel] for channel in expected])
    for channel, b, plain in zip(found, bound, [np.bincount(index, v, bins) for v in values]):
        np.testing.assert_allclose(channel, plain, rtol=0, atol=b * (1e-15 + len(index) * 2.0**-59))
    np.testing.assert_array_equal(sums.totals(), [float(sum(channel)) for channel in expected])


@EXAMPLES
@given(deposits(), st.integers(0, 2**32 - 1))
def test_order_does_not_matter(case, seed):
    """Any order, in one go or in several: the same bits."""
    values, index, bins, bound = case
    order = np.random.default_rng(seed).permutation(len(index))
    results = []
    for parts in ([np.arange(len(index))], np.array_split(order, min(3, len(order)))):
        sums = ColorSums(bins, bound)
        for part in parts:
            sums.add([mi.Float64(v[part]) for v in values], mi.UInt32(index[part].astype(np.uint32)))
        results.append((np.array(sums.gather(dr.arange(mi.UInt32, bins))), sums.totals()))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert results[0][1] == results[1][1]


def test_threads_do_not_matter():
    """A million floats of one sign and the other in ten bins, on one thread and on all of them."""
    random, threads, results = np.random.default_rng(7), dr.thread_count(), []
    values, index = random.normal(size=(3, 1 << 20)).astype(np.float32), random.integers(0, 10, 1 << 20)
    try:
        for count in (1, max(threads, 2)):
            dr.set_thread_count(count)
            sums = ColorSums(10, [2.0**20] * 3)
            sums.add(mi.Color3f(values), mi.UInt32(index.astype(np.uint32)))
            results.append(np.array(sums.gather(dr.arange(mi.UInt32, 10))))
    finally:
        dr.set_thread_count(threads)
    np.testing.assert_array_equal(*results)
    np.testing.assert_allclose(results[0], [np.bincount(index, v.astype(float), 10) for v in values], atol=1e-6)


def test_a_bound_that_differs_in_its_last_bit_gives_the_same_sums():
    found = []
    for bound in (0.7, np.nextafter(0.7, 1)):
        sums = ColorSums(1, [bound] * 3)
        sums.add([mi.Float64([0.1, 0.2, 0.3])] * 3, mi.UInt32([0, 0, 0]))
        found.append(sums.totals())
    assert found[0] == found[1]


def test_the_bound_itself_fits():
    """Sums as large as their bounds, powers of two too."""
    for bound in (1.0, 2.0, 3.0, 1e-30, 1e30):
        sums = ColorSums(1, [bound] * 3)
        sums.add([mi.Float64([bound])] * 3, mi.UInt32([0]))
        assert sums.totals() == pytest.approx([bound] * 3, rel=1e-15)


def test_inactive_entries_add_nothing():
    sums = ColorSums(2, [8.0] * 3)
    sums.add([mi.Float([1, 2, 4])] * 3, mi.UInt32([0, 1, 10**9]), mi.Bool([True, True, False]))
    np.testing.assert_array_equal(sums.gather(mi.UInt32([1, 0, 1])), [[2, 1, 2]] * 3)


def test_new_bins_are_empty_and_channels_apart():
    sums = ColorSums(3, [1.0, 2.0, 0.0])
    assert sums.totals() == [0, 0, 0]
    sums.add(mi.Color3f(0.25, 1.5, 0.0), mi.UInt32([2]))
    np.testing.assert_array_equal(sums.gather(dr.arange(mi.UInt32, 3)), [[0, 0, 0.25], [0, 0, 1.5], [0, 0, 0]])


def test_totals():
    random = np.random.default_rng(3)
    arrays = [random.integers(0, 2**20, n).astype(float) for n in (1, 2, 1000)]
    assert totals([mi.Float64(a) for a in arrays]) == [a.sum() for a in arrays]
    assert totals([mi.Float64(), mi.Int64([2**60, 1])]) == [0, 2**60 + 1] and totals([]) == []


@EXAMPLES
@given(st.floats(1e-300, 1e300))
def test_power_of_two(value):
    """2^k with 2^(k−1) ≤ value < 2^k: division by it changes no digit."""
    power = power_of_two(value)
    assert np.frexp(power)[0] == 0.5 and power / 2 <= value < power
    assert value / power * power == value


@pytest.mark.parametrize("value, power", [(0, 1), (0.5, 1), (1, 2), (np.nextafter(1, 0), 1), (3, 4), (4, 8)])
def test_powers_at_the_ends(value, power):
    assert power_of_two(value) == power


# ---- Arrays from NumPy -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind, dtype", [("Float", np.float32), ("UInt32", np.uint32)])
@pytest.mark.parametrize("n", [0, 1, 5, 1000])
def test_owned_is_a_copy(kind, dtype, n):
    """What happens to NumPy's memory afterwards does not show, whatever was array and however it lies there."""
    for array in (np.arange(n), np.arange(2 * n)[::2] // 2, np.arange(n, dtype=dtype), np.arange(n, dtype=float)):
        expected = array.astype(dtype)
        copy = owned(getattr(mi, kind), array)
        array[:] = 7
        assert type(copy) is getattr(mi, kind) and dr.width(copy) == n
        np.testing.assert_array_equal(np.array(copy), expected)


@pytest.mark.parametrize("name", ["Point3f", "Vector3f", "Color3f"])
def test_owned_vectors(name):
    given = np.random.default_rng(2).normal(size=(50, 3))
    vectors = owned_vectors(getattr(mi, name), given)
    assert type(vectors) is getattr(mi, name)
    np.testing.assert_array_equal(np.array(vectors).T, given.astype(np.float32))
    assert dr.width(owned_vectors(getattr(mi, name), np.zeros((0, 3)))) == 0


# ---- Distribution ----------------------------------------------------------------------------------


@st.composite
def weights(draw):
    """Weights over twelve decades, some of them 0, not all."""
    found = draw(st.lists(st.one_of(st.just(0.0), st.floats(1e-6, 1e6)), min_size=1, max_size=30))
    found[draw(st.integers(0, len(found) - 1))] = draw(st.floats(1e-6, 1e6))
    return np.array(found)


@EXAMPLES
@given(weights())
def test_probabilities_are_those_of_the_weights(values):
    d = Distribution(mi.Float64(values), values.sum())
    found = np.array(d.probability(dr.arange(mi.UInt32, len(values))))
    np.testing.assert_allclose(found, values / values.sum(), rtol=1e-12, atol=2.0**-44)
    assert found.sum() == pytest.approx(1, rel=1e-14) and ((found == 0) == (values == 0)).all()


@EXAMPLES
@given(weights(), st.integers(0, 2**32 - 1))
def test_positions_belong_to_the_number_that_covers_them(values, seed):
    """Each number has [start, start + weight), from its first to its last position, and nothing else."""
    d, k = Distribution(mi.Float64(values), values.sum()), dr.arange(mi.UInt32, len(values))
    weight, start = np.array(d.weight), np.array(d.start(k))
    assert weight.sum() == d.whole and (start == np.cumsum(weight) - weight).all()
    some = np.flatnonzero(weight)
    for position in (start[some], start[some] + weight[some] - 1):
        np.testing.assert_array_equal(np.array(d.at(mi.Float64(position.astype(float)))), some)
    position = np.floor(np.random.default_rng(seed).uniform(0, d.whole, 50))
    expected = np.searchsorted(np.cumsum(weight), position, side="right")
    np.testing.assert_array_equal(np.array(d.at(mi.Float64(position))), expected)


def test_a_distribution_on_any_number_of_threads():
    values, threads = np.random.default_rng(5).exponential(size=1 << 18), dr.thread_count()
    found = []
    try:
        for count in (1, max(threads, 2)):
            dr.set_thread_count(count)
            found.append(np.array(Distribution(mi.Float64(values), values.sum()).cumulative))
    finally:
        dr.set_thread_count(threads)
    np.testing.assert_array_equal(*found)


# ---- components ------------------------------------------------------------------------------------


@EXAMPLES
@given(st.integers(1, 30), st.data())
def test_components_are_those_of_scipy(count, data):
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    links = st.lists(st.tuples(st.integers(0, count - 1), st.integers(0, count - 1)), max_size=40)
    a, b = np.array(data.draw(links), dtype=int).reshape(-1, 2).T
    found = components(count, a, b)
    _, expected = connected_components(coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count)), directed=False)
    np.testing.assert_array_equal(found[:, None] == found, expected[:, None] == expected)


def test_components_of_a_long_chain():
    """The worst order for labels that travel along links."""
    n = 2000
    order = np.random.default_rng(4).permutation(n)
    assert len(set(components(n, order[:-1], order[1:]).tolist())) == 1
    assert len(set(components(n, np.array([], int), np.array([], int)).tolist())) == n


def test_runs():
    run, place = runs(np.array([2, 0, 3]))
    assert run.tolist() == [0, 0, 2, 2, 2] and place.tolist() == [0, 1, 0, 1, 2]
    assert [len(x) for x in runs(np.array([], dtype=int))] == [0, 0]
