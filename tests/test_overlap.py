"""The search for coplanar faces that lie in one another, against exact integer arithmetic on all pairs."""

from fractions import Fraction

from mi_radiosity.scene.lookup import EDGE, Lookup
from mi_radiosity.scene.overlap import coplanar_pairs, surfaces

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.fast

GRID = 2**24  # corners are multiples of 1/GRID: all arithmetic of the judge is exact


def found_pairs(corners, tolerance):
    """Pairs (f, g), f < g, of the faces [n, 3, 3] that the code says lie in one another."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    pairs = coplanar_pairs(corners, normal / length[:, None], length / 2, np.ones(len(corners), dtype=bool), tolerance)
    return {(int(f), int(g)) for f, g in zip(*pairs) if f < g}


def cross(o, a, b):
    return (a[0] - o[0]) * (b[1] - o[1]) - (a[1] - o[1]) * (b[0] - o[0])


def half_hull(points):
    hull = []
    for point in points:
        while len(hull) > 1 and cross(hull[-2], hull[-1], point) <= 0:
            hull.pop()
        hull.append(point)
    return hull[:-1]


def depth(p, q):
    """How far the triangle q (three pairs of integers) must at least be moved for its interior to leave that of p.

    The distance of 0 from the border of the convex hull of all differences a − b of their points (squared, exact); 0
    for triangles that touch at most.
    """
    differences = sorted({(a[0] - b[0], a[1] - b[1]) for a in p for b in q})
    hull, least = half_hull(differences) + half_hull(differences[::-1]), None
    for a, b in zip(hull, hull[1:] + hull[:1]):
        inside = cross(a, b, (0, 0))
        if inside <= 0:
            return Fraction(0)
        away = Fraction(inside**2, (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2)
        least = away if least is None else min(least, away)
    return least


LARGE = [(0, 0), (8, 0), (0, 8)]
NAMED = {  # a triangle beside LARGE, and how far it must move
    "itself": (LARGE, Fraction(32)),
    "turned round": ([(0, 8), (8, 0), (0, 0)], Fraction(32)),
    "within": ([(1, 1), (3, 1), (1, 3)], Fraction(8)),
    "across a side": ([(2, -1), (4, -1), (3, 1)], Fraction(1)),
    "a star": ([(-1, 3), (6, 1), (6, 5)], None),
    "a common side": ([(0, 0), (0, 8), (-8, 0)], Fraction(0)),
    "part of a common side": ([(0, 2), (0, 6), (-3, 3)], Fraction(0)),
    "a common corner": ([(8, 0), (9, 0), (9, 1)], Fraction(0)),
    "a corner on a side": ([(4, 0), (5, -2), (3, -2)], Fraction(0)),
    "far away": ([(20, 20), (21, 20), (20, 21)], Fraction(0)),
    "boxes alone meet": ([(5, 5), (8, 5), (8, 8)], Fraction(0)),
}


@pytest.mark.parametrize("other, move", NAMED.values(), ids=NAMED)
def test_named_cases(other, move):
    """The judge says what can be worked out by hand; the code agrees, in a tilted plane, in either order of faces."""
    judged = depth(LARGE, other)
    assert judged == depth(other, LARGE) and (judged == move if move is not None else judged > 0)
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    flat = np.concatenate([np.array([LARGE, other], float), np.zeros((2, 3, 1))], axis=2)
    for corners in (flat @ turn.T, flat[::-1] @ turn.T):
        assert found_pairs(corners, 1e-5) == ({(0, 1)} if judged else set())


@pytest.mark.parametrize("seed", range(12))
def test_finds_every_pair(seed):
    """Triangles of sizes over three decades in three tilted planes, off the origin, as float32 has them.

    Pairs deeper in one another than twice the tolerance are found, and none that is less than half of it.
    """
    random, n = np.random.default_rng(seed), 120
    size, height = 10 ** random.uniform(-3, 0, n), random.choice([-0.5, 0, 0.3], n)
    flat = random.uniform(-1, 1, (n, 1, 2)) + size[:, None, None] * random.normal(size=(n, 3, 2))
    grid = np.round(flat * GRID).astype(np.int64)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    corners = np.concatenate([grid / GRID, np.broadcast_to(height[:, None, None], (n, 3, 1))], axis=2) @ turn.T + seed
    corners = corners.astype(np.float32).astype(float)
    tolerance = 2.0**-18 * np.abs(corners).max()
    found, triangles = found_pairs(corners, tolerance), grid.tolist()
    low, high = grid.min(axis=1), grid.max(axis=1)
    deep, some = set(), set()
    for f in range(n):
        near = (height == height[f]) & (low < high[f]).all(axis=1) & (low[f] < high).all(axis=1)
        for g in np.flatnonzero(near[f + 1 :]) + f + 1:
            move = depth(triangles[f], triangles[g])
            if move > (2 * tolerance * GRID) ** 2:
                deep.add((f, g))
            if move > (tolerance * GRID / 2) ** 2:
                some.add((f, g))
    assert len(deep) > 20 and deep <= found <= some


def test_finds_what_lies_on_few_large_faces():
    """Whose grid is finer than they are large: of thousands of small faces each finds the one that it is on, if it is
    in its plane."""
    random, count = np.random.default_rng(3), 3000
    half = np.array([[[0, 0], [1, 0], [0, 1]], [[1, 1], [0, 1], [1, 0]]], dtype=float)
    on, level = random.integers(0, 2, count), random.integers(0, 2, count)
    weight = random.dirichlet([1, 1, 1], count) * 0.9 + 1 / 30  # off the sides
    middle = np.einsum("nk,nkx->nx", weight, half[on])
    flat = np.concatenate([half, middle[:, None] + 0.003 * random.normal(size=(count, 3, 2))])
    height = np.concatenate([[0, 0], 0.01 * level])
    corners = np.concatenate([flat, np.broadcast_to(height[:, None, None], (count + 2, 3, 1))], axis=2)
    corners = corners @ np.linalg.qr(random.normal(size=(3, 3)))[0].T
    found = {pair for pair in found_pairs(corners, 1e-6) if pair[0] < 2}
    assert found == {(int(on[k]), k + 2) for k in np.flatnonzero(level == 0)}


def test_owners_of_points_under_many_faces():
    """A point belongs to the uppermost face it lies on, of thousands on two others of any shape and place, whichever
    of them share the cell it is in."""
    random, count, points = np.random.default_rng(5), 1500, 3000
    ground = np.array([[[0, 0, 0], [9, 1, 0], [2, 8, 0]], [[-3, 7, 0], [2, 8, 0], [0, 0, 0]]], dtype=np.float64)
    u, v = random.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    on = random.integers(0, 2, count)
    middle = ground[on, 0] + u[:, None] * (ground[on, 1] - ground[on, 0]) + v[:, None] * (ground[on, 2] - ground[on, 0])
    size = 0.02 * 100 ** random.random((count, 1, 1))
    corners = middle[:, None] + size * np.append(random.normal(size=(count, 3, 2)), np.zeros((count, 3, 1)), axis=2)
    corners = np.concatenate([ground, corners])
    order = np.argsort(on, kind="stable")
    lookup = Lookup(corners, 2 * on[order], 2 * (2 + order))

    a, b = random.random((2, points))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    where = random.integers(0, 2, points)
    face, back, _, _ = lookup.owner(
        mi.UInt32(where), dr.full(mi.Bool, False, points), mi.Float(a), mi.Float(b), dr.full(mi.Bool, True, points)
    )
    p0, e1, e2 = ground[where, 0], *(ground[where, k] - ground[where, 0] for k in (1, 2))
    x = p0 + a[:, None] * e1 + b[:, None] * e2
    q0, q1, q2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    wide = q1[:, 0] * q2[:, 1] - q1[:, 1] * q2[:, 0]
    d = x[:, None] - q0[None, 2:]
    s = (d[..., 0] * q2[2:, 1] - d[..., 1] * q2[2:, 0]) / wide[2:]
    t = (q1[2:, 0] * d[..., 1] - q1[2:, 1] * d[..., 0]) / wide[2:]
    nearest = np.minimum(np.minimum(s, t), 1 - s - t)
    there = on[None] == where[:, None]
    owner = np.where((there & (nearest >= -EDGE)).any(axis=1), 2 + np.argmax(there & (nearest >= -EDGE), axis=1), where)
    clear = (~there | (np.abs(nearest + EDGE) > 1e-4)).all(axis=1)  # rounding may decide at edges
    assert clear.mean() > 0.5 and (owner[clear] > 1).mean() > 0.2
    assert (np.array(face)[clear] == owner[clear]).all() and not np.array(back).any()


@pytest.mark.parametrize("seed", range(6))
def test_surfaces_do_not_depend_on_the_order_of_faces(seed):
    """Two sheets in one plane and a wall meet in one edge, as where the hands of a clock lie on its face."""
    points = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [2, 0, 0], [-2, 0, 0], [0, 0, 1], [0, 0, -1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 4, 1], [0, 1, 5], [0, 6, 1], [0, 1, 7]])
    faces = np.random.default_rng(seed).permutation(faces)
    a, b, c = (points[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a).astype(np.float64)
    label = surfaces(faces, normal / np.linalg.norm(normal, axis=1)[:, None])
    wall = (faces >= 6).any(axis=1)
    assert len(set(label[wall])) == len(set(label[~wall])) == 1 and label[wall][0] != label[~wall][0]
