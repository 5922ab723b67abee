"""Light at points: against closed forms and Mitsuba's irradiancemeter; grids, files and the command line."""

from dataclasses import replace

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.display import lux_scale
from mi_radiosity.display.lux import VIRIDIS
from mi_radiosity.export.grids import file_grid, plane_grid, shape_grid
from mi_radiosity.export.measure import measure

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, icosphere, lamp, mesh, rectangle, scene

pytestmark = pytest.mark.fast
T = mi.ScalarTransform4f
OFFICE = "scenes_xml/office.xml"


@pytest.fixture(scope="module")
def box(cornell):
    return mr.solve(cornell, elements=4000, rays=600_000)


# ---- At points -------------------------------------------------------------------------------------


def corner_factor(a, b):
    """B-3: from a surface element to a parallel rectangle a × b whose corner stands one unit above it."""
    p, q = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
    return (a / p * np.arctan(b / p) + b / q * np.arctan(a / q)) / (2 * np.pi)


@pytest.mark.parametrize("height", [1.0, 0.1, 1e-2, 1e-4])
def test_under_a_large_lamp(height):
    """B-3 by quarters, from far to almost touching: within five stated errors, which are below 1 % of H."""
    top = T().translate([0, 0, height]).rotate([1, 0, 0], 180)
    parts = scene(lamp=rectangle(top, bsdf=diffuse(0), emitter=lamp(3)), floor=rectangle(bsdf=diffuse(0)))
    solution = mr.solve(parts, mr.Uniform(), elements=64, rays=4000)
    x, y = 0.3, -0.2
    exact = 3 * sum(corner_factor((1 - s * x) / height, (1 - t * y) / height) for s in (1, -1) for t in (1, -1))
    found, error = solution.irradiance([[x, y, 0]], [0, 0, 1], return_error=True)
    assert np.abs(found - exact).max() < 5 * error.max() + 1e-5 and error.max() < 0.01 * exact


def test_stated_errors_are_not_too_small(box):
    """Over seeds, values differ by what one of them states, or by less."""
    rng = np.random.default_rng(0)
    points, normals = rng.uniform(-0.9, 0.9, (200, 3)), rng.normal(size=(200, 3))
    found = [box.irradiance(points, normals, samples=256, seed=seed, return_error=True) for seed in range(6)]
    values, errors = (np.stack(x) for x in zip(*found))
    spread = np.sqrt(values.var(axis=0, ddof=1).mean())
    assert 0.3 < spread / np.sqrt((errors**2).mean()) < 1.1


def test_furnace_and_sphere():
    """H = E / (1 − ρ) anywhere in a furnace; f E / (1 − ρ) anywhere in a sphere that shines from a part f."""
    furnace = scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5), "emitter": lamp()})
    points, normals = np.random.default_rng(1).uniform(-0.9, 0.9, (2, 50, 3))
    solution = mr.solve(furnace, elements=300, rays=200_000)
    assert solution.irradiance(points, normals).mean() == pytest.approx(2, rel=0.01)
    vertices, faces = icosphere(3)
    lit = vertices[faces].mean(axis=1)[:, 2] > 0.5
    areas = np.linalg.norm(np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))), axis=1)
    ball = scene(cap=mesh(vertices, faces[lit], diffuse(0.5), lamp()), rest=mesh(vertices, faces[~lit], diffuse(0.5)))
    where = points[:5] / np.linalg.norm(points[:5], axis=1, keepdims=True) * 0.98
    found = mr.solve(ball, elements=1280, rays=400_000).irradiance(where, -where)
    assert found == pytest.approx(areas[lit].sum() / areas.sum() / 0.5, rel=0.02)


