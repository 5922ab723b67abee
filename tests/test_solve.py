"""solve(): budgets, energy, determinism, closed solutions, oracles of one's own, refusals."""

import mi_radiosity as mr

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, leaf_values, partition, rectangle, scene

ORACLES = [mr.KS(), mr.MI(), mr.GMI(0.5), mr.GMI(1.5), mr.Power(), mr.Uniform()]


@pytest.mark.parametrize("oracle", ORACLES, ids=str)
def test_budgets_are_met_and_energy_is_kept(cornell, oracle):
    solution = mr.solve(cornell, oracle, elements=2000, rays=200_000)
    stats, power = solution.stats, solution.stats["power"]
    assert 0 <= 2000 - stats["elements"] < 3
    assert stats["rays"] == 200_000
    assert power["emitted"] == pytest.approx(power["absorbed"] + power["escaped"] + power["unshot"], rel=1e-3)
    values, _, _ = leaf_values(solution)
    assert np.isfinite(values).all() and (values >= 0).all()
    assert (solution.stats["oracle_rays"] == 0) == (not oracle.uses_lines)


@pytest.mark.parametrize("oracle", ORACLES, ids=str)
def test_white_furnace(oracle):
    """Closed, E and ρ = ½ uniform: B = 2 E, in the mean however coarse the mesh."""
    solution = mr.solve(mi.load_file("scenes_xml/box_furnace.xml"), oracle, elements=500, rays=100_000)
    values, areas, _ = leaf_values(solution)
    assert np.average(values[:, 0], weights=areas) == pytest.approx(2, rel=1e-4)


def test_white_furnace_everywhere():
    """... and everywhere, to 1 % in the mean, once the mesh is fine."""
    solution = mr.solve(mi.load_file("scenes_xml/box_furnace.xml"), elements=8000, rays=20_000_000)
    values, areas, _ = leaf_values(solution)
    assert np.average(np.abs(values[:, 0] / 2 - 1), weights=areas) < 0.01


def test_leaves_partition_their_patches(cornell):
    solution = mr.solve(cornell, elements=3000, rays=50_000)
    np.testing.assert_allclose(partition(solution), np.array(solution.model.patches.area), rtol=1e-5)
    child, area = np.array(solution.elements.child), np.array(solution.elements.area)
    parents = np.flatnonzero(child)
    np.testing.assert_allclose(sum(area[child[parents] + k] for k in range(4)), area[parents], rtol=1e-6)


def test_same_solution_whatever_the_order_of_shapes():
    """Mitsuba's varies from process to process. With coats, whose albedo is found by samples."""
    parts = mi.cornell_box()
    for name in ("small-box", "large-box", "floor"):
        parts[name]["bsdf"] = {"type": "twosided", "bsdf": {"type": "roughplastic", "alpha": 0.2 + len(name) / 50}}
    head = {name: parts.pop(name) for name in ("type", "integrator", "sensor")}
    orders = [list(parts.items()), sorted(parts.items(), reverse=True)]
    one, two = (mr.solve(mi.load_dict(head | dict(order)), elements=60, rays=20_000) for order in orders)
    assert one.model.fingerprint == two.model.fingerprint
    np.testing.assert_array_equal(np.array(one.irradiance()), np.array(two.irradiance()))


def test_same_seed_same_solution(cornell):
    first, second, other = (mr.solve(cornell, elements=2000, rays=100_000, seed=seed) for seed in (7, 7, 8))
    np.testing.assert_allclose(np.array(first.radiosity()), np.array(second.radiosity()), rtol=1e-6)
    assert not np.allclose(leaf_values(first)[0].sum(), leaf_values(other)[0].sum(), rtol=1e-6)


