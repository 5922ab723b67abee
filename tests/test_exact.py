"""Whole solutions against exact ones, a full-matrix solution, and Mitsuba's path integrator."""

import mi_radiosity as mr
from mi_radiosity.scene import Model

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import (
    diffuse,
    icosphere,
    lamp,
    leaf_corners,
    leaf_values,
    mesh,
    names_of_walls,
    quad,
    rectangle,
    scene,
    wall_means,
)
from scipy import stats

T = mi.ScalarTransform4f


def errors(solution, exact):
    """Area mean of |B / exact − 1|."""
    values, areas, _ = leaf_values(solution)
    return np.average(np.abs(values[:, 0] / exact - 1), weights=areas)


def furnace(rho, **parts):
    return scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(rho), "emitter": lamp()}, **parts)


@pytest.mark.parametrize("rho", [0.2, 0.5, 0.9, 0.99, 0.999])
def test_white_furnace(rho):
    """Closed, all E = 1: B = 1 / (1 − ρ) in the mean to 1e-4, and everywhere to 5 % in the mean."""
    solution = mr.solve(furnace(rho), elements=2000, rays=4_000_000)
    values, areas, _ = leaf_values(solution)
    assert np.average(values[:, 0], weights=areas) == pytest.approx(1 / (1 - rho), rel=1e-4)
    assert errors(solution, 1 / (1 - rho)) < 0.05


@pytest.mark.parametrize("lit, unlit, cap", [(0.5, 0.5, 0.25), (0.3, 0.8, 0.25), (0.5, 0.5, 0.6), (0.9, 0.9, 0.05)])
def test_sphere_with_a_lit_cap(lit, unlit, cap):
    """H = f E / (1 − Σ f_i ρ_i) everywhere; a sphere of 1,280 triangles is one to 1 %."""
    vertices, faces = icosphere(3)
    area = np.linalg.norm(np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))), axis=1) / 2
    top = np.zeros(len(faces), bool)
    order = np.argsort(-vertices[faces].mean(axis=1)[:, 2], kind="stable")
    top[order[np.cumsum(area[order]) <= cap * area.sum()]] = True
    f = area[top].sum() / area.sum()
    ball = scene(cap=mesh(vertices, faces[top], diffuse(lit), lamp()), rest=mesh(vertices, faces[~top], diffuse(unlit)))
    solution = mr.solve(ball, elements=1280, rays=2_000_000)
    H = f / (1 - f * lit - (1 - f) * unlit)
    values, areas, patches = leaf_values(solution)
    emits = np.array(dr.max(solution.model.patches.emission) > 0)[patches]
    assert np.average(values[emits, 0], weights=areas[emits]) == pytest.approx(1 + lit * H, rel=0.01)
    assert np.average(values[~emits, 0], weights=areas[~emits]) == pytest.approx(unlit * H, rel=0.01)


def squares(exitance=1.0, scale=1.0, move=(0, 0, 0)):
    """Two unit squares one unit apart, ρ = ½, the lower one lit."""
    a = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    place = scale * np.array([0, 0, 1]) + move
    return scene(
        low=quad(scale * a + move, bsdf=diffuse(0.5), emitter=lamp(exitance)),
        high=quad(scale * a[::-1] + place, bsdf=diffuse(0.5)),
    )


def test_two_parallel_plates():
    """1.01021805506 and 0.100947189239 in the 99.9 % interval of twelve seeds, no wider than 1e-4."""
    lit, other = [], []
    for seed in range(12):
        values, areas, _ = leaf_values(mr.solve(squares(), mr.Uniform(), elements=512, rays=1_000_000, seed=seed))
        emits = values[:, 0] > 0.5
        lit.append(np.average(values[emits, 0], weights=areas[emits]))
        other.append(np.average(values[~emits, 0], weights=areas[~emits]))
    for found, exact in ((lit, 1.01021805506), (other, 0.100947189239)):
        half = stats.t.ppf(0.9995, 11) * np.std(found, ddof=1) / 12**0.5
        assert half < 1e-4 and abs(np.mean(found) - exact) < half + 2e-6