def test_irradiancemeter(box):
    """Mitsuba's own sensor, path traced, over a small patch of the floor."""
    x, z, size = 0.75, -0.5, 0.02
    to_world = T().translate([x, -0.99, z]).rotate([1, 0, 0], -90).scale(size)
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    description = mi.cornell_box() | {
        "meter": rectangle(to_world, bsdf=diffuse(0), sensor={"type": "irradiancemeter", "film": film})
    }
    parts = mi.load_dict(description)
    meter = next(s for s in parts.sensors() if "Irradiance" in s.class_name())
    path = mi.load_dict({"type": "path", "max_depth": -1, "hide_emitters": False})
    exact = np.array(mi.render(parts, sensor=meter, integrator=path, spp=1 << 17)).ravel()
    across = (np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) * size / 2) + [x, z]
    points = np.insert(across, 1, -0.99, axis=1)
    found, error = box.irradiance(points, [0, 1, 0], samples=4096, return_error=True)
    assert found.mean(axis=0) == pytest.approx(exact, rel=0.02)
    assert (error < 0.01 * found).all()


def test_dark_side_of_a_thin_wall_is_dark():
    """A closed room is split by a wall without thickness: exactly 0 behind it, in all ways to ask."""
    room = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.8)}
    wall = rectangle(T().rotate([0, 1, 0], 90), bsdf=diffuse(0.8, two_sided=True))
    light = rectangle(T().translate([0.5, 0, 0.9]).rotate([1, 0, 0], 180).scale(0.2), bsdf=diffuse(0), emitter=lamp(9))
    solution = mr.solve(scene(optimize=False, room=room, wall=wall, light=light), elements=2000, rays=100_000)
    grid = plane_grid(solution.model, "z=-0.5", 0.125)
    found = measure(solution, grid, samples=64)
    dark = grid.points[:, 0] < 0
    assert (found.values[dark] == 0).all() and (found.values[~dark] > 0).all()
    assert (solution.radiosity([[-0.3, 0.3, -1], [-0.001, 0.3, 0.1]], [[0, 0, 1], [-1, 0, 0]]) == 0).all()
    assert (solution.radiosity([[0.3, 0.3, -1], [0.001, 0.3, 0.1]], [[0, 0, 1], [1, 0, 0]]) > 0).all()


def test_radiosity_at_points(box):
    """B = E + ρ H of the field: on average that of the leaves, in their middles; E on the lamp; NaN in mid-air."""
    leaves = box.leaves()
    found = box.radiosity(leaves.vertices.mean(axis=1))
    assert np.average(found, weights=leaves.area, axis=0) == pytest.approx(
        np.average(leaves.radiosity, weights=leaves.area, axis=0), rel=0.02
    )
    assert np.abs(found - leaves.radiosity).mean() < 0.05 * leaves.radiosity.mean()
    up, down, air = box.radiosity([[0, -1, 0.9], [0, -1, 0.9], [0, 0, 0]], [[0, 1, 0], [0, -1, 0], [0, 1, 0]])
    assert (up > 0).all() and (down == 0).all() and np.isnan(air).all()
    assert box.radiosity(np.zeros((0, 3))).shape == (0, 3)


def test_radiosity_sees_textures():
    stripes = {"type": "checkerboard", "to_uv": T().scale([4, 4, 1])}
    floor = rectangle(bsdf={"type": "diffuse", "reflectance": stripes})
    light = rectangle(T().translate([0, 0, 1]).rotate([1, 0, 0], 180), bsdf=diffuse(0), emitter=lamp())
    solution = mr.solve(scene(floor=floor, light=light), mr.Uniform(), elements=200, rays=100_000)
    H = solution.irradiance([[0.1, 0.1, 0]], [0, 0, 1])[0, 0]
    found = solution.radiosity([[0.1, 0.1, 0], [0.4, 0.1, 0]])[:, 0]
    assert sorted(found / H) == pytest.approx([0.2, 0.4], rel=0.1)


