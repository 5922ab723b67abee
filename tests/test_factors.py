"""View factors against closed forms, closed rooms, and files that SciPy reads."""

import csv
import tracemalloc

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.core.balance import balance
from mi_radiosity.scene import Model
from mi_radiosity.transport.contour import exchange_area

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, icosphere, lamp, mesh, quad, rectangle, scene
from scipy import io, sparse

pytestmark = pytest.mark.fast

C11 = {(1, 1): 0.19982489569838, (2, 1): 0.28587538485071, (0.5, 4): 0.1985885560012}
C14 = {(1, 1): 0.2000437760754, (2, 1): 0.23285260279536, (0.5, 3): 0.053268159377407}
C41 = {(1, 1): 0.38196601125011, (0.5, 1.5): 0.67544467966324, (2, 0.25): 0.012468514652959}
T = mi.ScalarTransform4f
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)


def parallel(x, y, **others):
    a = SQUARE * [x, y, 1]
    return scene(optimize=False, a=quad(a, name="a"), b=quad(a[::-1] + [0, 0, 1], name="b"), **others)


def hinged(h, w):
    b = [[0, 0, 0], [0, 1, 0], [0, 1, h], [0, 0, h]]
    return scene(optimize=False, a=quad(SQUARE * [w, 1, 1], name="a"), b=quad(b, name="b"))


def disks(r1, r2):
    other = T().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale([r2, r2, 1])
    one = {"type": "disk", "to_world": T().scale([r1, r1, 1]), "bsdf": diffuse()}
    return scene(optimize=False, a=one, b={"type": "disk", "to_world": other, "bsdf": diffuse()})


def room(**others):
    """A closed room without a lamp, with two boxes, one on its floor, one turned."""
    turned = T().translate([-0.4, 0.1, -0.3]).rotate([0, 0.6, 0.8], 40).scale(0.35)
    return scene(
        optimize=False,
        room={"type": "cube", "flip_normals": True, "bsdf": diffuse()},
        one={"type": "cube", "to_world": T().translate([0.3, -0.7, 0.2]).scale(0.3), "bsdf": diffuse()},
        two={"type": "cube", "to_world": turned, "bsdf": diffuse()},
        **others,
    )


def between(factors, a="a", b="b"):
    """F_ab and its standard error."""
    i, j = factors.names.index(a), factors.names.index(b)
    return factors.F[i, j], factors.error[i, j]


def check_closed(factors):
    """Rows sum to 1, A_i F_ij = A_j F_ji, and nothing is negative."""
    F, areas = factors.F, factors.areas
    np.testing.assert_allclose(F.sum(axis=1)[areas > 0], 1, rtol=1e-12)
    flow = sparse.diags_array(areas) @ factors.between
    assert abs(flow - flow.T).max() <= 1e-14 * areas.max()
    assert (F.data >= 0).all() and np.isfinite(factors.error.data).all()
    assert factors.closure.row_error < 1e-12


# ---- Closed forms ----------------------------------------------------------------------------------


def test_contours_are_exact():
    """Triangles of C-11 and of C-14, which touch, to 1e-8; and what is behind a plane is cut off."""

    def F(a, b):
        p, q = (np.array(c, dtype=float)[[[0, 1, 2], [0, 2, 3]]] for c in (a, b))
        i, j = np.indices((2, 2)).reshape(2, -1)
        return exchange_area(p[i], q[j]).sum() / np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])) * 2**0.5

    for (x, y), exact in C11.items():
        a = SQUARE * [x, y, 1]
        assert F(a, a[::-1] + [0, 0, 1]) == pytest.approx(exact, abs=1e-8)
    for (h, w), exact in C14.items():
        for low in (0, -1):
            up = [[0, 0, low], [0, 1, low], [0, 1, h], [0, 0, h]]
            assert F(SQUARE * [w, 1, 1], up) == pytest.approx(exact, abs=1e-8)


@pytest.mark.parametrize(
    "scene, exact", [(parallel(*k), f) for k, f in C11.items()] + [(hinged(*k), f) for k, f in C14.items()]
)
def test_rectangles(scene, exact):
    """Nothing stands between: contours decide, and closing leaves them alone."""
    found, error = between(mr.view_factors(scene, "shape", 1 << 16))
    assert abs(found - exact) < 4e-5 and error < 1e-4


@pytest.mark.parametrize("r1, r2", C41)
def test_coaxial_disks(r1, r2):
    """32-gons of the area of the disks: within 2e-4 of round ones."""
    found, _ = between(mr.view_factors(disks(r1, r2), "shape", 1 << 20))
    assert found == pytest.approx(C41[r1, r2], rel=3e-4)


