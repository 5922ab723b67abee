"""Solutions: what they offer, that nothing writes on them, and that scenes edited afterwards are noticed."""

import copy

import mi_radiosity as mr
from mi_radiosity.core.errors import RadiosityError
from mi_radiosity.mesh import Pairs, Tree
from mi_radiosity.mesh.elements import ARRAYS
from mi_radiosity.scene import Model

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, mesh, quad, rectangle, scene

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
BUDGET = dict(elements=300, rays=20_000)
FLOOR = rectangle(T().translate([0, 0, -1]).scale(2), bsdf=diffuse(0.5))
ANY_LIGHT = dict(BUDGET, oracle=mr.Uniform())  # refines black surfaces, too


def contents(elements):
    return {name: np.array(getattr(elements, name)).copy() for name in ARRAYS}


# ---- Frozen ----------------------------------------------------------------------------------------


@pytest.fixture
def tree(cornell):
    model = Model(cornell)
    return Tree(model.patches, model.materials, model.lights)


def test_a_frozen_mesh_refuses_writes(tree):
    frozen = tree.freeze()
    for name in (*ARRAYS, "patches", "anything"):
        with pytest.raises(AttributeError, match="freeze it again"):
            setattr(frozen, name, dr.zeros(mi.UInt32, 1))


def test_a_growing_tree_names_no_leaves(tree):
    with pytest.raises(AttributeError, match="freeze it first"):
        _ = tree.leaves


def test_later_splits_leave_a_frozen_mesh_alone(tree):
    tree.split(mi.UInt32([0, 3]))
    frozen = tree.freeze()
    before, leaves = contents(frozen), np.array(frozen.leaves)
    tree.split(mi.UInt32([1, int(tree.child[0])]))
    assert len(tree) == len(frozen) + 8
    for name, value in contents(frozen).items():
        np.testing.assert_array_equal(value, before[name])
    np.testing.assert_array_equal(np.array(tree.freeze().leaves)[: len(leaves)] >= 0, True)
    np.testing.assert_array_equal(np.array(frozen.leaves), leaves)


def test_later_questions_leave_frozen_pairs_alone(cornell):
    """What the oracle finds afterwards is not written into pairs that were handed out."""
    model = Model(cornell)
    pairs = Pairs(Tree(model.patches, model.materials, model.lights), model.rays, mr.GMI(0.5), 10, 0)
    pairs.add_roots(mi.UInt32([0, 2, 4]), mi.UInt32([2, 4, 0]))
    pairs.evaluate(mi.UInt32([0]))
    frozen = pairs.freeze(pairs.elements.freeze())
    before = np.array(frozen.sigma[0])
    pairs.evaluate(mi.UInt32([1, 2]))
    np.testing.assert_array_equal(np.array(frozen.sigma[0]), before)
    assert (np.array(pairs.sigma[0]) != before).any()


def test_a_solution_refuses_writes(cornell):
    solution = mr.solve(cornell, **BUDGET)
    with pytest.raises(AttributeError):
        solution.direct = solution.indirect
    with pytest.raises(AttributeError):
        solution.exposure.open_area = solution.elements.area
    with pytest.raises(AttributeError):
        solution.elements.reflectance = solution.direct


# ---- leaves() --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room():
    """A lit ceiling over a floor of 2 triangles and a wall that is seen from both sides; far from the origin."""
    move = np.array([30.0, -20, 10])
    wall = np.array([[0.2, 0, 0.1], [0.2, 1, 0.1], [0.2, 1, 0.9], [0.2, 0, 0.9]])
    return scene(
        optimize=False,
        ceiling=quad(SQUARE[::-1] + [0, 0, 1] + move, bsdf=diffuse(0.2), emitter=lamp(3)),
        floor=quad(SQUARE + move, bsdf=diffuse(0.4)),
        wall=mesh(wall + move, [[0, 1, 2], [0, 2, 3]], diffuse(0.6, two_sided=True)),
    )


