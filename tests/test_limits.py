"""Scenes and budgets at their limits give solutions that say so, not errors."""

import json
import sys

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.evaluation.compare import compare_oracles
from mi_radiosity.solver import refine

import mitsuba as mi
import numpy as np
import pytest
from conftest import ORACLES, diffuse, lamp, mesh, rectangle, scene

AT = mi.ScalarTransform4f
BLACK_ROOM = """<scene version="3.0.0">
<integrator type="path"/>
<sensor type="perspective"><film type="hdrfilm">
<integer name="width" value="8"/><integer name="height" value="8"/><rfilter type="box"/></film></sensor>
<shape type="cube"><boolean name="flip_normals" value="true"/>
<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>
<shape type="rectangle"><transform name="to_world"><scale value="0.2"/><translate z="0.5"/></transform>
<emitter type="area"><rgb name="radiance" value="1"/></emitter>
<bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></shape>
</scene>"""


def black_room(exitance=1.0):
    at = AT().translate([0, 0, 0.5]).scale(0.2)
    room = {"type": "cube", "flip_normals": True, "bsdf": diffuse(0)}
    return scene(room=room, lamp=rectangle(at, bsdf=diffuse(0), emitter=lamp(exitance)))


def warning_of(solution):
    """The one warning that says how many elements there are."""
    (said,) = (line for line in solution.stats["warnings"] if "elements instead of" in line)
    return said


def test_a_black_room_has_a_solution():
    """GMI finds nothing to refine in a room that reflects nothing. The elements keep their irradiance: of an emitter of
    area a all light falls on the walls, so Σ A H = a E."""
    solution = mr.solve(black_room(), elements=5_000, rays=100_000)
    count = solution.stats["elements"]
    assert warning_of(solution) == (
        f"the mesh has {count} elements instead of 5,000: the oracle 'gmi:0.5' finds nothing left to refine"
    )
    assert solution.stats["elements_wanted"] == 5_000
    leaves = solution.leaves()
    assert (leaves.irradiance * leaves.area[:, None]).sum(axis=0) == pytest.approx(np.full(3, 0.16), rel=1e-3)


@pytest.mark.parametrize("oracle", ORACLES, ids=str)
def test_patches_that_see_nothing(oracle):
    """Two patches of one plane exchange no light, whatever the oracle."""
    flat = scene(lamp=rectangle(bsdf=diffuse(), emitter=lamp()))
    solution = mr.solve(flat, oracle, elements=100, rays=1000)
    assert f"the oracle '{oracle}' finds nothing left" in warning_of(solution)
    assert np.all(np.array(solution.radiosity()) == 1) and np.all(np.array(solution.irradiance()) == 0)


def test_elements_by_default_are_no_promise():
    assert not any("elements" in line for line in mr.solve(black_room(), rays=100_000).stats["warnings"])


def textured_black():
    data = mi.TensorXf(np.zeros((4, 4, 3), dtype=np.float32))
    emitter = {"type": "area", "radiance": {"type": "bitmap", "raw": True, "data": data}}
    return scene(floor=rectangle(bsdf=diffuse()), lamp=rectangle(AT().translate([0, 0, -1]), emitter=emitter))


def floor_with(**emitter):
    return scene(floor=rectangle(bsdf=diffuse()), emitter=emitter)


ZERO = {"type": "rgb", "value": 0.0}
UNLIT = {
    "area emitter without power": lambda: black_room(0),
    "textured emitter without power": textured_black,
    "point emitter without power": lambda: floor_with(type="point", intensity=ZERO, position=[0, 0, 2]),
    "sky without power": lambda: floor_with(type="constant", radiance=ZERO),
    "point emitter behind a floor": lambda: floor_with(type="point", position=[0, 0, -2]),
    "sun from below": lambda: floor_with(type="directional", direction=[0, 0, 1]),
}