@pytest.mark.parametrize("width, exact", [(0.5, 0.14986867177379), (1.0, 0.099912447849194)])
def test_occluded(width, exact):
    """A plate half-way covers a quarter or a half of what the squares see of each other."""
    corners = np.array([[0, 0, 0.5], [width, 0, 0.5], [width, 0.5, 0.5], [0, 0.5, 0.5]])
    plates = parallel(1, 1, plate=quad(corners, bsdf=diffuse(two_sided=True), name="plate"))
    factors = mr.view_factors(plates, "shape", 1 << 18)
    found, error = between(factors)
    assert abs(found - exact) < 4 * error and error < 5e-4
    assert {"plate", "plate/back", "sky", "ground"} < set(factors.names)
    check_closed(factors)


def test_inside_a_sphere():
    """F_ij = A_j / 4πR² from anywhere: entries of 1,280 facets to what the errors say, caps to 1e-3."""
    ball = scene(ball=mesh(*icosphere(3), name="ball"))
    factors = mr.view_factors(ball, "face", 512)
    check_closed(factors)
    assert factors.F.shape == (1280, 1280)  # closed to the last ray
    area, F, error = factors.areas, factors.F.tocoo(), factors.error.data
    exact = area / area.sum()
    z = (F.data - exact[F.coords[1]]) / np.maximum(error, 1e-12)
    assert np.abs(F.data - exact[F.coords[1]]).max() < 6 * error.max() and np.mean(z**2) < 2
    height = icosphere(3)[0][icosphere(3)[1]].mean(axis=1)[:, 2]
    cap = np.flatnonzero(height > 0.5)  # rows are faces in their order
    np.testing.assert_allclose(factors.F[:, cap].sum(axis=1).mean(), exact[cap].sum(), rtol=1e-3)


def test_errors_hold_over_seeds():
    """What is said of errors covers the spread over seeds, and no mean is off."""
    found = [mr.view_factors(room(), "face", 400, seed=seed) for seed in range(12)]
    exact = mr.view_factors(room(), "face", 200_000).F.toarray()
    values, said = (np.array([x.toarray() for x in y]) for y in ([f.F for f in found], [f.error for f in found]))
    spread, said = values.std(axis=0, ddof=1), np.sqrt((said**2).mean(axis=0))
    strong = exact > 0.02
    assert spread[strong].mean() < 1.2 * said[strong].mean()
    off = np.abs(values.mean(axis=0) - exact)
    assert off.max() < 0.01 and off[strong].mean() < spread[strong].mean()


# ---- Closing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("level", ["shape", "face"])
def test_closed_rooms(level):
    factors = mr.view_factors(room(), level, 2000)
    check_closed(factors)
    assert factors.closure.raw_row_error > 1e-4 and 0 < factors.closure.mean <= factors.closure.largest < 0.05
    inside = [k for k, name in enumerate(factors.names) if name.startswith("room")]
    outside = factors.F[inside][:, len(factors.areas) :]
    assert outside.sum() == 0  # no ray leaves the room


def test_what_solids_cover_has_no_area():
    """A box of 0.6 × 0.6 m on one side of the room, whose areas are 2 × 2 m each."""
    factors = mr.view_factors(room(), "shape", 100_000)
    assert factors.areas[factors.names.index("room")] == pytest.approx(24 - 0.36, rel=2e-3)


def test_levels_add_up():
    """Shapes are sums of faces, Σ A_i F_ij over those of I and J, within the errors."""
    faces, shapes = (mr.view_factors(room(), level, rays) for level, rays in (("face", 20_000), ("shape", 200_000)))
    of = np.array([shapes.names.index(name.partition("/")[0]) for name in faces.names])
    to = sparse.coo_array((np.ones(len(of)), (of, np.arange(len(of)))))
    rows = to[: len(shapes.areas), : len(faces.areas)]
    area = rows @ faces.areas
    F = (rows @ sparse.diags_array(faces.areas) @ faces.F @ to.T).toarray() / area[:, None]
    np.testing.assert_allclose(F, shapes.F.toarray(), atol=2e-3)