@pytest.fixture(scope="module")
def leaves(room):
    return mr.solve(room, elements=500, rays=50_000).leaves()


def corners(room):
    """Corners of every shape [faces, 3, 3], by Mitsuba's own arrays, and its emission and reflectance."""
    for shape in room.shapes():
        vertices = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
        rho = mi.traverse(shape.bsdf())
        rho = next(np.array(rho[name]).ravel()[0] for name in rho.keys() if name.endswith("reflectance.value"))
        yield vertices[np.array(shape.faces_buffer()).reshape(-1, 3)], 3.0 * shape.is_emitter(), rho


def barycentric(points, triangle):
    """Coordinates [n, 3] of points in the plane of a triangle, and how far off it they are [n]."""
    e1, e2 = triangle[1:] - triangle[0]
    solved = np.linalg.lstsq(np.column_stack([e1, e2, np.cross(e1, e2)]), (points - triangle[0]).T, rcond=None)[0]
    return np.column_stack([1 - solved[0] - solved[1], solved[0], solved[1]]), solved[2]


def test_leaves_lie_in_their_faces_and_fill_them(room, leaves):
    """Shape, face and vertices belong together: all vertices lie in the face, and areas add up to the face's."""
    assert len(leaves) == len(leaves.vertices) and 0 <= 500 - len(leaves) < 3
    own = np.linalg.norm(np.cross(*(leaves.vertices[:, k] - leaves.vertices[:, 0] for k in (1, 2))), axis=1) / 2
    np.testing.assert_allclose(own, leaves.area, rtol=1e-3)
    sides = 0
    for number, (faces, _, _) in enumerate(corners(room)):
        assert set(leaves.face[leaves.shape == number]) <= {0, 1}
        for face, triangle in enumerate(faces):
            for back in (False, True):
                here = (leaves.shape == number) & (leaves.face == face) & (leaves.back == back)
                if not here.any():
                    continue
                where, off = barycentric(leaves.vertices[here].reshape(-1, 3), triangle)
                assert where.min() > -1e-4 and np.abs(off).max() < 1e-4
                whole = np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])) / 2
                assert leaves.area[here].sum() == pytest.approx(whole, rel=1e-5)
                np.testing.assert_allclose(leaves.area[here] * 4.0 ** leaves.level[here], whole, rtol=1e-5)
                sides += 1
    assert sides == 8  # both sides of the wall, one of the others


def test_leaves_have_the_radiosity_of_their_irradiance(room, leaves):
    """B = E + ρ H."""
    parts = list(corners(room))
    E, rho = (np.array([part[k] for part in parts])[leaves.shape, None] for k in (1, 2))
    np.testing.assert_allclose(leaves.radiosity, E + rho * leaves.irradiance, rtol=1e-5)
    assert (leaves.irradiance > 0).mean() > 0.9 and (leaves.open_area <= leaves.area).all()


# ---- irradiance(points, normals) -------------------------------------------------------------------


def b3(a, b, c):
    """Form factor from a point to a rectangle a × b at distance c, one corner of which is above it (Howell's B-3)."""
    A, B = a / c, b / c
    one, two = np.sqrt(1 + A * A), np.sqrt(1 + B * B)
    return (A / one * np.arctan(B / one) + B / two * np.arctan(A / two)) / (2 * np.pi)


@pytest.fixture(scope="module")
def under_a_lamp():
    """A lamp of 1 × 1 m and 10 W/m², 1 m above a black floor, and no other light."""
    return mr.solve(
        scene(
            lamp=quad(SQUARE[::-1] + [0, 0, 1], bsdf=diffuse(0.0), emitter=lamp(10)),
            floor=quad(5 * SQUARE - [2, 2, 0.5], bsdf=diffuse(0.0)),
        ),
        **ANY_LIGHT,
    )