def test_direct_and_indirect_are_apart():
    """A lamp over a floor that reflects: only the floor is lit directly, and only by the lamp."""
    T = mi.ScalarTransform4f
    plates = scene(
        floor=rectangle(bsdf=diffuse(0.5)),
        lamp=rectangle(T().translate([0, 0, 1]).rotate([1, 0, 0], 180), bsdf=diffuse(0.5), emitter=lamp()),
    )
    solution = mr.solve(plates, elements=200, rays=400_000)
    direct, indirect = np.array(solution.direct)[0], np.array(solution.indirect)[0]
    emits = np.array(dr.max(solution.model.patches.emission) > 0)[np.array(solution.elements.patch)]
    assert (direct[emits] == 0).all() and (direct[~emits] > 0).all()
    area = np.array(solution.elements.area)
    roots = np.arange(solution.model.patches.count)
    mean = np.average(direct[roots][~emits[roots]], weights=area[roots][~emits[roots]])
    # Parallel squares of side 2 at distance 1 (C-11 with X = Y = 2).
    assert mean == pytest.approx(0.41525323, rel=5e-3)
    assert indirect[roots].max() < mean


def test_what_lies_inside_solids_is_left_out():
    """A box of 1 × 1 m on a floor of 2 × 2 m leaves 3 m² of it open; power goes there, none is lost inside."""
    T = mi.ScalarTransform4f
    room = scene(
        floor=rectangle(bsdf=diffuse(0.9)),
        box={"type": "cube", "to_world": T().translate([0.1, 0.1, 0.5]).scale(0.5), "bsdf": diffuse(0.5)},
        lamp=rectangle(T().translate([0, 0, 3]).rotate([1, 0, 0], 180), bsdf=diffuse(0.5), emitter=lamp()),
    )
    solution = mr.solve(room, elements=1000, rays=200_000)
    leaves = np.array(solution.elements.child) == 0
    patch, open_area = (np.array(x)[leaves] for x in (solution.elements.patch, solution.exposure.open_area))
    height, up = np.array(solution.model.patches.corners[0])[2], np.array(solution.model.patches.normal)[2]
    floor = (height == 0) & (up > 0)
    assert open_area[floor[patch]].sum() == pytest.approx(3, rel=0.01)
    power = solution.stats["power"]
    assert power["emitted"] == pytest.approx(power["absorbed"] + power["escaped"], rel=1e-3)


def test_an_oracle_of_ones_own(cornell):
    class Variance(mr.Oracle):
        name = "variance"

        def sigma(self, samples, pair):
            mean = samples.mean()
            return pair.area_receiver * pair.area_source * dr.sqrt(samples.mean(lambda f: (f - mean) ** 2))

    stats = mr.solve(cornell, Variance(), elements=1000, rays=50_000).stats
    assert stats["oracle"] == "variance" and abs(stats["elements"] - 1000) <= 3


def test_epsilon_instead_of_elements(cornell):
    coarse, fine = (mr.solve(cornell, mr.Power(), epsilon=e, rays=20_000).stats for e in (1e-1, 1e-2))
    assert coarse["epsilon"] == 1e-1 and fine["epsilon"] == 1e-2
    assert coarse["elements"] < fine["elements"]


def test_kernels_do_not_grow_with_the_work(cornell):
    def compiled(**budget):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            mr.solve(cornell, **budget)
            return {k["hash"] for k in dr.kernel_history((dr.KernelType.JIT,))}

    usual = compiled(elements=2000, rays=100_000) | compiled(elements=3000, rays=100_000, seed=3)
    # Arrays that happen to be of one length share a launch, so a few combinations turn up late.
    assert len(compiled(elements=12_000, rays=500_000, seed=1) - usual) < 0.15 * len(usual)


@pytest.mark.parametrize(
    "options, says",
    [
        (dict(elements=0), "elements"),
        (dict(rays=-5), "rays"),
        (dict(lines=0), "lines"),
        (dict(epsilon=0.0), "epsilon"),
        (dict(elements=100, epsilon=1.0), "not both"),
        (dict(oracle="gmi"), "instance"),
    ],
)
def test_refused_options(cornell, options, says):
    with pytest.raises(mr.RadiosityError, match=says):
        mr.solve(cornell, **options)


@pytest.mark.parametrize("alpha", [0, -1, float("nan"), float("inf"), "much"])
def test_refused_alpha(alpha):
    with pytest.raises(mr.RadiosityError, match="alpha"):
        mr.GMI(alpha)
