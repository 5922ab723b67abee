"""Clusters of faces: what they are, that they keep all light, and that they look like the faces themselves."""

from itertools import pairwise
from types import SimpleNamespace

import mi_radiosity as mr
from mi_radiosity.core.points import kronecker
from mi_radiosity.evaluation import ladder
from mi_radiosity.export import lit_mesh
from mi_radiosity.mesh import Clusters, Pairs, Tree, cluster_labels
from mi_radiosity.scene import Model
from mi_radiosity.solver.cost import plan

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import balance, lamp
from scipy import stats

T = mi.ScalarTransform4f


@pytest.fixture(scope="module")
def room():
    return ladder.room(12_000)


@pytest.fixture(scope="module")
def model(room):
    return Model(room)


@pytest.fixture(scope="module")
def labels(model):
    return cluster_labels(model.faces, model.patches, np.zeros(model.patches.count, dtype=bool), 4_000)


@pytest.fixture(scope="module")
def tree(model, labels):
    """Patches under clusters, some of which are split."""
    tree = Tree(model.patches, model.materials, model.lights, labels)
    first = model.patches.count
    tree.split(mi.UInt32(np.arange(first, first + 200)))
    tree.split(tree.part(mi.UInt32([first, first + 7]), mi.UInt32([0, 1])))
    return tree


@pytest.fixture(scope="module")
def clusters(model, labels):
    """With their mesh."""
    mesh = Tree(model.patches, model.materials, model.lights, labels).freeze()
    return Clusters.of_leaves(mesh), mesh


def test_clusters_are_parts_of_one_side_of_one_shape(model, clusters):
    """Of like normals, too; every leaf is in one of them."""
    found, mesh = clusters
    of, member, start = (np.array(x) for x in (found.of, found.member, found.start))
    assert found.count <= 4_000 < len(of) == model.patches.count
    assert sorted(member) == list(range(len(of))) and (np.diff(start) > 0).all() and start[-1] == len(of)
    assert (of[member] == np.repeat(np.arange(found.count), np.diff(start))).all()
    face = np.array(mesh.patches.face)[np.array(mesh.leaves)]
    back = np.array(mesh.patches.back)[np.array(mesh.leaves)]
    normal = model.faces.normal[face] * np.where(back, -1, 1)[:, None]
    for rows in np.split(member, start[1:-1]):
        assert len(set(model.faces.shape[face[rows]])) == len(set(back[rows])) == 1
        assert (normal[rows] @ normal[rows[0]] > 0.6).all()


def test_clusters_lie_in_larger_ones(labels):
    for larger, smaller in pairwise(labels):
        assert len(np.unique(np.column_stack([larger, smaller]), axis=0)) == len(np.unique(smaller))
        assert len(np.unique(larger)) < len(np.unique(smaller))


def test_elements_above_the_patches(model, tree):
    """Every patch is found below its root, part after part; leaves are counted; areas and ρ are those of all parts."""
    patches, crown = model.patches.count, tree.crown
    patch = dr.arange(mi.UInt32, patches)
    assert (
        tree.leaf_count
        == len(np.unique(np.array(tree.top(patch))))
        == len(np.unique(np.array(tree.freeze().top(patch))))
    )
    element, zero = tree.root_element(tree.root(patch)), dr.zeros(mi.Float, patches)
    area, rho = (np.zeros((len(tree), 3)) for _ in range(2))
    own, color = np.array(model.patches.area)[:, None], np.array(model.patches.reflectance).T
    for _ in range(4):
        above = np.flatnonzero(np.array(crown.holds(element)))
        np.add.at(area, np.array(element)[above], own[above])
        np.add.at(rho, np.array(element)[above], own[above] * color[above])
        number = tree.part_at(element, patch, zero, zero)
        assert (np.array(number) < np.array(tree.parts(element)))[above].all()
        element = dr.select(crown.holds(element), tree.part(element, number), element)
    np.testing.assert_array_equal(np.array(element), np.array(patch))
    clusters = np.arange(patches, patches + len(crown))
    np.testing.assert_allclose(np.array(tree.area)[clusters], area[clusters, 0], rtol=1e-5)
    np.testing.assert_allclose(
        np.array(tree.reflectance).T[clusters], (rho / np.maximum(area, 1e-30))[clusters], rtol=1e-5
    )


def test_points_of_clusters_are_uniform(model, tree):
    """χ² over the patches of the largest cluster."""
    cluster = int(np.array(tree.area)[model.patches.count :].argmax()) + model.patches.count
    n = 100_000
    x0, x1, _, _ = kronecker(dr.arange(mi.UInt32, n), mi.UInt32(1), mi.UInt32(2))
    patch, u, v = tree.points(dr.full(mi.UInt32, cluster, n), x0, x1)
    assert (np.array(u) >= 0).all() and (np.array(v) >= 0).all() and (np.array(u + v) <= 1).all()
    found = np.bincount(np.array(patch), minlength=model.patches.count)
    inside = found > 0
    share = np.array(model.patches.area, dtype=np.float64)[inside]
    assert share.sum() == pytest.approx(np.array(tree.area)[cluster], rel=1e-3)
    assert stats.chisquare(found[inside], n * share / share.sum()).pvalue > 1e-3