def test_sky_and_ground():
    """A wall sees as much sky as ground, a floor only sky; the up axis is the user's."""
    plates = scene(optimize=False, floor=quad(SQUARE, name="floor"))
    assert mr.view_factors(plates).names == ("floor/0", "floor/1", "sky")
    assert mr.view_factors(plates, up=(0, 0, -1)).names == ("floor/0", "floor/1", "ground")
    wall = mr.view_factors(plates, "shape", up=(0, 1, 0))
    assert wall.F[0, 1] == pytest.approx(0.5, abs=2e-3)
    assert abs(wall.F[0, 1] - 0.5) < 4 * wall.error[0, 1]


@pytest.mark.parametrize("n, outside", [(40, 0.0), (40, 0.2), (2, 0.1)])
def test_balance(n, outside):
    """Converges, two rows that see each other included; zeros stay, and exact entries hardly move."""
    rng = np.random.default_rng(1)
    sums = rng.uniform(0.5, 2, n)
    X = np.outer(sums, sums) / sums.sum() * rng.uniform(0.8, 1.2, (n, n)) * (rng.random((n, n)) < 0.8)
    X = np.array([[0, 1.0], [1.0, 0]]) if n == 2 else (X + X.T) / 2
    O, v = np.full((1, n), outside), np.full((1, n), 1e-2)
    weight = rng.choice([1e-2, 1e-8], (n, n))
    weight = np.maximum(weight, weight.T)
    matrix = sparse.csr_array(X)
    data, out = balance(matrix, weight[X > 0], O, v, sums if n > 2 else np.array([1.2, 1.3]))
    after = X.copy()
    after[X > 0] = data
    np.testing.assert_allclose(after.sum(axis=1) + out[0], sums if n > 2 else [1.2, 1.3], rtol=1e-12)
    np.testing.assert_array_equal(after, after.T)
    assert (data > 0).all() and (out >= 0).all()
    change = np.abs(after - X)
    assert n == 2 or change[weight == 1e-8].max() < 1e-3 * change.max()


def test_what_cannot_be_closed_is_said():
    """Two rows of different sums that see nothing but each other: the best is returned."""
    X = sparse.csr_array(np.array([[0, 1.0], [1.0, 0]]))
    data, _ = balance(X, np.ones(2), np.zeros((0, 2)), np.zeros((0, 2)), np.array([1.0, 1.1]))
    assert np.isfinite(data).all() and data[0] == data[1] and 0.9 < data[0] < 1.2


# ---- Whole ----------------------------------------------------------------------------------------


def test_no_lamp_is_needed():
    with pytest.raises(mr.RadiosityError, match="no light"):
        Model(room())
    assert Model(room(), lit=False).patches.count == 36
    assert mr.view_factors(room(), rays=10).F.shape[0] == 36


def test_threads_and_batches_do_not_matter(monkeypatch):
    whole = mr.view_factors(room(), rays=3000, seed=3)
    before = dr.thread_count()
    dr.set_thread_count(1)
    monkeypatch.setattr("mi_radiosity.transport.facets.AT_ONCE", 7001)
    parts = mr.view_factors(room(), rays=3000, seed=3)
    dr.set_thread_count(before)
    np.testing.assert_array_equal(whole.F.indices, parts.F.indices)
    np.testing.assert_allclose(whole.F.data, parts.F.data, rtol=1e-12)
    other = mr.view_factors(room(), rays=3000, seed=4)
    assert abs(whole.F - other.F).max() > 1e-6


def test_of_a_solution():
    """Leaves of a solved room: the matrix gives the radiosity that the solve found."""
    plates = scene(
        optimize=False,
        room={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.6)},
        lamp=rectangle(T().translate([0, 0, 0.9]).rotate([1, 0, 0], 180).scale(0.4), bsdf=diffuse(0.3), emitter=lamp()),
    )
    solution = mr.solve(plates, elements=600, rays=2_000_000)
    factors = solution.view_factors("leaf", rays=2000)
    check_closed(factors)
    leaves = solution.leaves()
    assert len(factors.areas) == len(leaves)
    patch = np.array(solution.elements.patch)[np.array(solution.elements.leaves)]
    E = np.array(solution.model.patches.emission)[0][patch]
    # Rows go by the names of shapes, leaves by place: sums over all do not mind.
    kind = np.array([name.startswith("lamp") for name in factors.names[: len(leaves)]])
    B = factors.radiosity(np.where(kind, 1.0, 0.0), np.where(kind, 0.3, 0.6))
    expected = leaves.radiosity[:, 0]
    assert np.sum(E > 0) == kind.sum()
    for mine, theirs in ((kind, E > 0), (~kind, E == 0)):
        assert np.average(B[mine], weights=factors.areas[mine]) == pytest.approx(
            np.average(expected[theirs], weights=leaves.open_area[theirs]), rel=5e-3
        )
    assert solution.view_factors("shape", rays=1000).names[:2] == ("lamp", "room")


