"""Numbers of any type that callers and options give, and variants and files that cannot be used: one clear line."""

import json

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.core import llvm
from mi_radiosity.core.numbers import real_number, whole_number
from mi_radiosity.evaluation.reference import render_reference
from mi_radiosity.export import export, lightmap, measure, plane_grid, view

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
NONE_WHOLE = (0, -3, 2.5, np.float64(0.5), np.nan, float("inf"), True, np.bool_(True), "7", "many", [7], np.ones(2), 1j)


@pytest.fixture(scope="module")
def box():
    return scene(
        optimize=False,
        walls={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)},
        lamp=rectangle(T().translate([0, 0, 0.9]).rotate([1, 0, 0], 180).scale(0.3), bsdf=diffuse(), emitter=lamp(5)),
    )


@pytest.fixture(scope="module")
def solution(box):
    return mr.solve(box, elements=150, rays=9_000)


@pytest.mark.parametrize("value", [7, np.int64(7), np.uint8(7), np.float32(7), 7.0, np.array(7), np.float64(7e0)])
def test_whole_numbers_of_any_type(value):
    number = whole_number("n", value)
    assert number == 7 and type(number) is int
    assert type(real_number("x", value, 0)) is float


def test_other_values_are_refused_with_the_name():
    for value in NONE_WHOLE:
        with pytest.raises(mr.RadiosityError, match="^lines must be a whole number greater than 0, not "):
            whole_number("lines", value)
    for value in (0, -1, np.nan, float("inf"), True, "1", None, [1.0]):
        with pytest.raises(mr.RadiosityError, match="^epsilon must be a number greater than 0, not "):
            real_number("epsilon", value, 0)
    assert whole_number("seed", np.int64(-5), None) == -5 and real_number("x", np.float32(-0.5)) == -0.5
    assert whole_number("n", 10**25) == 10**25


CALLS = {  # number of a public function: a call with it, and a value that works
    "elements": (lambda box, solution, n: mr.solve(box, elements=n, rays=5000), 100),
    "rays": (lambda box, solution, n: mr.solve(box, elements=100, rays=n), 5000),
    "lines": (lambda box, solution, n: mr.solve(box, elements=100, rays=5000, lines=n), 4),
    "spp": (lambda box, solution, n: solution.render(spp=n), 2),
    "samples": (lambda box, solution, n: solution.irradiance([[0, 0, 0]], [[0, 0, 1]], samples=n), 16),
    "view factors' rays": (lambda box, solution, n: mr.view_factors(box, rays=n), 16),
    "a solution's view factors' rays": (lambda box, solution, n: solution.view_factors(rays=n), 16),
    "measure's samples": (
        lambda box, solution, n: measure(solution, plane_grid(solution.model, "z=0", 1), samples=n),
        16,
    ),
    "lightmap's size": (lambda box, solution, n: lightmap(solution, n, 4), 32),
    "lightmap's samples": (lambda box, solution, n: lightmap(solution, 32, n), 4),
    "height of a view": (lambda box, solution, n: view(solution, height=n), 200),
}


@pytest.mark.parametrize("name", CALLS)
def test_counts_of_public_functions(name, box, solution):
    """NumPy's integers and whole floats work; everything else is one line that names the number."""
    if "lightmap" in name:
        pytest.importorskip("xatlas", reason="needs xatlas: pip install 'mi_radiosity[export]'")
    call, value = CALLS[name]
    for number in (np.int64(value), np.float32(value)):
        call(box, solution, number)
    for bad in NONE_WHOLE:
        with pytest.raises(mr.RadiosityError) as error:
            call(box, solution, bad)
        assert "\n" not in str(error.value) and ("whole number" in str(error.value) or "texels" in str(error.value))


def test_numpy_numbers_mean_the_same(box, tmp_path):
    """The same solution to the bit, and statistics that JSON can hold."""
    plain = mr.solve(box, mr.GMI(0.75), elements=150, rays=9000, seed=3)
    other = mr.solve(box, mr.GMI(np.float32(0.75)), elements=np.int32(150), rays=np.float64(9e3), seed=np.uint8(3))
    np.testing.assert_array_equal(np.array(plain.radiosity()), np.array(other.radiosity()))
    seeds = [json.loads(json.dumps(s.stats))["seed"] for s in (plain, other)]
    assert seeds == [3, 3]
    other.save(tmp_path / "s.npz")
    images = [np.array(s.render(spp=n, seed=k)) for s, n, k in ((plain, 2, 1), (other, np.int64(2), np.int16(1)))]
    np.testing.assert_array_equal(*images)