def test_irradiance_is_that_of_b3(under_a_lamp):
    """At a corner, inside, and outside of the shadow of the rectangle: sums and differences of B-3. At 1e-3."""
    points = [[0, 0, 0], [0.3, 0.6, 0], [-0.5, 0.5, 0.2]]
    inside = sum(b3(x, y, 1) for x in (0.3, 0.7) for y in (0.6, 0.4))
    outside = 2 * (b3(1.5, 0.5, 0.8) - b3(0.5, 0.5, 0.8))
    found = under_a_lamp.irradiance(points, [0, 0, 7], samples=1 << 14)
    assert b3(1, 1, 1) == pytest.approx(0.13853160599489)
    np.testing.assert_allclose(found, 10 * np.outer([b3(1, 1, 1), inside, outside], [1, 1, 1]), rtol=1e-3)


def test_lux(under_a_lamp):
    """179 lm/W of white light; nothing from behind."""
    normals = [[0, 0, 1], [0, 0, -1]]
    found = under_a_lamp.irradiance([[0, 0, 0]] * 2, normals, lux=True, samples=1 << 14)
    assert found == pytest.approx([1790 * b3(1, 1, 1), 0], rel=1e-3)


def test_lux_by_channel():
    """Rec. 709: a lamp of one colour has its luminance weight."""
    parts = {"type": "area", "radiance": {"type": "rgb", "value": [0, 1 / np.pi, 0]}}
    green = mr.solve(
        scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.0), "emitter": parts}), **ANY_LIGHT
    )
    assert green.irradiance([0, 0, 0], [1, 2, 3], lux=True) == pytest.approx([179 * 0.7152], rel=0.01)


def test_irradiance_in_a_white_furnace():
    """H = E / (1 − ρ) anywhere inside, whatever the normal, to what such a mesh is good for."""
    furnace = mr.solve(
        scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5), "emitter": lamp()}),
        elements=2000,
        rays=2_000_000,
    )
    random = np.random.default_rng(1)
    found = furnace.irradiance(random.uniform(-0.5, 0.5, (20, 3)), random.normal(size=(20, 3)), samples=1 << 13)
    np.testing.assert_allclose(found, 2, rtol=0.02)


def test_irradiance_agrees_with_the_leaves(room):
    """Gathered at the middles of leaves and shot onto them: the same in the mean, to 1 %."""
    solution = mr.solve(room, elements=2000, rays=1_000_000)
    leaves = solution.leaves()
    here = (leaves.shape == 1) & (leaves.open_area == leaves.area)
    found = solution.irradiance(leaves.vertices[here].mean(axis=1), [0, 0, 1], samples=256)
    shot = leaves.area[here] @ leaves.irradiance[here]
    np.testing.assert_allclose(leaves.area[here] @ found, shot, rtol=0.01)


def test_irradiance_at_no_points(under_a_lamp):
    assert under_a_lamp.irradiance(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    "points, normals, says",
    [
        ([[0, 0, np.nan]], [[0, 0, 1]], "finite"),
        ([[0, 0, 0]], [[0, 0, 0]], "zero"),
        ([[0, 0, 0]], [[0, np.inf, 1]], "finite"),
        ([[0, 0, 0]] * 3, [[0, 0, 1]] * 2, "3 points do not fit 2 normals"),
        ([[0, 0]], [[0, 0, 1]], r"\[n, 3\]"),
        ([[0, 0, 0]], None, r"\[n, 3\]"),
    ],
)
def test_refused_points(under_a_lamp, points, normals, says):
    with pytest.raises(mr.RadiosityError, match=says):
        under_a_lamp.irradiance(points, normals)


# ---- Radiosity at points ---------------------------------------------------------------------------


def test_radiosity_at_points_shows_textured_lamps():
    """E of the point itself, not the mean of the patch: the lamp is dark on the left and bright on the right."""
    halves = mi.Bitmap(np.repeat([[[0.0] * 3, [2.0] * 3]], 2, axis=0).astype(np.float32))
    radiance = {"type": "bitmap", "bitmap": halves, "raw": True, "filter_type": "nearest"}
    room = scene(panel=rectangle(bsdf=diffuse(0.0), emitter={"type": "area", "radiance": radiance}), floor=FLOOR)
    solution = mr.solve(room, rays=20_000)
    found = solution.radiosity([[-0.5, 0.2, 0], [0.5, 0.2, 0]], [0, 0, 1])
    np.testing.assert_allclose(found, [[0] * 3, [2 * np.pi] * 3], rtol=1e-5)


