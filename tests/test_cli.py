"""The command line: files, exit statuses, one line for every error."""

import json
from types import SimpleNamespace

from mi_radiosity.cli import main
from mi_radiosity.evaluation import scenes
from mi_radiosity.oracles import ORACLES

import mitsuba as mi
import numpy as np
import pytest

pytestmark = pytest.mark.fast

BOX = "scenes_xml/box_furnace.xml"
QUICK = ["--elements", "200", "--rays", "9000", "--spp", "1"]


def test_render_writes_what_it_is_asked_for(tmp_path, capsys):
    out, stats, kept = tmp_path / "box.exr", tmp_path / "box.json", tmp_path / "box.npz"
    assert main(["render", BOX, "-o", str(out), "--stats", str(stats), "--save", str(kept), *QUICK]) == 0
    numbers = json.loads(stats.read_text())
    assert set(numbers) >= {
        "elements",
        "pairs",
        "rays",
        "oracle_rays",
        "iterations",
        "power",
        "seconds",
        "epsilon",
        "oracle",
        "alpha",
        "seed",
    }
    assert set(numbers["power"]) == {"emitted", "absorbed", "escaped", "unshot", "shown"}
    assert set(numbers["seconds"]) == {"scene", "refine", "distribute", "total"}
    bitmap = mi.Bitmap(str(out))
    assert json.loads(bitmap.metadata()["mi_radiosity"])["rays"] == 9000
    again = tmp_path / "again.exr"
    assert main(["render", BOX, "-o", str(again), "--load", str(kept), "--spp", "1"]) == 0
    np.testing.assert_allclose(np.array(mi.Bitmap(str(again))), np.array(bitmap), rtol=1e-5)
    assert "loaded" in capsys.readouterr().out


def test_all_views(tmp_path):
    arguments = ["render", "scenes_xml/office.xml", "-o", str(tmp_path / "office.png"), "--view", "all"]
    assert main([*arguments, "--elements", "1500", "--rays", "50000", "--spp", "1"]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["office_0.png", "office_1.png"]


def test_info(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["info", BOX]) == 0
    out = capsys.readouterr().out
    for says in ("12 fronts", "diffuse", "leaves from patches", "elements by default", "memory"):
        assert says in out


@pytest.mark.parametrize(
    "parts, says",
    [
        ('<shape type="sphere" id="ball"><medium type="homogeneous" name="interior"/></shape>', "remove the medium"),
        ('<shape type="sphere" id="ball"/>', "no light"),
        ("", "no shapes"),
    ],
    ids=["medium", "dark", "empty"],
)
def test_info_of_scenes_that_cannot_be_solved(capsys, monkeypatch, tmp_path, parts, says):
    monkeypatch.setenv("COLUMNS", "160")
    (tmp_path / "bad.xml").write_text(f'<scene version="3.0.0">{parts}</scene>')
    assert main(["info", str(tmp_path / "bad.xml")]) == 0
    out = capsys.readouterr().out
    assert says in out and ("ball" in out or not parts)


def test_definitions(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("COLUMNS", "160")
    file = tmp_path / "box.xml"
    file.write_text(open(BOX).read().replace('value="0.5"/></bsdf>', 'value="$rho"/></bsdf>'))
    for rho, says in (("0.2", "nothing: the whole"), ("1.5", "less than 1")):
        assert main(["info", str(file), "-D", f"rho={rho}"]) == 0
        assert says in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["render", "none.xml", "-o", "x.png"], "does not exist"),
        (["render", "pyproject.toml", "-o", "x.png"], "cannot read"),
        (["render", BOX, "-o", "x.jpg"], ".exr or .png"),
        (["render", BOX, "-o", "nowhere/x.png"], "nowhere does not exist"),
        (["render", BOX, "-o", "x.png", "--view", "1"], "1 sensor"),
        (["render", BOX, "-o", "x.png", "--oracle", "delphi"], "unknown oracle"),
        (["render", BOX, "-o", "x.png", "--oracle", "ks", "--alpha", "2"], "no alpha"),
        (["render", BOX, "-o", "x.png", "--alpha", "0"], "greater than 0"),
        (["render", BOX, "-o", "x.png", "--alpha", "nan"], "greater than 0"),
        (["render", BOX, "-o", "x.png", "--elements", "0"], "greater than 0"),
        (["render", BOX, "-o", "x.png", "--rays", "many"], "not a whole number"),
        (["render", BOX, "-o", "x.png", "--oracle", "gmi:x"], "must be a number"),
        (["render", BOX, "-o", "x.png", "--oracle", "ks:2"], "no parameter"),
        (["render", BOX, "-o", "x.png", "--oracle", "gmi:0.5", "--alpha", "1"], "no alpha"),
        (["render", BOX, "-o", "x.png", "--shading", "toon"], "'toon': choose one of gouraud, flat, mesh"),
        (["compare", BOX, "-o", "x.d", "--shading", "toon"], "'toon': choose one of gouraud, flat, mesh"),
        (["bench", BOX, "-o", "x.d", "--shading", "toon"], "'toon': choose one of gouraud, flat, mesh"),
        (["info", BOX, "--plugin", "x.py"], "x.py does not exist"),
        (["info", BOX, "--plugin", "no_such_module"], "no plugin module no_such_module"),
        (["render", BOX, "-o", "x.png", "--frobnicate"], "frobnicate"),
        (["render", BOX, "-o", "x.png", "--load", "none.npz"], "none.npz does not exist"),
        (["render", BOX, "-o", "x.png", "--load", "none.npz", "--rays", "9"], "leave out --rays"),
        (["render", BOX, "-o", "x.png", "-m", "tabula_rasa"], "unknown variant"),
        (["render", BOX, "-o", "x.png", "-m", "scalar_rgb"], "choose llvm_ad_rgb"),
        (["info", BOX, "-D", "rho"], "KEY=VALUE"),
        ([], "COMMAND"),
    ],
)
def test_errors_are_one_line(arguments, says, capsys, monkeypatch, tmp_path):
    arguments = [str(tmp_path / a) if a.startswith(("x.", "nowhere/")) else a for a in arguments]
    assert main(arguments) == 2
    message = capsys.readouterr().err
    assert says in message and message.count("\n") == 1 and message.startswith("mi-radiosity: error: ")
    assert list(tmp_path.iterdir()) == []
    mi.set_variant("llvm_ad_rgb")