@pytest.mark.parametrize(
    "call",
    [
        lambda box, solution: mr.solve(box, epsilon=np.nan),
        lambda box, solution: mr.solve(box, epsilon=True),
        lambda box, solution: mr.solve(box, seconds="4"),
        lambda box, solution: mr.solve(box, seed=1.5),
        lambda box, solution: mr.solve(box, transport=3),
        lambda box, solution: mr.solve("scene.xml"),
        lambda box, solution: mr.solve(mi.load_dict({"type": "sphere"})),
        lambda box, solution: mr.GMI(True),
        lambda box, solution: mr.GMI(np.array([0.5, 1])),
        lambda box, solution: solution.render(sensor=np.int64(4)),
        lambda box, solution: solution.render(sensor=0.5),
        lambda box, solution: solution.render(sensor="front"),
        lambda box, solution: solution.render(seconds=np.float32(-1)),
        lambda box, solution: solution.render(seed=None),
        lambda box, solution: solution.irradiance([[0, 0, 0]], [[0, 0, 1]], seed=np.nan),
        lambda box, solution: mr.view_factors(box, up="z"),
        lambda box, solution: mr.view_factors(box, up=(0, np.nan, 1)),
        lambda box, solution: mr.view_factors(box, seed="a"),
        lambda box, solution: plane_grid(solution.model, "z=0", True),
        lambda box, solution: export(solution, "never.ply", exposure=np.nan),
        lambda box, solution: export(solution, "never.ply", exposure=True),
        lambda box, solution: export(solution, "never.ply", exposure=[1]),
        lambda box, solution: render_reference(box, box.sensors()[0], "never.exr", spp=-1),
    ],
)
def test_other_options_are_refused(call, box, solution):
    with pytest.raises(mr.RadiosityError) as error:
        call(box, solution)
    assert "\n" not in str(error.value)


def test_the_plugin_takes_whole_floats_only(box):
    plugin = mi.load_dict({"type": "radiosity", "elements": 150.0, "rays": 9e3, "seed": -1})
    assert np.isfinite(np.array(mi.render(box, integrator=plugin, spp=np.int64(2)))).all()
    assert plugin.solution.stats["seed"] == -1 and plugin.solution.stats["rays"] == 9000
    for bad in ({"elements": 150.5}, {"rays": 0}, {"lines": -1}, {"epsilon": -1.0}):
        with pytest.raises(Exception, match=f"{next(iter(bad))} must be"):
            mi.load_dict({"type": "radiosity"} | bad)


FURNACE = "scenes_xml/box_furnace.xml"


def test_options_take_powers_of_ten(tmp_path):
    out = ["-o", str(tmp_path / "x.png"), "--stats", str(tmp_path / "x.json"), "--spp", "1e0", "--seed", "1e1"]
    assert main(["render", FURNACE, *out, "--elements", "2e2", "--rays", "9e3"]) == 0
    stats = json.loads((tmp_path / "x.json").read_text())
    assert (stats["rays"], stats["seed"]) == (9000, 10) and abs(stats["elements"] - 200) <= 3
    out = ["-o", str(tmp_path / "f.npz")]
    assert main(["view-factors", FURNACE, *out, "--rays", "1e2"]) == 0


@pytest.mark.parametrize("value", ["1e6.5", "2.5", "-1", "0", "nan", "inf", "1e999", "true", "1,000", ""])
@pytest.mark.parametrize("option", ["--elements", "--rays", "--spp", "--lines"])
def test_counts_of_the_command_line(option, value, tmp_path, capsys):
    assert main(["render", FURNACE, "-o", str(tmp_path / "x.png"), f"{option}={value}"]) == 2
    error = capsys.readouterr().err
    assert f"'{value}' is not a whole number greater than 0" in error and error.count("\n") == 1