def test_pairs_of_clusters_see_what_their_patches_see(model, labels):
    """Σ A_i F(i, lamp) by lines from clusters and from patches, to within 4 standard errors."""
    patches, lines, power = model.patches, 64, []
    lamp = int(np.argmax(np.array(patches.emission)[0]))
    every = np.setdiff1d(np.arange(patches.count), [lamp])
    for above in (labels, None):
        tree = Tree(patches, model.materials, model.lights, above)
        pairs = Pairs(tree, model.rays, mr.GMI(0.5), lines, 0)
        pairs.add_roots(mi.UInt32(every), mi.UInt32(np.full(len(every), lamp)))
        numbers = dr.arange(mi.UInt32, len(pairs) - 1) + 1
        kernel = np.array(pairs.kernel_samples(numbers), dtype=np.float64).reshape(-1, lines)
        area = np.array(tree.area)[np.array(pairs.receiver)[1:]]
        power.append((area @ kernel.mean(axis=1), area**2 @ kernel.var(axis=1) / lines))
    (one, error), (two, other) = power
    assert one > 0 and abs(one - two) < 4 * (error + other) ** 0.5


def test_split_pairs_lead_to_their_parts(model, tree):
    """Whichever of two elements is split, a ray is found in the part that its patch is in."""
    pairs = Pairs(tree, model.rays, mr.GMI(0.5), 10, 0)
    member, start, end = (np.array(x) for x in (tree.crown.member, tree.crown.start, tree.crown.end))
    i, j = (mi.UInt32(member[start[k] : end[k]][:3]) for k in (0, 7))
    pairs.add_roots(i, j)
    u = dr.full(mi.Float, 0.25, 3)
    for _ in range(2):
        pair = pairs.descend(pairs.find_roots(i, j), i, u, u, j, u, u)
        pairs.split(mi.UInt32(np.unique(np.array(pair))), pairs.larger(mi.UInt32(np.unique(np.array(pair)))))
    pair = pairs.descend(pairs.find_roots(i, j), i, u, u, j, u, u)
    for patch, ends in ((i, pairs.receiver), (j, pairs.source)):
        element, above = dr.gather(mi.UInt32, ends, pair), tree.root_element(tree.root(patch))
        path = [np.array(above)]
        for _ in range(3):
            inside = tree.crown.holds(above)
            above = dr.select(inside, tree.part(above, tree.part_at(above, patch, u, u)), above)
            path.append(np.array(above))
        assert (np.array(path) == np.array(element)).any(axis=0).all()


def test_leaves_are_picked_by_area(clusters):
    """χ² over the leaves of the largest cluster; and what is left of the lot is uniform."""
    found, mesh = clusters
    start, member = np.array(found.start), np.array(found.member)
    largest = int(np.diff(start).argmax())
    n = 100_000
    lot = kronecker(dr.arange(mi.UInt32, n), mi.UInt32(1), mi.UInt32(2))[0]
    row, rest = found.pick(dr.full(mi.UInt32, largest, n), lot)
    rows = member[start[largest] : start[largest + 1]]
    area = np.array(dr.gather(mi.Float, mesh.area, mesh.leaves), dtype=np.float64)[rows]
    counts = np.bincount(np.array(row), minlength=len(member))[rows]
    assert counts.sum() == n and len(rows) > 2
    assert stats.chisquare(counts, n * area / area.sum()).pvalue > 1e-3
    assert stats.kstest(np.array(rest), "uniform").pvalue > 1e-3


def test_means_keep_the_sum(clusters):
    found, mesh = clusters
    area = mi.Float64(dr.gather(mi.Float, mesh.area, mesh.leaves))
    values = [mi.Float64(np.random.default_rng(k).random(dr.width(area))) for k in range(3)]
    for before, after in zip(values, found.means(values, area)):
        assert dr.sum(after * area)[0] == pytest.approx(dr.sum(before * area)[0], rel=1e-9)
        assert len(np.unique(np.round(np.array(after), 9))) <= found.count


