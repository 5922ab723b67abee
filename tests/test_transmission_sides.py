"""Diffuse transmission between the meshes of both sides of a face, which are separate trees."""

import mi_radiosity as mr
from mi_radiosity.export import lit_mesh
from mi_radiosity.mesh import Exposure, Scattering, Tree, cluster_labels
from mi_radiosity.scene import Model
from mi_radiosity.transport import Shooting

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import balance, diffuse, lamp, rectangle, scene
from test_transmission import BUDGET, T, cloth, facing, half_rooms, pane, side_of

pytestmark = pytest.mark.fast


def grown(model, clusters, seed=0):
    """A mesh whose sides are split at random."""
    labels = None
    if clusters:
        crossed = np.zeros(model.patches.count, dtype=bool)
        labels = cluster_labels(model.faces, model.patches, crossed, 8)
    tree, rng = Tree(model.patches, model.materials, model.lights, labels), np.random.default_rng(seed)
    for _ in range(6):
        child = np.array(tree.child)
        able = np.flatnonzero(child == 0)
        chosen = rng.choice(able, len(able) // 2, replace=False)
        tree.split(mi.UInt32(np.sort(chosen).astype(np.uint32)))
    return tree.freeze()


@pytest.mark.parametrize("clusters", [False, True])
def test_averages_of_the_other_side(clusters):
    """What comes through to each leaf is τ times the mean of the other side's leaves over its area, by counting points;
    power is kept; clusters have the mean of their patches."""
    ball = {"type": "sphere", "bsdf": pane(0.2, 0.6)}
    model = Model(scene(ball=ball, light={"type": "constant"}, lamp=rectangle(T().scale(0.2), emitter=lamp(1.0))))
    mesh = grown(model, clusters)
    assert (mesh.crown is not None) == clusters
    scattering = Scattering(mesh, Exposure.unseen(mesh))
    leaves, rng = np.array(mesh.leaves), np.random.default_rng(1)
    H = rng.uniform(0, 1, len(leaves)).astype(np.float32)
    values = [mi.Float64(H), mi.Float64(2 * H), mi.Float64(0 * H)]
    found = np.array(scattering.transmitted_to_leaves(values))
    np.testing.assert_allclose(found[1], 2 * found[0], rtol=1e-5)
    patch, area = np.array(mesh.patch)[leaves], np.array(mesh.area)[leaves].astype(np.float64)
    twin, tau = model.patches.twin, np.array(model.patches.transmittance)[0]
    there = twin[patch] < model.patches.count
    assert 0 < there.sum() < len(leaves) and not found[0][~there].any()
    assert (found[0] * area).sum() == pytest.approx((tau[patch] * H * area)[there].sum(), rel=1e-5)
    # Means over random points of 40 leaves.
    some, n = rng.choice(np.flatnonzero(there), 40, replace=False), 1 << 14
    a, b = rng.uniform(0, 1, (2, n))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    index = mi.UInt32(np.repeat(leaves[some], n).astype(np.uint32))
    u, v = mesh.patch_point(index, mi.Float(np.tile(a, len(some))), mi.Float(np.tile(b, len(some))))
    other = mi.UInt32(np.repeat(twin[patch[some]], n).astype(np.uint32))
    at = np.full(len(mesh), np.nan)
    at[leaves] = H
    means = at[np.array(mesh.leaf_at(other, u, v))].reshape(len(some), n).mean(axis=1)
    np.testing.assert_allclose(found[0][some], tau[twin[patch[some]]] * means, rtol=0.02, atol=0.003)
    # of_leaves and of_elements say the same at the leaves.
    light = np.array([np.array(x) for x in scattering.of_leaves(values)])
    own = np.array(mesh.reflectance)[:, leaves] * np.array([H, 2 * H, 0 * H])
    np.testing.assert_allclose(light, own + found, rtol=1e-5)


def test_clusters_transmit():
    """With fewer elements than faces: as with all of them, and with power kept."""
    room = scene(
        optimize=False,
        ball={"type": "sphere", "bsdf": pane(0.2, 0.6)},
        bulb={"type": "sphere", "radius": 0.2, "emitter": lamp(10.0)},
        floor=rectangle(T().translate([0, 0, -1.5]).scale(4), bsdf=diffuse(0.5)),
    )
    model = Model(room)
    few, many = (
        mr.solve(model, elements=n, rays=200_000, transport=Shooting())
        for n in (model.patches.count // 3, 3 * model.patches.count)
    )
    assert few.elements.crown is not None and many.elements.crown is None
    assert balance(few) == pytest.approx(1, abs=1e-6)
    total = []
    for solution in (few, many):
        leaves = solution.leaves()
        floor = leaves.vertices[:, :, 2].max(axis=1) < -1.4
        total.append((leaves.irradiance[floor, 0] * leaves.area[floor]).sum())
    assert total[0] == pytest.approx(total[1], rel=0.02)
    mesh = lit_mesh(few)
    assert np.isfinite(mesh.radiosity).all()


def test_shadows_on_the_other_side_are_shown():
    """A screen close behind the curtain hides the light from half of it. The front, which receives nothing and so is
    not refined, shows what the refined back receives."""
    room = scene(
        optimize=False,
        light=rectangle(facing([3, 0, 0], [0, 0, 0]), emitter=lamp(10.0)),
        curtain=rectangle(facing([0, 0, 0], [-1, 0, 0]), bsdf=cloth(0.8)),
        screen=rectangle(facing([0.02, 2, 0], [1, 2, 0], 2), bsdf=diffuse(0.0, two_sided=True)),
    )
    solution = mr.solve(room, elements=1500, rays=300_000)
    front, back = side_of(solution, "curtain")
    assert len(front) < 20 and len(back) > 500
    points = np.array([[0, y, z] for y in (-0.8, -0.4, -0.2) for z in (-0.5, 0.3)])
    H = solution.irradiance(points, [[1, 0, 0]])[:, 0]
    assert np.ptp(H) > 0.1
    np.testing.assert_allclose(solution.radiosity(points, [[-1, 0, 0]])[:, 0], 0.8 * H, rtol=0.05)
    # What the leaves of the front send out is the mean of all of the back.
    leaves = solution.leaves()
    sent, received = (
        (light * leaves.area[side]).sum()
        for light, side in ((leaves.radiosity[front, 0], front), (leaves.irradiance[back, 0], back))
    )
    assert sent == pytest.approx(0.8 * received, rel=1e-4)


def test_a_pane_in_a_wall_keeps_its_power():
    """A block stands through the pane: no power is created where sides are covered."""
    room = half_rooms(cloth(0.9), {"bsdf": diffuse(0.8), "emitter": lamp(1.0)}, {"bsdf": diffuse(0.8)})
    shapes = {shape.id(): shape for shape in room.shapes()}
    block = {"type": "cube", "to_world": T().translate([0.1, 0.3, 0.2]).scale(0.4), "bsdf": diffuse(0.9)}
    solution = mr.solve(mi.load_dict({"type": "scene", **shapes, "block": block}, optimize=False), **BUDGET)
    assert solution.exposure.slots > 0
    assert balance(solution) == pytest.approx(1, abs=1e-6)


def test_no_transmission_costs_nothing(cornell):
    """Without a face that transmits there are no twins, and no memory for them."""
    model = Model(cornell)
    assert model.patches.twin is None and model.patches.transmittance is None
    assert model.patches.albedo is model.patches.reflectance
    mesh = Tree(model.patches, model.materials, model.lights).freeze()
    scattering = Scattering(mesh, Exposure.unseen(mesh))
    H = mi.Color3f(dr.full(mi.Float, 0.7, len(mesh)))
    np.testing.assert_array_equal(np.array(scattering.of_elements(H)), np.array(mesh.reflectance * H))
    assert not scattering.transmits