@pytest.mark.parametrize(
    "points, normals, options, says",
    [
        ([[0, 0, np.nan]], [0, 0, 1], {}, "finite"),
        ([[0, 0, 0]], [0, 0, 0], {}, "no normal may be zero"),
        ([[0, 0, 0]] * 3, [[0, 0, 1]] * 2, {}, "do not fit"),
        ([[0, 0]], [0, 0, 1], {}, "shape"),
        ([[0, 0, 0]], [0, 0, 1], {"samples": 0}, "greater than 0"),
    ],
)
def test_points_that_cannot_be_measured(box, points, normals, options, says):
    with pytest.raises(mr.RadiosityError, match=says):
        box.irradiance(points, normals, **options)


# ---- Grids -----------------------------------------------------------------------------------------


def test_grid_over_a_plane(box):
    grid = plane_grid(box.model, "y=-0.5", 0.1)
    assert len(grid.points) == 400 and np.ptp(grid.points, axis=0) == pytest.approx([1.9, 0, 1.9], abs=0.03)
    assert (grid.normals == [0, 1, 0]).all() and (plane_grid(box.model, "-y=-0.5").normals == [0, -1, 0]).all()
    found = measure(box, grid, lux=True, samples=16)
    # The boxes stand on 0.6 × 0.6 of the floor each, and both are higher than this.
    assert found.solid.mean() == pytest.approx(2 * 0.36 / 4, rel=0.1)
    assert set(found.summary()) == {"mean", "min", "max", "min / mean", "error"} and found.summary()["min"] > 0


def test_grid_over_a_shape():
    parts = scene(
        optimize=False,
        block={"type": "cube", "to_world": T().rotate([0, 0, 1], 30).scale([1, 0.5, 0.25]), "bsdf": diffuse(0.5)},
        light=rectangle(T().translate([0, 0, 3]).rotate([1, 0, 0], 180), bsdf=diffuse(0), emitter=lamp()),
    )
    solution = mr.solve(parts, mr.Uniform(), elements=60, rays=2000)
    model = solution.model
    grid = shape_grid(model, "block", 0.125)
    assert len(grid.sheets) == 6 and len(grid.points) == 2 * (16 * 8 + 16 * 4 + 8 * 4)
    inside = replace(grid, points=grid.points - 1e-3 * grid.normals, normals=-grid.normals)
    assert measure(solution, inside, samples=16).solid.all() and not measure(solution, grid, samples=16).solid.any()
    assert len(shape_grid(model, "block", 10).points) == 6
    with pytest.raises(mr.RadiosityError, match="no shape 'table': choose one of .*block"):
        shape_grid(model, "table")


@pytest.mark.parametrize(
    "plane, says", [("z", "no plane"), ("w=1", "no plane"), ("z=x", "no plane"), ("z=9", "outside")]
)
def test_planes_that_are_none(box, plane, says):
    with pytest.raises(mr.RadiosityError, match=says):
        plane_grid(box.model, plane)


@pytest.mark.parametrize("spacing, says", [(0, "greater than 0"), (np.nan, "greater than 0"), (1e-4, "make it larger")])
def test_spacings_that_are_impossible(box, spacing, says):
    with pytest.raises(mr.RadiosityError, match=says):
        plane_grid(box.model, "z=0", spacing)


# ---- False colours ---------------------------------------------------------------------------------


def test_lux_shading():
    """Where H = 2 W/m², every pixel has the colour of 358 lx on the scale."""
    solution = mr.solve(mi.load_file("scenes_xml/box_furnace.xml"), elements=300, rays=10_000)
    one = dr.full(mi.Color3f, 1, len(solution.elements))
    solution = replace(solution, direct=one, indirect=one)
    assert lux_scale(solution) == 400  # 358 lx, rounded up
    picture = np.array(solution.render(spp=4, shading="lux"))
    at = 2 * 179 / 400 * (len(VIRIDIS) - 1)
    table = np.array(VIRIDIS) / 1000
    color = [np.interp(at, np.arange(len(table)), c) for c in table.T]
    srgb = np.where(picture <= 0.0031308, 12.92 * picture, 1.055 * picture.clip(1e-9) ** (1 / 2.4) - 0.055)
    assert srgb.reshape(-1, 3) == pytest.approx(np.tile(color, (64 * 64, 1)), abs=0.002)