def test_radiosity_at_points_of_coated_shapes():
    """ρ of the diffuse lobe, which is less than the reflectance under the coat: as the leaves have it."""
    coat = {"type": "roughplastic", "diffuse_reflectance": {"type": "checkerboard"}}
    room = scene(
        plate=rectangle(bsdf=coat),
        lamp=rectangle(T().translate([0, 0, 2]).rotate([1, 0, 0], 180), bsdf=diffuse(0), emitter=lamp()),
        floor=FLOOR | {"bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard"}}},
    )
    solution = mr.solve(room, elements=400, rays=50_000)
    leaves = solution.leaves()
    plate = leaves.vertices[..., 2].max(axis=1) == 0
    at = leaves.vertices[plate].mean(axis=1)
    np.testing.assert_allclose(solution.radiosity(at, [0, 0, 1]), leaves.radiosity[plate], rtol=0.15)


# ---- Edited scenes ---------------------------------------------------------------------------------


def editable():
    return scene(
        optimize=False,
        floor=quad(2 * SQUARE - [1, 1, 0], bsdf=diffuse(0.5), name="floor"),
        lamp=rectangle(
            T().translate([0, 1, 2]).rotate([1, 0, 0], 180).scale(0.5), bsdf=diffuse(0.1), emitter=lamp(), id="lamp"
        ),
        disk={"type": "disk", "to_world": T().translate([0, 0, 0.5]).scale(0.3), "bsdf": diffuse(0.3), "id": "disk"},
    )


def change(params, ending, how):
    key = next(name for name in params.keys() if name.endswith(ending))
    params[key] = how(params[key])
    params.update()


