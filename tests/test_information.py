"""information_gap, the kernel of every GMI oracle, against 60-digit arithmetic."""

import mi_radiosity as mr

import mitsuba as mi
import mpmath
import numpy as np
import pytest

pytestmark = pytest.mark.fast

PAIRS, LINES = 40, 10
ALPHAS = [0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 1, 1.1, 1.25, 1.5, 2, 2.5, 3, 3.7, 5]
NEAR_ONE = [1 + sign * 10.0**-k for k in (2, 3, 4, 5, 6, 7, 8, 10, 12) for sign in (1, -1)]


def exact(F, alpha):
    """δ_α/(1 − α) of each row of F in 60 digits, rounded to float64."""
    with mpmath.workdps(60):
        # δ cancels, and so does 1 − α: work with as many digits more.
        with mpmath.extradps(140):
            a, gaps = mpmath.mpf(float(alpha)), []
            for row in np.asarray(F, dtype=np.float64):
                f = [mpmath.mpf(float(x)) for x in row]
                m = mpmath.fsum(f) / len(f)
                if m == 0:
                    gaps.append(0.0)
                elif a == 1:
                    gaps.append(float(mpmath.fsum(x * mpmath.log(x) for x in f if x > 0) / len(f) - m * mpmath.log(m)))
                else:
                    gaps.append(float((m**a - mpmath.fsum(x**a for x in f if x > 0) / len(f)) / (1 - a)))
            return np.array(gaps)


def spread(width):
    """Samples about one kernel value each, with relative deviations of ``width``."""
    random = np.random.default_rng(1)
    return 10 ** random.uniform(-30, 30, (PAIRS, 1)) * (1 + width * random.uniform(-1, 1, (PAIRS, LINES)))


def mixed():
    """Samples over sixty decades within each pair."""
    return 10 ** np.random.default_rng(2).uniform(-30, 30, (PAIRS, LINES))


def one_scale():
    """Samples of one pair within two decades; pairs over sixty."""
    random = np.random.default_rng(3)
    return 10 ** (random.uniform(-29, 29, (PAIRS, 1)) + random.uniform(-1, 1, (PAIRS, LINES)))


def with_zeros():
    """0 … LINES zeros per pair: what occlusion leaves."""
    F = one_scale()
    F[np.arange(LINES) < (np.arange(PAIRS) % (LINES + 1))[:, None]] = 0
    return F


CASES = {
    "spread 1": spread(0.999),
    "spread 0.1": spread(0.1),
    "spread 1/32": spread(1 / 32),
    "spread 0.01": spread(0.01),
    "spread 1e-4": spread(1e-4),
    "spread 1e-6": spread(1e-6),
    "mixed": mixed(),
    "one scale": one_scale(),
    "zeros": with_zeros(),
    "extremes": np.array(
        [[1e-30, 1e30], [1e30, 1e30 * (1 + 1e-6)], [1e-30, 1e-30 * (1 + 1e-6)], [0, 1e-30], [0, 1e30]]
    ),
}


@pytest.mark.parametrize("kind", [np.float64, np.float32])
@pytest.mark.parametrize("name", CASES)
def test_agrees_with_sixty_digits(name, kind):
    """To 1e-9 relative for every α, near 1 as well, and every range of samples."""
    F = CASES[name].astype(kind)
    for alpha in ALPHAS + NEAR_ONE:
        reference = exact(F, alpha)
        np.testing.assert_allclose(
            np.array(mr.information_gap(F, alpha)), reference, rtol=1e-9, atol=0, err_msg=f"alpha = {alpha!r}"
        )


@pytest.mark.parametrize("alpha", ALPHAS + NEAR_ONE)
def test_exactly_zero_where_there_is_nothing_to_lose(alpha):
    """Equal samples, zeros alone, a single line."""
    equal = np.repeat(10 ** np.linspace(-30, 30, 301)[:, None], 7, axis=1)
    for F in (equal, equal.astype(np.float32), np.zeros((3, 10)), mixed()[:, :1]):
        assert (np.array(mr.information_gap(F, alpha)) == 0).all()


@pytest.mark.parametrize("alpha", ALPHAS + NEAR_ONE)
def test_never_negative(alpha):
    """Not even where samples differ in their last bit only."""
    ulps = 1.7 * (1 + np.random.default_rng(4).integers(0, 3, (2000, LINES)) * np.finfo(float).eps)
    for F in (ulps, spread(1e-12), mixed(), with_zeros()):
        gap = np.array(mr.information_gap(F, alpha))
        assert (gap >= 0).all() and np.isfinite(gap).all()


@pytest.mark.parametrize("name", ["mixed", "zeros", "spread 1", "spread 1e-4"])
def test_continuous_in_alpha(name):
    """A step of 1e-9 in α moves the result by no more than its slope allows, at α = 1 above all."""
    F = CASES[name]
    logs = np.abs(np.log(F[F > 0])).max()
    for alpha in [0.3, 1 - 2e-9, 1 - 1e-9, 1 - 1e-15, 1, 1 + 1e-15, 1 + 1e-9, 2]:
        here, there = (np.array(mr.information_gap(F, a)) for a in (alpha, alpha + 1e-9))
        assert (
            np.abs(there - here).max() == 0
            or (np.abs(there - here) <= 1e-9 * 10 * logs * np.maximum(here, there)).all()
        )


def test_mutual_information_is_the_limit():
    """GMI(1), MI and mean(F ln F) − m ln m are one."""
    F = np.random.default_rng(5).uniform(0.01, 3, (PAIRS, LINES))
    samples = mr.KernelSamples(mi.Float64(F.ravel()), LINES)
    pair = mr.Pair(mi.Float64(2), mi.Float64(3), 11.0, mi.UInt32(0), mi.UInt32(0))
    gmi, shannon = (np.array(oracle.sigma(samples, pair)) for oracle in (mr.GMI(1), mr.MI()))
    m = F.mean(axis=1)
    direct = 2 * 3 / 11 * ((F * np.log(F)).mean(axis=1) - m * np.log(m))
    np.testing.assert_array_equal(gmi, shannon)
    np.testing.assert_allclose(shannon, direct, rtol=1e-9)


@pytest.mark.parametrize("bad", [np.nan, -1e-30, -1.0, np.inf, -np.inf])
def test_refuses_what_is_no_kernel_value(bad):
    F = np.ones((5, 4))
    F[3, 2] = bad
    for kind in (np.float32, np.float64):
        with pytest.raises(mr.RadiosityError, match="negative or not finite"):
            mr.information_gap(F.astype(kind), 0.5)


@pytest.mark.parametrize("shape", [(4, 0), (2, 2, 2)])
def test_refuses_what_is_no_table_of_lines(shape):
    with pytest.raises(mr.RadiosityError, match="pairs, lines"):
        mr.information_gap(np.ones(shape), 0.5)


def test_no_pairs_no_results():
    assert np.array(mr.information_gap(np.ones((0, 4)), 0.5)).size == 0