def test_many_right_hand_sides():
    """A white furnace, and each case as if it were alone."""
    factors = mr.view_factors(room(), rays=500)
    n = len(factors.areas)
    np.testing.assert_allclose(factors.radiosity(np.ones(n), np.full(n, 0.5), outside=2.0), 2, rtol=1e-8)
    cases = np.random.default_rng(0).random((n, 5))
    together = factors.radiosity(cases, np.linspace(0, 0.8, n))
    for k in range(5):
        np.testing.assert_allclose(together[:, k], factors.radiosity(cases[:, k], np.linspace(0, 0.8, n)), rtol=1e-7)
    with pytest.raises(mr.RadiosityError, match="emissions"):
        factors.radiosity(np.ones(3), np.ones(n) / 2)


def test_thousands_of_facets_stay_sparse():
    """5,120 facets: memory goes with the entries there are."""
    ball = Model(scene(ball=mesh(*icosphere(4), name="ball")), lit=False)
    tracemalloc.start()
    factors = mr.view_factors(ball, "face", 64)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    check_closed(factors)
    assert factors.F.nnz < 2 * 64 * 5120 and peak < 200 * factors.F.nnz


# ---- Files and the command ------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["npz", "csv", "mtx"])
def test_files(suffix, tmp_path, capsys):
    file = tmp_path / f"F.{suffix}"
    arguments = ["view-factors", "scenes_xml/cornell_box.xml", "-o", str(file), "--level", "shape", "--rays", "3000"]
    assert main([*arguments, "--up", "y"]) == 0
    assert "view factors" in capsys.readouterr().out
    if suffix == "npz":
        F, again = sparse.load_npz(file), mr.read_factors(file)
        assert abs(F - again.F).max() == 0 and "light" in again.names and again.closure.row_error < 1e-12
        check_closed(again)
        return
    with open(tmp_path / "F_facets.csv", newline="") as table:
        facets = list(csv.DictReader(table))
    if suffix == "mtx":
        F = io.mmread(file).tocsr()
    else:
        i, j, values, error = np.loadtxt(file, delimiter=",", skiprows=1).T
        F = sparse.coo_array((values, (i.astype(int), j.astype(int)))).tocsr()
        assert (error > 0).any()
    np.testing.assert_allclose(F.sum(axis=1), 1, rtol=1e-6)
    assert [f["name"] for f in facets][-1] in ("ground", "backs") and len(facets) == F.shape[1]
    assert sum(bool(f["area"]) for f in facets) == F.shape[0]


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["-o", "x.txt"], ".npz, .csv or .mtx"),
        (["-o", "nowhere/x.npz"], "does not exist"),
        (["-o", "x.npz", "--level", "room"], "choose one of shape, face"),
        (["-o", "x.npz", "--level", "leaf"], "level='face'"),
        (["-o", "x.npz", "--rays", "0"], "greater than 0"),
        (["-o", "x.npz", "--rays", "99999999999"], "too many"),
        (["-o", "x.npz", "--up", "w"], "x, y, z"),
    ],
)
def test_errors_are_one_line(arguments, says, tmp_path, capsys):
    arguments = [str(tmp_path / a) if a.startswith(("x.", "nowhere/")) else a for a in arguments]
    assert main(["view-factors", "scenes_xml/cornell_box.xml", *arguments]) == 2
    message = capsys.readouterr().err
    assert says in message and message.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_interrupt_leaves_no_file(tmp_path, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("mi_radiosity.transport.facets._ends", stop)
    assert main(["view-factors", "scenes_xml/cornell_box.xml", "-o", str(tmp_path / "F.npz")]) == 130
    assert list(tmp_path.iterdir()) == []


def test_files_that_hold_no_factors(tmp_path):
    (tmp_path / "x.npz").write_text("no")
    for name, says in (("x.npz", "holds no view factors"), ("y.npz", "does not exist")):
        with pytest.raises(mr.RadiosityError, match=says):
            mr.read_factors(tmp_path / name)


def test_without_scipy(monkeypatch):
    """One line says what to install."""
    monkeypatch.setitem(__import__("sys").modules, "scipy.sparse", None)
    with pytest.raises(mr.RadiosityError, match=r"mi_radiosity\[factors\]"):
        mr.view_factors(room(), rays=10)