@pytest.mark.parametrize("rho", [0.2, 0.5, 0.8])
def test_closed_room_of_one_reflectance(rho):
    """CIE 171:2006, 5.8: mean indirect irradiance Φ ρ / (S (1 − ρ)), whatever the shape of the room."""
    vertices, faces = icosphere(1, inwards=False)
    parts = scene(
        room={"type": "cube", "flip_normals": True, "to_world": T().scale([2, 1.5, 1]), "bsdf": diffuse(rho)},
        lamp=rectangle(
            T().translate([0.3, 0.2, 0.9]).rotate([1, 0, 0], 160).scale(0.1),
            bsdf=diffuse(rho, two_sided=True),
            emitter=lamp(50),
        ),
        ball=mesh(0.5 * vertices + [-0.8, 0.3, -0.4], faces, diffuse(rho)),
    )
    solution = mr.solve(parts, elements=2000, rays=1_000_000)
    values, areas, _ = leaf_values(solution, "indirect")
    assert np.average(values[:, 0], weights=areas) == pytest.approx(
        50 * 0.04 * rho / (areas.sum() * (1 - rho)), rel=2e-3
    )


# ---- The Cornell box, solved by others --------------------------------------------------------

FLOOR, BOXES, WALLS = 24, 8, 6  # cells of the full matrix along each edge of a patch


def lambert(x, normal, triangles):
    """Form factors from points to whole triangles they see: Σ angle · (normal of its plane · n) / 2π (Lambert 1760)."""
    r = triangles - x[:, None]
    r /= np.linalg.norm(r, axis=2)[..., None]
    total = 0
    for a, b in ((0, 1), (1, 2), (2, 0)):
        across = np.cross(r[:, a], r[:, b])
        sine = np.linalg.norm(across, axis=1)
        total += (
            np.arctan2(sine, (r[:, a] * r[:, b]).sum(axis=1)) * (across * normal).sum(axis=1) / np.maximum(sine, 1e-30)
        )
    return np.abs(total) / (2 * np.pi)


@pytest.fixture(scope="session")
def full_matrix(cornell):
    """Mean B of every wall from a dense linear system of all cells: Lambert's formula times visibility along lines."""
    model = Model(cornell)

    def grid(n):
        return [(a, b, 1) for a in range(n) for b in range(n - a)] + [
            (a, b, -1) for a in range(1, n) for b in range(1, n - a + 1)
        ]

    up, large = np.array(model.patches.normal)[1] > 0.99, np.array(model.patches.area) > 1
    patch_steps = np.where(up & large, FLOOR, np.where(large, WALLS, BOXES))
    u, v, sign = (x[:, None] for x in np.concatenate([grid(n) for n in patch_steps]).T)
    cell = np.repeat(np.arange(model.patches.count), patch_steps**2)
    steps = patch_steps[cell][:, None]
    p0, e1, e2, normal, rho, E = (
        np.array(x, dtype=float).T[cell]
        for x in (
            model.patches.p0,
            model.patches.e1,
            model.patches.e2,
            model.patches.normal,
            model.patches.reflectance,
            model.patches.emission,
        )
    )
    area, n = np.array(model.patches.area, dtype=float)[cell] / steps[:, 0] ** 2, len(cell)

    def point(c, a, b):
        return p0[c] + e1[c] * (u[c] + sign[c] * a) / steps[c] + e2[c] * (v[c] + sign[c] * b) / steps[c]

    every = np.arange(n)
    triangles = np.stack([point(every, a, b) for a, b in ((0, 0), (1, 0), (0, 1))], axis=1)
    K, open_spots, spots = np.zeros((n, n)), np.zeros(n), ((1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3))
    for k, (a, b) in enumerate(spots):
        for rows in np.array_split(every, 8):
            i, j = (x.ravel() for x in np.meshgrid(rows, every, indexing="ij"))
            x, y = point(i, a, b), point(j, *spots[(k + 1) % 3])
            d = y - x
            facing = np.flatnonzero(((normal[i] * d).sum(axis=1) > 1e-6) & ((normal[j] * d).sum(axis=1) < -1e-6))
            i, j, x, d = i[facing], j[facing], x[facing], d[facing]
            ray = mi.Ray3f(
                mi.Point3f((x + 1e-5 * normal[i] + model.faces.centre).T.astype(np.float32)),
                mi.Vector3f((d + 1e-5 * (normal[j] - normal[i])).T.astype(np.float32)),
            )
            ray.maxt = 0.9999
            F = ~np.array(cornell.ray_test(ray)) * lambert(x, normal[i], triangles[j])
            K[i, j] += F
            open_spots += np.bincount(i, weights=F, minlength=n) > 0  # the others are under a box
    K /= np.maximum(open_spots, 1)[:, None]
    B = (
        np.column_stack([np.linalg.solve(np.eye(n) - rho[:, [c]] * K, E[:, c]) for c in range(3)])
        * open_spots[:, None]
        / len(spots)
    )
    walls = names_of_walls(model)[cell]
    return {w: np.average(B[walls == w], axis=0, weights=area[walls == w]) for w in np.unique(walls)}


