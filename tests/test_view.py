"""The page of `view`, in a real browser: headless Chromium."""

import base64
import json
import os
import re
import shutil
import subprocess
import zlib

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.export import lit_mesh, view, write_page
from mi_radiosity.export.page import _packed

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle
from test_export import room, srgb

T = mi.ScalarTransform4f

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ["--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

in_browser = pytest.mark.skipif(BROWSER is None, reason="needs Chromium: the package `chromium` of Debian and others")
fast = pytest.mark.fast


@pytest.fixture(scope="module")
def solution():
    return mr.solve(room(), elements=2500, rays=400_000)


@pytest.fixture(scope="module")
def page(solution, tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "view.html"
    write_page(solution, file)
    return file


def browse(page, *flags, hash="", folder=None):
    """Run the browser on a page until nothing moves; returns its standard output."""
    home = [f"--user-data-dir={folder or page.parent / 'browser'}"]
    command = [
        BROWSER,
        *FLAGS,
        *home,
        "--hide-scrollbars",
        "--virtual-time-budget=20000",
        *flags,
        f"{page.as_uri()}#{hash}",
    ]
    run = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stdout


def shot(page, tmp_path, hash):
    """A picture of the page in linear values, 8 × 8 pixels averaged into one [64, 96, 3]."""
    file = tmp_path / "shot.png"
    size = ["--window-size=768,512", "--force-device-scale-factor=1", f"--screenshot={file}"]
    browse(page, *size, hash=f"bare&{hash}", folder=tmp_path / "browser")
    x = np.array(mi.Bitmap(str(file)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True), dtype=float) / 255
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return linear.reshape(64, 8, 96, 8, 3).mean(axis=(1, 3))


@in_browser
@pytest.mark.parametrize("mode, shading", [("shaded", "gouraud"), ("flat", "flat")])
def test_the_page_shows_our_picture(solution, page, tmp_path, mode, shading):
    """The first view is the scene's sensor: RMSE below 2 of 255, edges included."""
    difference = srgb(shot(page, tmp_path, f"mode={mode}")) - srgb(solution.render(spp=64, shading=shading))
    assert np.sqrt((difference**2).mean()) < 2 and abs(difference.mean()) < 0.3


@in_browser
def test_light_adds_up_and_exposure_counts(solution, page, tmp_path):
    """Direct and indirect light make all of it; outlines darken; lux is in colours; a quarter of the light is one."""
    shots = {mode: shot(page, tmp_path, f"mode={mode}&exposure=0.25") for mode in ("direct", "indirect", "mesh")}
    both = shots["direct"] + shots["indirect"]
    picture = np.array(solution.render(spp=16)).mean() / 4
    np.testing.assert_allclose(both.mean(), picture, rtol=0.02)
    assert 0.5 < shots["mesh"].mean() / picture < 0.95
    assert (shot(page, tmp_path, "mode=lux").std(axis=2) > 0.02).mean() > 0.5


@pytest.fixture(scope="module")
def layered():
    """A second lamp of its own, and the first one dimmed already."""
    second = rectangle(T().translate([-0.99, 0, 0.3]).rotate([0, 1, 0], 90).scale(0.2), bsdf=diffuse(), emitter=lamp(9))
    return mr.solve(room(second=second), elements=2500, rays=400_000, layers=True).relight({"lamp": 0.4})


@pytest.fixture(scope="module")
def desk(layered, tmp_path_factory):
    file = tmp_path_factory.mktemp("desk") / "view.html"
    write_page(layered, file)
    return file


@in_browser
@pytest.mark.parametrize("scales", [{}, {"lamp": [0, 0, 0]}, {"second": [0, 0, 0]}, {"lamp": [1.5, 0.2, 0]}])
def test_lamps_are_dimmed_in_the_page(layered, desk, tmp_path, scales):
    """The sum of the layers in the browser is the picture of `relight`, lamps included."""
    asked = "".join(f"&lamp={name}:{','.join(map(str, scale))}" for name, scale in scales.items())
    picture = layered.relight({"lamp": 0.4} | scales).render(spp=64)
    difference = srgb(shot(desk, tmp_path, asked)) - srgb(picture)
    assert np.sqrt((difference**2).mean()) < 2 and abs(difference.mean()) < 0.3


SLIDE = """<script>
const told = {}, wait = setInterval(() => {
    if (!window.viewer) return;
    clearInterval(wait);
    const [level, color] = document.querySelectorAll("#lamps input");
    told.lamps = [...document.querySelectorAll("#lamps label")].map((label) => label.textContent);
    told.before = [Number(level.value), viewer.data.lamps[0].scale, color.value];
    const move = (input, value) => { input.value = value; input.dispatchEvent(new Event("input")); };
    move(level, 1.5); move(color, "#ff8000");
    told.after = viewer.data.lamps[0].scale;
    move(level, 0); move(level, 1);
    told.on = viewer.data.lamps[0].scale;
    document.title = "told " + JSON.stringify(told);
}, 20);
</script></body>"""


@in_browser
def test_sliders(desk, tmp_path):
    """A lamp's slider and colour say how it is, and change it; off and on again, it has its colour."""
    page = tmp_path / "sliding.html"
    page.write_text(desk.read_text(encoding="utf-8").replace("</body>", SLIDE), encoding="utf-8")
    told = json.loads(re.search(r"<title>told (.*?)</title>", browse(page, "--dump-dom"))[1])
    assert told["lamps"] == ["lamp × 0.4", "second × 1"]
    assert told["before"] == [0.4, [0.4] * 3, "#ffffff"]
    np.testing.assert_allclose(told["after"], [1.5, 1.5 * 0.2159, 0], rtol=1e-3)
    np.testing.assert_allclose(told["on"], [1, 0.2159, 0], rtol=1e-3)


@fast
def test_light_by_lamp_adds_up(layered):
    """At every vertex, lamps make the whole; elsewhere than beside walls to rounding."""
    base = layered.relight({})
    mesh = lit_mesh(base, by_lamp=True)
    whole, summed = np.stack([mesh.direct, mesh.indirect], axis=1), mesh.lamps.sum(axis=1)
    apart = np.abs(whole - summed).max(axis=(1, 2)) / whole.mean()
    assert np.median(apart) < 1e-5 and apart.mean() < 0.01
    assert lit_mesh(base).lamps.shape[1] == 0


PROBE = """<script>
const told = {}, wait = setInterval(() => {
    if (!window.viewer) return;
    clearInterval(wait);
    const canvas = document.querySelector("canvas"), camera = viewer.camera, place = () => camera.position.toArray();
    const point = (type, x, y, id = 1) => canvas.dispatchEvent(new PointerEvent(type,
        { pointerId: id, clientX: x, clientY: y, bubbles: true }));
    canvas.setPointerCapture = () => {};
    point("pointerdown", innerWidth * X, innerHeight * Y); point("pointerup", innerWidth * X, innerHeight * Y);
    told.reading = document.getElementById("reading").textContent;
    const ahead = () => camera.getWorldDirection(camera.up.clone()).toArray();
    told.before = { place: place(), ahead: ahead() };
    const key = (type) => document.body.dispatchEvent(new KeyboardEvent(type, { code: "KeyW", bubbles: true }));
    key("keydown"); viewer.walker.walk(0.5); key("keyup");
    told.walked = { place: place() };
    point("pointerdown", 300, 200); point("pointermove", 340, 200); point("pointerup", 340, 200);
    told.turned = { ahead: ahead() };
    point("pointerdown", 100, 100); point("pointerdown", 200, 100, 2); point("pointermove", 200, 60, 2);
    told.touched = { place: place() };
    document.title = "told " + JSON.stringify(told);
}, 20);
</script></body>"""


@in_browser
def test_clicks_keys_and_touch(solution, page, tmp_path):
    """A click tells the light at a point, W walks ahead, a drag turns, two fingers move."""
    x, y = 0.5, 0.3  # on the far wall, whatever the window's shape
    probing = tmp_path / "probing.html"
    text = page.read_text(encoding="utf-8")
    probe = PROBE.replace("* X", f"* {x}").replace("* Y", f"* {y}")
    probing.write_text(text.replace("</body>", probe), encoding="utf-8")
    html = browse(probing, "--window-size=768,512", "--dump-dom", folder=tmp_path / "browser")
    told = json.loads(re.search(r"<title>told (.*?)</title>", html)[1])
    lux, irradiance, radiosity, shape = told["reading"].split("\n")
    assert lux.endswith(" lx") and shape == "walls"
    H, B = (np.array(re.findall(r"[\d.]+", line)[:3], dtype=float) for line in (irradiance, radiosity))
    np.testing.assert_allclose(B, [0.7, 0.6, 0.5] * H, rtol=0.02)
    assert float(re.findall(r"[\d.]+", lux)[0]) == pytest.approx(179 * H @ [0.2126, 0.7152, 0.0722], rel=0.02)
    place = np.array(told["before"]["place"])
    pixel = np.array(solution.render(spp=64))[int(y * 64), int(x * 96)]
    np.testing.assert_allclose(B / np.pi, pixel, rtol=0.1)
    way = np.array(told["walked"]["place"]) - place
    ahead = np.array(told["before"]["ahead"])
    assert way @ ahead > 0 and abs(way[1]) < 1e-6  # on the level
    turn = np.array(told["turned"]["ahead"])
    assert 0.5 < turn @ ahead < 0.999 and turn[1] == pytest.approx(ahead[1], abs=1e-3)
    assert not np.allclose(told["touched"]["place"], told["walked"]["place"])


@fast
def test_the_page_needs_nothing_else(page):
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//""", text) and "import(" not in text
    assert "MIT licence" in text and text.count("</script>") == 3


@fast
@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32])
def test_packed_arrays_come_back(kind):
    """What view.js does, in NumPy."""
    array = np.random.default_rng(0).integers(0, np.iinfo(kind).max, (50, 3), endpoint=True).astype(kind)
    for deltas in (False, True):
        packed = _packed(array, deltas)
        planes = np.frombuffer(zlib.decompress(base64.b64decode(packed["data"])), np.uint8)
        found = np.ascontiguousarray(planes.reshape(packed["size"], -1).T).view(kind).astype(np.int64).reshape(-1, 3)
        if deltas:
            found = np.cumsum((found >> 1) ^ -(found & 1), axis=0)
        np.testing.assert_array_equal(found.astype(kind), array)