def test_fewer_elements_than_faces(room, model):
    """Asked for, and there: the power is kept, the picture's means those of `path`."""
    film = {"type": "hdrfilm", "width": 48, "height": 48, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    look = T().look_at([0.5, 0.5, 1.8], [5, 4, 0.8], [0, 0, 1])
    camera = mi.load_dict({"type": "perspective", "fov": 70, "to_world": look, "film": film})
    solution = mr.solve(model, elements=4_000, rays=400_000)
    found = solution.stats
    assert found["elements"] <= 4_000 < model.patches.count <= found["leaves"]
    assert balance(solution) == pytest.approx(1, abs=1e-3)
    assert found["power"]["shown"] == pytest.approx(found["power"]["absorbed"], rel=1e-3)
    path = mi.load_dict({"type": "path", "max_depth": -1})
    true = np.mean([mi.render(room, integrator=path, sensor=camera, spp=128, seed=k) for k in range(4)])
    for shading, bias in (("gather", 0.01), ("gouraud", 0.02)):
        assert np.mean(solution.render(camera, spp=64, shading=shading)) == pytest.approx(true, rel=bias)


def test_clusters_in_a_furnace():
    """Nothing but noise is wrong where all is alike: B = E / (1 − ρ)."""
    vertices, faces = ladder._box(8)
    shape = ladder._mesh([(vertices, faces[:, ::-1])], 0.5, lamp())
    solution = mr.solve(mi.load_dict({"type": "scene", "box": shape}), mr.Uniform(), elements=768, rays=200_000)
    leaves = solution.leaves()
    assert np.average(leaves.radiosity[:, 0], weights=leaves.area) == pytest.approx(2, rel=1e-3)


def test_kept_with_their_clusters(model, tmp_path):
    """A solution that was saved has the same leaves, areas and light, and gathers the same, once it is loaded."""
    solution = mr.solve(model, elements=4_000, rays=50_000)
    solution.save(tmp_path / "kept.npz")
    loaded = mr.Solution.load(tmp_path / "kept.npz", model)
    one, two = solution.elements, loaded.elements
    np.testing.assert_array_equal(np.array(one.leaves), np.array(two.leaves))
    np.testing.assert_allclose(np.array(one.area), np.array(two.area), rtol=1e-6)
    patch = dr.arange(mi.UInt32, model.patches.count)
    np.testing.assert_array_equal(np.array(one.top(patch)), np.array(two.top(patch)))
    np.testing.assert_array_equal(np.array(solution.irradiance()), np.array(loaded.irradiance()))


def test_exported_with_their_clusters(model):
    """The lit mesh has the area of all leaves, and the light of the Gouraud field at its vertices."""
    solution = mr.solve(model, elements=4_000, rays=50_000)
    assert solution.elements.crown is not None
    mesh = lit_mesh(solution)
    lit = mesh.leaf >= 0
    assert mesh.areas()[lit].sum() == pytest.approx(solution.leaves().area.sum(dtype=np.float64), rel=1e-4)
    assert np.isfinite(mesh.radiosity).all() and mesh.irradiance.max() > 0


@pytest.mark.parametrize(
    "patches, elements, wanted, shares",
    [
        (1_118, 19_000, 19_000, False),
        (1_118, 1_000, 1_000, True),
        (1_118, None, 20_118, False),
        (56_963, 57_000, 57_000, True),
        (56_963, 120_000, 120_000, False),
        (56_963, None, 75_963, False),
        (250_000, None, 114_000, True),
        (894_255, 913_255, 913_255, False),
    ],
)
def test_who_shares(patches, elements, wanted, shares):
    """Clusters where there are fewer elements than faces, or too few for the large faces among many small ones."""
    model = SimpleNamespace(patches=SimpleNamespace(count=patches))
    assert plan(model, elements, None) == (wanted, wanted if shares else None)


def test_too_few_elements_give_the_largest_clusters(model):
    """Fewer elements than there can be clusters: the largest clusters, and one warning."""
    solution = mr.solve(model, elements=3, rays=10_000)
    count = solution.stats["elements"]
    assert 3 < count < model.patches.count
    (said,) = (line for line in solution.stats["warnings"] if "instead of 3" in line)
    assert said.startswith(f"the mesh has {count:,} elements") and "like normals" in said
    assert np.all(np.isfinite(np.array(solution.radiosity())))


def test_the_same_seed_gives_the_same_clusters(model):
    one, two = (mr.solve(model, elements=4_000, rays=50_000) for _ in range(2))
    np.testing.assert_array_equal(np.array(one.irradiance()), np.array(two.irradiance()))


def test_the_ladder(capsys):
    """A row per size, the sizes being about those that were asked for."""
    ladder.main(["1000", "4000", "--rays", "100000"])
    head, *rows = capsys.readouterr().out.splitlines()
    faces = [int(row.split()[0].replace(",", "")) for row in rows]
    assert "faces" in head and len(rows) == 2
    assert faces[0] < 4_000 and faces[1] == pytest.approx(4_000, rel=0.5)
    assert all(float(row.split()[-2]) > 0 for row in rows)