# ---- The command line ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    path = tmp_path_factory.mktemp("measure") / "office.npz"
    arguments = ["render", OFFICE, "-o", str(path.with_suffix(".png")), "--save", str(path), "--spp", "1"]
    assert main([*arguments, "--elements", "2500", "--rays", "200000", "--shading", "lux"]) == 0
    return path


def run(kept, *arguments):
    return main(["measure", str(kept), "--scene", OFFICE, "--samples", "64", *arguments])


def test_measure_writes_numbers_meshes_and_pictures(kept, tmp_path, capsys):
    out = tmp_path / "lux.csv"
    assert run(kept, "--plane", "y=0.8", "--spacing", "0.5", "--lux", "-o", str(out)) == 0
    printed = capsys.readouterr().out
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert len(table) == 96 and table.dtype.names[-2:] == ("E_lx", "error_E")
    assert f"{np.nanmean(table['E_lx']):.4g}" in printed and "min / mean" in printed and "96 points" in printed
    again = tmp_path / "again.csv"
    assert run(kept, "--points", str(out), "--lux", "-o", str(again)) == 0
    assert np.genfromtxt(again, delimiter=",", names=True)["E_lx"] == pytest.approx(table["E_lx"], rel=1e-4)
    for name in ("lux.png", "lux.vtu"):
        assert run(kept, "--shape", "desk-top", "--spacing", "0.2", "-o", str(tmp_path / name)) == 0
    assert np.array(mi.Bitmap(str(tmp_path / "lux.png"))).std() > 10


def test_meshio_opens_what_is_written(kept, tmp_path):
    meshio = pytest.importorskip("meshio")
    out = tmp_path / "desk.vtu"
    assert run(kept, "--plane", "y=0.8", "--spacing", "0.5", "--lux", "-o", str(out)) == 0
    found = meshio.read(out)
    assert len(found.cells_dict["quad"]) == 96 and len(found.points) == 9 * 13
    assert np.nanmin(found.cell_data["E [lx]"][0]) >= 0


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["--plane", "y=9"], "outside of the scene"),
        (["--plane", "y=1", "-o", "x.jpg"], ".csv, .vtu or .png"),
        (["--plane", "y=1", "-o", "nowhere/x.csv"], "nowhere does not exist"),
        (["--plane", "y=1", "--spacing", "-1"], "greater than 0"),
        (["--plane", "y=1", "--samples", "0"], "greater than 0"),
        (["--shape", "sofa"], "no shape 'sofa'"),
        (["--points", "none.csv"], "cannot read none.csv"),
        (["--points", "pyproject.toml"], "no column x"),
        (["--points", "x.csv", "-o", "x.png"], "needs --plane or --shape"),
        (["--points", "x.csv", "--spacing", "1"], "--spacing belongs to"),
        ([], "required"),
    ],
)
def test_one_line_errors(kept, arguments, says, capsys):
    assert run(kept, *arguments) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1


def test_files_of_points(tmp_path):
    file = tmp_path / "points.csv"
    file.write_text("x, y, z, nx, ny, nz, note\n1, 2, 3, 0, 0, 2, here\n")
    grid = file_grid(file)
    assert grid.points.tolist() == [[1, 2, 3]] and grid.normals.tolist() == [[0, 0, 2]] and not grid.sheets
    for text, says in (("1,2,3,0,0", "line 2"), ("1,2,3,0,0,up", "line 2"), ("", "no points")):
        file.write_text(f"x,y,z,nx,ny,nz\n{text}\n")
        with pytest.raises(mr.RadiosityError, match=says):
            file_grid(file)