@pytest.mark.parametrize(
    "body, says",
    [
        ("<scene version='3.0.0'><shape", "cannot read"),
        ("<scene version='3.0.0'><sensor type='perspective'/></scene>", "no shapes"),
        ("<scene version='3.0.0'><sensor type='perspective'/><shape type='cube'/></scene>", "no light"),
        ("<bsdf version='3.0.0' type='diffuse'/>", "scene file"),
    ],
)
def test_bad_scenes(body, says, tmp_path, capsys):
    file = tmp_path / "bad.xml"
    file.write_text(body)
    assert main(["render", str(file), "-o", str(tmp_path / "x.png")]) == 2
    message = capsys.readouterr().err
    assert says in message and message.count("\n") == 1
    assert list(tmp_path.iterdir()) == [file]


def test_interrupt(tmp_path, monkeypatch, capsys):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("mi_radiosity.solver.solve", stop)
    assert main(["render", BOX, "-o", str(tmp_path / "x.png")]) == 130
    assert list(tmp_path.iterdir()) == [] and "interrupted" in capsys.readouterr().err


PLUGIN = """
import drjit as dr
import mitsuba as mi
import mi_radiosity as mr

class Brightest(mr.Oracle):
    name = "brightest"
    def __init__(self, power=1.0):
        self.power = power
    def sigma(self, samples, pair):
        return pair.area_receiver * pair.area_source * samples.max() ** self.power
    def __str__(self):
        return f"{self.name}:{self.power:g}"

class Impatient(mr.Oracle):
    name = "impatient"
    uses_lines = False
    def sigma(self, samples, pair):
        def body(i):
            raise KeyboardInterrupt
        dr.while_loop((mi.UInt32(0),), lambda i: i < 1, body)
"""


@pytest.fixture
def plugin(tmp_path):
    file = tmp_path / "oracles.py"
    file.write_text(PLUGIN)
    yield file
    for name in ("brightest", "impatient"):
        ORACLES.pop(name, None)


def test_interrupt_inside_a_loop_of_drjit(tmp_path, plugin):
    """Dr.Jit wraps the interrupt in a RuntimeError; it still is one."""
    arguments = ["render", BOX, "-o", str(tmp_path / "x.png"), "--plugin", str(plugin), "--oracle", "impatient"]
    assert main([*arguments, *QUICK]) == 130


def test_oracle_with_its_parameter(tmp_path, plugin):
    """NAME:PARAMETER means what --alpha does, and holds for oracles of a plugin."""

    def stats(*options):
        file = tmp_path / "stats.json"
        assert main(["render", BOX, "-o", str(tmp_path / "x.png"), "--stats", str(file), *QUICK, *options]) == 0
        return {name: value for name, value in json.loads(file.read_text()).items() if name != "seconds"}

    colon = stats("--oracle", "gmi:0.75")
    assert (colon["oracle"], colon["alpha"]) == ("gmi", 0.75)
    assert colon == stats("--oracle", "gmi", "--alpha", "0.75") == stats("--alpha", "0.75")
    assert stats("--plugin", str(plugin), "--oracle", "brightest:2")["oracle"] == "brightest"


def test_plugins_of_installed_packages(tmp_path, plugin, monkeypatch):
    """What a package declares as entry point is known without --plugin."""
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [SimpleNamespace(value=str(plugin))])
    scenes._run_plugins.cache_clear()
    assert main(["render", BOX, "-o", str(tmp_path / "x.png"), "--oracle", "brightest", *QUICK]) == 0


def test_help_needs_no_scene(capsys):
    for command in ("render", "reference", "compare", "bench", "info"):
        with pytest.raises(SystemExit) as end:
            main([command, "--help"])
        assert end.value.code == 0 and "--plugin" in capsys.readouterr().out