@pytest.fixture(scope="session")
def cornell_walls(cornell):
    """Mean B of every wall by eight seeds of ours (array [seeds, 3] per wall), and the model."""
    model = Model(cornell)
    each = [wall_means(mr.solve(model, elements=16_000, rays=4_000_000, seed=seed)) for seed in range(8)]
    return {wall: np.array([means[wall] for means in each]) for wall in each[0]}, model


def test_full_matrix_solution_of_the_cornell_box(full_matrix, cornell_walls):
    """All walls within 1.5 % of a dense solver that shares nothing with ours.

    The sides of boxes, which its cells on the floor serve badly, within 5 %.
    """
    ours, model = cornell_walls
    walls, normal, area = names_of_walls(model), np.array(model.patches.normal).T, np.array(model.patches.area)
    assert set(ours) == set(full_matrix) == set(range(15))
    for wall in ours:
        here = walls == wall
        side = area[here].sum() < 1 and abs(normal[here][0, 1]) < 0.1
        np.testing.assert_allclose(ours[wall].mean(axis=0), full_matrix[wall], rtol=0.05 if side else 0.015)


def path_means(model, samples=1 << 18):
    """Mean B of every wall by Mitsuba's path integrator, looking at random points nearby, and its standard error."""
    random = np.random.default_rng(0)
    area, walls = np.array(model.patches.area, dtype=float), names_of_walls(model)
    path, sampler, result = (
        mi.load_dict({"type": "path", "max_depth": -1, "rr_depth": 20}),
        mi.load_dict({"type": "independent"}),
        {},
    )
    for wall in np.unique(walls):
        here = np.flatnonzero(walls == wall)
        patch = mi.UInt32(random.choice(here, samples, p=area[here] / area[here].sum()).astype(np.uint32))
        u, v = random.random((2, samples)).astype(np.float32)
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        normal = dr.gather(mi.Vector3f, model.patches.normal, patch)
        ray = mi.Ray3f(
            model.patches.point(patch, mi.Float(u), mi.Float(v)) + model.patches.origin + 1e-4 * normal, -normal
        )
        sampler.seed(int(wall), samples)
        B = np.pi * np.array(path.sample(model.scene, sampler, mi.RayDifferential3f(ray))[0]).reshape(3, -1)
        result[wall] = B.mean(axis=1), B.std(axis=1) / samples**0.5
    return result


def test_path_agrees_on_every_wall(cornell_walls):
    """99.9 % confidence of both, plus 0.2 % that the mesh may take."""
    ours, model = cornell_walls
    for wall, (mean, error) in path_means(model).items():
        found, spread = ours[wall].mean(axis=0), ours[wall].std(axis=0, ddof=1) / len(ours[wall]) ** 0.5
        within = (
            np.hypot(stats.t.ppf(0.9995, len(ours[wall]) - 1) * spread, stats.norm.ppf(0.9995) * error) + 0.002 * mean
        )
        assert (np.abs(found - mean) < within).all(), f"wall {wall}: {found} ± {spread} is not {mean} ± {error}"


def test_noise_falls_with_rays_and_mesh_error_with_elements():
    """Noise of a furnace: slope −½ or steeper in rays.

    Elements of one value against the exact field: error ∝ h, slope −½ in elements.
    """
    rays = 4 ** np.arange(4) * 20_000
    noise = [errors(mr.solve(furnace(0.5), mr.Uniform(), elements=768, rays=int(n)), 2) for n in rays]
    assert np.polyfit(np.log(rays), np.log(noise), 1)[0] < -0.5
    counts, error = 4 ** np.arange(1, 4), []
    for n in counts:
        solution = mr.solve(squares(), mr.Uniform(), elements=int(n), rays=2_000_000)
        values, areas, _ = leaf_values(solution, "direct")
        corners, upper = leaf_corners(solution), values[:, 0] > 0
        points = np.einsum("pk,lkc->lpc", (np.eye(3) + 1) / 4, corners[upper])
        error.append(
            np.sqrt(np.average((values[upper, :1] - above_square(points)) ** 2, axis=0, weights=areas[upper]).mean())
        )
    assert np.polyfit(np.log(counts), np.log(error), 1)[0] < -0.45


def above_square(points):
    """Irradiance under a unit square of E = 1 at distance 1, from its four corners (B-3)."""

    def corner(a, b):
        p, q = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
        return (a / p * np.arctan(b / p) + b / q * np.arctan(a / q)) / (2 * np.pi)

    x, y = points[..., 0], points[..., 1]
    return corner(x, y) + corner(1 - x, y) + corner(x, 1 - y) + corner(1 - x, 1 - y)