# ---- Variants and files ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "variant, says",
    [
        ("cuda_ad_rgb", "needs an NVIDIA GPU"),
        ("scalar_rgb", "cannot be used: choose llvm_ad_rgb with"),
        ("llvm_ad_spectral", "cannot be used: choose llvm_ad_rgb with"),
        ("llvm_ad_mono", "cannot be used: choose llvm_ad_rgb with"),
        ("llvm_ad_rbg", "unknown variant 'llvm_ad_rbg': choose llvm_ad_rgb with"),
    ],
)
def test_variants_that_cannot_work(variant, says, capsys, monkeypatch):
    """One line that names a variant which does work; the active variant stays."""
    has = dr.has_backend
    monkeypatch.setattr(dr, "has_backend", lambda backend: backend != dr.JitBackend.CUDA and has(backend))
    assert main(["info", FURNACE, "-m", variant]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1 and mi.variant() == "llvm_ad_rgb"
    with pytest.raises(mr.RadiosityError, match=says):
        llvm.require_variant(variant)


SCENE = '<scene version="3.0.0"><shape type="sphere">{}<emitter type="area"/></shape>{}</scene>'
FILES = {
    "a folder": (None, "is a folder"),
    "empty": ("", "cannot read"),
    "binary": ("\x00\x01\x02", "cannot read"),
    "unknown plugin": (SCENE.format('<bsdf type="velvet"/>', ""), "velvet"),
    "missing texture": (
        SCENE.format(
            '<bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
            '<string name="filename" value="none.png"/></texture></bsdf>',
            "",
        ),
        "none.png",
    ),
    "missing mesh": (
        SCENE.format("", '<shape type="ply"><string name="filename" value="none.ply"/></shape>'),
        "none.ply",
    ),
    "unknown parameter": (SCENE.format('<float name="radus" value="1"/>', ""), "radus"),
    "undefined $KEY": (SCENE.format('<float name="radius" value="$r"/>', ""), r"$r"),
    "missing include": (SCENE.format("", '<include filename="none.xml"/>'), "none.xml"),
    "itself included": (SCENE.format("", '<include filename="scene.xml"/>'), "scene.xml"),
    "spectral film": (SCENE.format("", '<sensor type="perspective"><film type="specfilm"/></sensor>'), "spectral"),
    "a plugin of ours": (
        SCENE.format("", '<integrator type="radiosity"><float name="elements" value="2.5"/></integrator>'),
        "elements must be a whole number greater than 0, not 2.5",
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_files_that_are_no_scene(name, tmp_path, capsys):
    """One line of less than 900 characters that names the file and what is wrong, without a traceback."""
    text, says = FILES[name]
    file = tmp_path / "scene.xml"
    file.mkdir() if text is None else file.write_text(text)
    for command in (["info", str(file)], ["render", str(file), "-o", str(tmp_path / "x.png")]):
        assert main(command) == 2
        error = capsys.readouterr().err
        assert str(file) in error and says in error and "Traceback" not in error
        assert error.count("\n") == 1 and len(error) < 900


def test_other_files_that_are_folders(tmp_path, box, capsys):
    folder = tmp_path / "folder.npz"
    folder.mkdir()
    for call in (lambda: mr.Solution.load(folder, box), lambda: mr.read_factors(folder)):
        with pytest.raises(mr.RadiosityError, match=r"folder\.npz"):
            call()
    kept = tmp_path / "s.npz"
    mr.solve(mi.load_file(FURNACE, optimize=False), elements=100, rays=5000).save(kept)
    for words in (
        ["render", FURNACE, "-o", str(tmp_path / "x.png"), "--load", str(folder)],
        ["render", FURNACE, "-o", str(folder / "x.png"), "--save", str(folder)],
        ["info", FURNACE, "--plugin", str(folder)],
        ["measure", str(kept), "--scene", FURNACE, "--points", str(folder)],
        ["measure", str(folder), "--scene", FURNACE, "--plane", "z=0"],
        ["export", str(kept), "--scene", str(folder), "-o", str(tmp_path / "x.ply")],
    ):
        capsys.readouterr()
        assert main(words) == 2
        assert (error := capsys.readouterr().err).count("\n") == 1 and "folder.npz" in error