@pytest.mark.parametrize("name", UNLIT)
def test_unlit_scenes_are_black(name):
    """Black values and pictures, and a warning; solved again from a file they are the same."""
    solution = mr.solve(UNLIT[name](), rays=5_000)
    (said,) = solution.model.warnings
    assert ("no emitter has any power" if "without power" in name else "no light reaches any surface") in said
    assert np.all(np.array(solution.radiosity()) == 0)
    for shading in ("gather", "gouraud"):
        assert np.all(np.array(solution.render(spp=4, shading=shading)) == 0)


def test_layers_of_emitters_without_power_are_refused():
    with pytest.raises(mr.RadiosityError, match="none has any power"):
        mr.solve(black_room(0), layers=True, rays=5_000)


def test_scenes_without_emitters_are_still_refused():
    with pytest.raises(mr.RadiosityError, match="no light: add"):
        mr.solve(scene(floor=rectangle(bsdf=diffuse())))


def corner():
    """Two rectangles with a common edge, one of which emits."""
    wall = mesh([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], [[0, 2, 1], [0, 3, 2]], emitter=lamp())
    return scene(wall=wall, floor=mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]))


def test_an_epsilon_that_needs_too_many_elements(monkeypatch):
    """Refinement ends at the largest number of elements, and says that ε was not reached."""
    monkeypatch.setattr(refine, "MAX_ADDED", 300)
    solution = mr.solve(corner(), epsilon=1e-30, rays=20_000)
    assert 4 + 300 - 3 < solution.stats["elements"] <= 4 + 300
    assert any("epsilon 1e-30 was not reached" in line and "300" in line for line in solution.stats["warnings"])
    coarse = mr.solve(corner(), epsilon=10.0, rays=20_000)
    assert not any("epsilon" in line for line in coarse.stats["warnings"])


def test_elements_split_so_often_and_not_more(monkeypatch):
    """At the largest depth of the tree refinement ends, and says so."""
    for module in ("mi_radiosity.mesh.pairs", "mi_radiosity.solver.refine"):
        monkeypatch.setattr(sys.modules[module], "MAX_LEVEL", 2)
    solution = mr.solve(corner(), mr.Uniform(), elements=1_000, rays=20_000)
    assert solution.stats["elements"] == 4 * 4**2
    assert "split 2 times at most" in warning_of(solution)


def test_a_time_that_is_too_short():
    solution = mr.solve(corner(), seconds=1e-6)
    assert np.all(np.isfinite(np.array(solution.radiosity())))


def test_command_line_warns(tmp_path, capsys):
    (tmp_path / "room.xml").write_text(BLACK_ROOM)
    budgets = ["--elements", "5000", "--rays", "100000", "--spp", "1"]
    files = ["-o", str(tmp_path / "a.exr"), "--stats", str(tmp_path / "stats.json")]
    assert main(["render", str(tmp_path / "room.xml"), *files, *budgets]) == 0
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "elements instead of 5,000" in line)
    assert line.startswith("mi-radiosity: warning: ")
    assert json.loads((tmp_path / "stats.json").read_text())["elements"] == 14


def test_comparisons_mark_rows_with_fewer_elements(tmp_path):
    """`uniform` refines the black room, GMI finds nothing to refine: its rows are marked everywhere."""
    (tmp_path / "room.xml").write_text(BLACK_ROOM)
    budgets = {"elements": 200, "rays": 10_000, "seeds": 2, "spp": 4, "reference_spp": 8}
    found = compare_oracles(tmp_path / "room.xml", tmp_path, oracles="uniform,gmi:0.5", **budgets)
    meshes = (row for row in found["rows"] if row["question"] == "mesh")
    rows = {row["label"]: (row["elements"], row["elements_wanted"]) for row in meshes}
    assert rows["gmi:0.5"] == (14, 200) and 197 < rows["uniform"][0] <= 200
    assert json.loads((tmp_path / "results.json").read_text())["rows"] == found["rows"]
    for file in ("table.md", "report.html"):
        text = (tmp_path / file).read_text(encoding="utf-8")
        assert "gmi:0.5 †" in text and "gmi:0.5 14 of 200" in text and "uniform †" not in text