@fast
def test_in_a_notebook(solution):
    shown = solution.view(height=300)._repr_html_()
    assert shown.startswith('<iframe srcdoc="&lt;!DOCTYPE html') and "height: 300px" in shown
    assert shown.count('"') == 4 and view is mr.Solution.view


@fast
def test_view_command(tmp_path, capsys):
    kept, out = tmp_path / "box.npz", tmp_path / "box.html"
    render = ["render", "scenes_xml/box_furnace.xml", "-o", str(tmp_path / "box.png"), "--save", str(kept)]
    assert main([*render, "--layers", "--elements", "200", "--rays", "9000", "--spp", "1"]) == 0
    assert main(["view", str(kept), "-o", str(out)]) == 0 and out.stat().st_size < 800_000
    assert len(mr.Solution.load(kept, mi.load_file("scenes_xml/box_furnace.xml", optimize=False)).layers.names) == 1
    assert out.read_text(encoding="utf-8").count('"scale":[1.0,1.0,1.0]') == 1
    assert main(["render", *render[1:4], "--load", str(kept), "--layers"]) == 2
    for arguments, says in (
        (["-o", str(tmp_path / "x.png")], ".html"),
        (["-o", str(tmp_path / "none/x.html")], "does not exist"),
        (["-o", str(tmp_path / "x.html"), "--exposure", "-1"], "greater than 0"),
    ):
        capsys.readouterr()
        assert main(["view", str(kept), *arguments]) == 2
        message = capsys.readouterr().err
        assert says in message and message.count("\n") == 1
    assert sorted(os.listdir(tmp_path)) == ["box.html", "box.npz", "box.png"]