EDITS = {
    "reflectance": ("floor.bsdf.reflectance.value", lambda x: 0.25 * x),
    "emission": ("lamp.emitter.radiance.value", lambda x: 3 * x),
    "vertices": ("floor.vertex_positions", lambda x: x * 0.5),
    "a disk": ("disk.to_world", lambda x: x @ T().scale(0.5)),
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_scene_is_solved_anew(edit):
    """mi.render shows what a new scene of the same kind shows; a Solution of the old one is refused."""
    edited, plugin = editable(), mi.load_dict({"type": "radiosity", **BUDGET})
    before = np.array(mi.render(edited, integrator=plugin, spp=4))
    solution = mr.solve(edited, **BUDGET)
    again = np.array(mi.render(edited, integrator=plugin, spp=4))
    np.testing.assert_allclose(again, before, rtol=1e-5, atol=1e-7)
    change(mi.traverse(edited), *EDITS[edit])
    after = np.array(mi.render(edited, integrator=plugin, spp=4))
    fresh = np.array(mi.render(edited, integrator=mi.load_dict({"type": "radiosity", **BUDGET}), spp=4))
    assert np.abs(after - before).mean() > 0.02 * before.mean()
    np.testing.assert_allclose(after, fresh, rtol=1e-5, atol=1e-7)
    with pytest.raises(mr.RadiosityError, match="edited since it was solved"):
        solution.render(spp=1)


def test_values_that_are_written_again_change_nothing(monkeypatch):
    edited, plugin = editable(), mi.load_dict({"type": "radiosity", **BUDGET})
    mi.render(edited, integrator=plugin, spp=1)
    monkeypatch.setattr("mi_radiosity.display.integrator.solve", lambda *a, **k: pytest.fail("solved again"))
    change(mi.traverse(edited), "floor.bsdf.reflectance.value", lambda x: type(x)(x) + 0)
    mi.render(edited, integrator=plugin, spp=1)


def test_cameras_may_move(monkeypatch):
    """Another view, and no new solve; a Solution shows it, too."""
    edited, plugin = editable(), mi.load_dict({"type": "radiosity", **BUDGET})
    solution = mr.solve(edited, **BUDGET)
    before = np.array(mi.render(edited, integrator=plugin, spp=4))
    monkeypatch.setattr("mi_radiosity.display.integrator.solve", lambda *a, **k: pytest.fail("solved again"))
    change(mi.traverse(edited), "camera.to_world", lambda x: type(x)(T().look_at([1, 0, 1], [0, 0, 0], [0, 0, 1])))
    after = np.array(mi.render(edited, integrator=plugin, spp=4))
    assert np.abs(after - before).mean() > 0.1 * before.mean()
    np.testing.assert_allclose(np.array(solution.render(spp=4)), after, rtol=1e-5, atol=1e-7)


def test_shapes_keep_their_names():
    """A scene with a disk is traced as meshes, of which it knows nothing."""
    edited = editable()
    before = sorted(shape.id() for shape in edited.shapes())
    mr.solve(edited, **BUDGET)
    assert sorted(shape.id() for shape in edited.shapes()) == before and "floor" in before


# ---- Gradients -------------------------------------------------------------------------------------


def causes(error):
    while error is not None:
        yield error
        error = error.__cause__


@pytest.mark.parametrize("named", [False, True], ids=["without params", "with params"])
def test_gradients_are_refused_in_one_line(named):
    """mi.render wraps what an integrator raises in a RuntimeError of Dr.Jit; the line is its cause."""
    edited, plugin = editable(), mi.load_dict({"type": "radiosity", **BUDGET})
    params = mi.traverse(edited)
    dr.enable_grad(params["floor.bsdf.reflectance.value"])
    params.update()
    with pytest.raises(RuntimeError) as caught:
        mi.render(edited, params if named else None, integrator=plugin, spp=1)
    said = [str(error) for error in causes(caught.value) if isinstance(error, RadiosityError)]
    assert len(said) == 1 and "\n" not in said[0]
    assert "reflectance.value' asks for gradients, which a radiosity solution does not have yet" in said[0]
    solution = mr.solve(edited, **BUDGET)
    with pytest.raises(mr.RadiosityError, match="asks for gradients"):
        solution.render(spp=1)


# ---- Kept solutions --------------------------------------------------------------------------------


def test_loading_leaves_the_model_alone(tmp_path):
    """A solution of fewer sides gets a model of its own: the one it was given stays as it was."""
    edited = editable()
    model = Model(edited)
    fewer = Model(edited, model.patches.sides[:-1])
    mr.solve(fewer, **BUDGET).save(tmp_path / "fewer.npz")
    assert model.fingerprint  # worked out when it is asked for
    before, patches = copy.copy(vars(model)), model.patches
    loaded = mr.Solution.load(tmp_path / "fewer.npz", model)
    assert loaded.model is not model and loaded.model.patches.count == patches.count - 1
    assert all(vars(model)[name] is value for name, value in before.items()) and vars(model).keys() == before.keys()
    mr.solve(model, **BUDGET).save(tmp_path / "all.npz")
    assert mr.Solution.load(tmp_path / "all.npz", model).model is model


def test_loaded_solutions_offer_the_same(room, tmp_path):
    solution = mr.solve(room, **BUDGET)
    solution.save(tmp_path / "kept.npz")
    loaded = mr.Solution.load(tmp_path / "kept.npz", room)
    for name, value in vars(solution.leaves()).items():
        np.testing.assert_array_equal(getattr(loaded.leaves(), name), value)
    point = np.array([[30.5, -19.5, 10.5]])
    np.testing.assert_allclose(loaded.irradiance(point, [0, 0, 1]), solution.irradiance(point, [0, 0, 1]), rtol=1e-6)
    with pytest.raises(AttributeError, match="freeze"):
        loaded.elements.area = None
