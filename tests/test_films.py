"""What a scene says of its integrator, film and sensors: pictures and files follow it."""

import json
from pathlib import Path

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.display import hides_emitters, linear_rgb, unmodelled, write_image
from mi_radiosity.evaluation.reference import Reference, path_image
from mi_radiosity.export import export, lit_mesh, write_page
from mi_radiosity.export.cameras import cameras, sensors

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
FORMATS = ("luminance", "luminance_alpha", "rgb", "rgba", "xyz", "xyza")
LOOK = T().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])


def film(pixel_format="rgb", size=12, **more):
    return {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "pixel_format": pixel_format,
        "rfilter": {"type": "box"},
    } | more


def plate(*sensors, **more):
    """A coloured plate below a small lamp that the camera sees, and nothing behind: alpha and colour vary."""
    parts = {
        "plate": rectangle(T().scale(0.8), bsdf=diffuse([0.8, 0.4, 0.1])),
        "lamp": rectangle(
            T().translate([0.5, 0.4, 1]).rotate([1, 0, 0], 180).scale(0.2), bsdf=diffuse(), emitter=lamp(9)
        ),
    }
    found = {f"sensor{k}": sensor for k, sensor in enumerate(sensors)}
    return mi.load_dict({"type": "scene", **found, **parts, **more}, optimize=False)


def camera(**more):
    return {"type": "perspective", "to_world": LOOK, "film": film()} | more


HIDING = {
    "path": {"type": "path", "hide_emitters": True},
    "prb": {"type": "prb", "hide_emitters": True},
    "aov": {"type": "aov", "aovs": "z:depth", "inner": {"type": "path", "hide_emitters": True}},
    "moment": {
        "type": "moment",
        "inner": {"type": "aov", "aovs": "z:depth", "inner": {"type": "direct", "hide_emitters": True}},
    },
    "radiosity": {"type": "radiosity", "hide_emitters": True},
}


@pytest.mark.parametrize("integrator", HIDING.values(), ids=HIDING)
def test_the_scenes_own_integrator_hides_emitters(integrator):
    """Colour and alpha are those of `path` that hides them; the argument of `render` overrides the scene."""
    scene = plate(camera(film=film("rgba")), integrator=integrator, sky={"type": "constant", "radiance": 0.2})
    assert hides_emitters(scene)
    solution = mr.solve(scene, elements=300, rays=60_000)
    for hide, arguments in ((True, {}), (False, {"hide_emitters": False})):
        path = mi.load_dict({"type": "path", "max_depth": -1, "hide_emitters": hide})
        true = np.array(mi.render(scene, integrator=path, spp=256)).mean(axis=(0, 1))
        ours = np.array(solution.render(spp=64, shading="gather", **arguments)).mean(axis=(0, 1))
        np.testing.assert_allclose(ours, true, rtol=0.03)


def test_what_the_integrator_says_and_pictures_do_not_follow_is_told():
    for integrator, says in (
        ({"type": "path", "max_depth": 3}, "max_depth 3"),
        ({"type": "direct"}, "direct light"),
        ({"type": "depth"}, "no radiance"),
        ({"type": "aov", "aovs": "z:depth", "inner": {"type": "path"}}, "adds channels"),
        ({"type": "ptracer"}, "--hide-emitters"),
    ):
        (line,) = unmodelled(plate(integrator=integrator))
        assert says in line
    assert unmodelled(plate(integrator={"type": "path", "max_depth": -1})) == unmodelled(plate()) == []


@pytest.mark.parametrize("name", FORMATS)
def test_every_pixel_format_is_one_picture(name):
    """Linear RGB, its luminance and alpha are the same whatever the film's channels are."""
    scene = plate(camera(), camera(film=film(name)), camera(film=film("rgba")))
    solution = mr.solve(scene, elements=300, rays=60_000)
    plain, other, alpha = (np.array(solution.render(k, spp=16)) for k in range(3))
    converted = linear_rgb(other, scene.sensors()[1].film())
    grey = plain @ [0.212671, 0.715160, 0.072169]
    np.testing.assert_allclose(converted, np.stack([grey] * 3, axis=2) if "luminance" in name else plain, atol=2e-4)
    if name.endswith("a"):
        np.testing.assert_allclose(other[..., -1], alpha[..., -1], atol=1e-5)
        assert 0.1 < other[..., -1].mean() < 0.9
    assert other.shape[2] == {"luminance": 1, "luminance_alpha": 2}.get(name, len(name))


@pytest.mark.parametrize("component", ["float16", "float32", "uint32"])
@pytest.mark.parametrize("name", FORMATS)
def test_files_are_those_that_mitsuba_writes(name, component, tmp_path):
    """EXR: the film's own `write`; PNG: `mi.util.write_bitmap` of the film's bitmap, where nothing is too bright."""
    scene = plate(camera(film=film(name, component_format=component)))
    sensor = scene.sensors()[0]
    image = mi.render(scene, integrator=mi.load_dict({"type": "path", "hide_emitters": True}), spp=16)
    for end in ("exr", "png"):
        write_image(tmp_path / f"ours.{end}", image, {"spp": 16}, sensor.film())
    sensor.film().write(str(tmp_path / "its.exr"))
    mi.util.write_bitmap(str(tmp_path / "its.png"), sensor.film().bitmap(), write_async=False)
    for end in ("exr", "png"):
        ours, its = (mi.Bitmap(str(tmp_path / f"{who}.{end}")) for who in ("ours", "its"))
        assert ours.pixel_format() == its.pixel_format() and ours.component_format() == its.component_format()
        ours, its = (np.array(bitmap, dtype=np.float64) for bitmap in (ours, its))
        np.testing.assert_allclose(ours, its, rtol=1e-3, atol=1 if end == "png" else 1e-6 * its.max())


def test_values_that_float16_does_not_hold_are_told(tmp_path):
    """The file says infinity, as Mitsuba's does; nothing is said of float32."""
    image = mi.TensorXf(np.full((12, 12, 3), 1e5, dtype=np.float32))
    for component in ("float16", "float32"):
        scene = plate(camera(film=film(component_format=component)))
        file = tmp_path / f"{component}.exr"
        if component == "float16":
            with pytest.warns(mr.RadiosityWarning, match="float16"):
                write_image(file, image, film=scene.sensors()[0].film())
        else:
            write_image(file, image, film=scene.sensors()[0].film())
        assert np.isinf(np.array(mi.Bitmap(str(file)))).all() == (component == "float16")


XML = """<scene version="3.0.0"><integrator type="aov"><string name="aovs" value="z:depth"/>
<integrator type="path"><boolean name="hide_emitters" value="true"/><integer name="max_depth" value="-1"/></integrator>
</integrator>
<sensor type="thinlens" id="lens"><float name="aperture_radius" value="0.1"/><float name="focus_distance" value="5"/>
<transform name="to_world"><lookat origin="0, 0, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/>
<string name="pixel_format" value="FORMAT"/>
<string name="component_format" value="float32"/><rfilter type="box"/></film></sensor>
<shape type="rectangle" id="plate"><bsdf type="diffuse"><rgb name="reflectance" value="0.8 0.4 0.1"/></bsdf></shape>
<shape type="rectangle" id="lamp">
<transform name="to_world"><scale value="0.2"/><rotate x="1" angle="180"/><translate z="1"/></transform>
<emitter type="area"><rgb name="radiance" value="9"/></emitter></shape></scene>"""


@pytest.mark.parametrize("name", ["luminance", "xyza"])
def test_commands_follow_the_scene(name, tmp_path, capsys):
    """render, its overriding, reference and gallery of one file: lamps hidden, the film's channels, a thin lens."""
    file, small = tmp_path / "scene.xml", ["--elements", "100", "--rays", "2e4", "--spp", "32"]
    file.write_text(XML.replace("FORMAT", name))
    scene = mi.load_file(str(file), optimize=False)
    true, shown = (np.array(path_image(scene, scene.sensors()[0], 256)).mean(axis=(0, 1)), {})
    for word in ("", "--no-hide-emitters"):
        out = tmp_path / "out.exr"
        assert main(["render", str(file), "-o", str(out), *small, *filter(None, [word])]) == 0
        assert "adds channels" in capsys.readouterr().err
        bitmap = mi.Bitmap(str(out)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False)
        shown[word] = np.array(bitmap).mean(axis=(0, 1))
    np.testing.assert_allclose(shown[""], true, rtol=0.03)
    assert (shown["--no-hide-emitters"] < 0.95 * true).all()  # the back of the lamp covers some of the plate
    assert main(["info", str(file)]) == 0 and "show no emitters" in capsys.readouterr().out
    assert main(["reference", str(file), "-o", str(tmp_path / "ref.exr"), "--spp", "256"]) == 0
    assert "adds channels" in capsys.readouterr().err
    np.testing.assert_allclose(Reference.load(tmp_path / "ref.exr").image().mean(axis=(0, 1)), true, rtol=0.03)
    gallery = ["gallery", str(file), "-o", str(tmp_path / "g"), "--work", str(tmp_path / "w"), "--seconds", "0.3"]
    assert main([*gallery, "--reference-spp", "128"]) == 0
    ratio = float((tmp_path / "g/gallery.md").read_text().split("mean ")[1].split(" of")[0])
    assert ratio == pytest.approx(1, abs=0.05)


def test_references_of_hidden_emitters_are_others(tmp_path, capsys):
    """A kept reference is not continued with other emitters visible."""
    file, ref = tmp_path / "scene.xml", ["-o", str(tmp_path / "ref.exr"), "--spp", "128"]
    file.write_text(XML.replace("FORMAT", "rgb"))
    assert main(["reference", str(file), *ref]) == 0
    file.write_text(XML.replace("FORMAT", "rgb").replace('"true"', '"false"'))
    assert main(["reference", str(file), *ref]) == 2
    assert "another sensor" in capsys.readouterr().err


def test_the_scenes_radiosity_integrator_sets_options(tmp_path):
    """Its elements, oracle, seed and shading are used by `render`, and the command line overrides them."""
    settings = (
        '<string name="oracle" value="power"/><integer name="elements" value="150"/><integer name="rays" value="9000"/>'
    )
    settings += '<integer name="seed" value="7"/><string name="shading" value="lux"/>'
    start, end = XML.index("<integrator"), XML.index("<sensor")
    text = f'{XML[:start]}<integrator type="radiosity">{settings}</integrator>{XML[end:]}'.replace("FORMAT", "rgb")
    file, out = (
        tmp_path / "scene.xml",
        ["-o", str(tmp_path / "x.png"), "--spp", "1", "--stats", str(tmp_path / "x.json")],
    )
    file.write_text(text)
    for words, want in (
        ([], ("power", 9000, 7)),
        (["--oracle", "ks", "--rays", "8e3", "--epsilon", "1"], ("ks", 8000, 7)),
    ):
        assert main(["render", str(file), *out, *words]) == 0
        stats = json.loads((tmp_path / "x.json").read_text())
        assert (stats["oracle"], stats["rays"], stats["seed"]) == (want[0], pytest.approx(want[1], rel=0.05), want[2])


# ---- Sensors ---------------------------------------------------------------------------------------


def many_sensors():
    """One of every sensor that Mitsuba ships, with films that differ."""
    pixel = {"film": film(size=1)}
    window = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 7, "crop_height": 6}
    mitchell = {"sample_border": True, "rfilter": {"type": "mitchell", "B": 0.25, "C": 0.5}}
    wide = {"type": "hdrfilm", "width": 24, "height": 12, "rfilter": {"type": "lanczos"}}
    batch = {
        "a": camera(fov=30),
        "b": {"type": "thinlens", "aperture_radius": 0.3, "focus_distance": 3.0, "to_world": LOOK},
    }
    return (
        camera(id="window", film=film("rgba", **window), principal_point_offset_x=0.1, fov=35),
        {"type": "thinlens", "id": "lens", "aperture_radius": 0.2, "focus_distance": 4.0, "to_world": LOOK,
         "film": film("xyza", rfilter={"type": "gaussian", "stddev": 0.637}, component_format="float32"),
         "sampler": {"type": "multijitter", "sample_count": 9}},
        {"type": "orthographic", "id": "plan", "to_world": LOOK, "film": film("luminance", **mitchell)},
        {"type": "radiancemeter", "id": "meter", "to_world": LOOK, **pixel},
        {"type": "distant", "id": "far", "direction": [0.1, 0, -1], "target": [0, 0, 0], **pixel},
        {"type": "batch", "id": "pair", "film": wide} | batch,
    )  # fmt: skip


@pytest.fixture(scope="module")
def watched():
    meter = {"type": "irradiancemeter", "film": film(size=1)}
    patch = rectangle(T().translate([-0.5, 0, 0.2]).scale(0.2), bsdf=diffuse(), sensor=meter)
    scene = plate(*many_sensors(), patch=patch)
    return mr.solve(scene, elements=300, rays=60_000)


def test_every_sensor_sees_what_path_sees(watched):
    scene = watched.model.scene
    for number, sensor in enumerate(scene.sensors()):
        path = mi.load_dict({"type": "path", "max_depth": -1})
        spp = 1 << 16 if sensor.film().size()[0] == 1 else 256
        true, ours = (np.array(x) for x in (
            mi.render(scene, sensor=sensor, integrator=path, spp=spp),
            watched.render(np.int64(number), spp=spp, shading="gather"),
        ))  # fmt: skip
        assert ours.shape == true.shape
        np.testing.assert_allclose(ours.mean(axis=(0, 1)), true.mean(axis=(0, 1)), rtol=0.04, atol=1e-4)


def test_an_exported_scene_keeps_cameras_and_films(watched, tmp_path):
    """Every sensor but the one on a shape: its description, film included, is the same; the meter is named."""
    scene = watched.model.scene
    with pytest.warns(mr.RadiosityWarning, match="sensor 'sensor'"):
        export(watched, tmp_path / "x.xml")
    kept = {s.id(): s for s in mi.load_file(str(tmp_path / "x.xml")).sensors()}
    old = {s.id(): s for s in scene.sensors() if s.class_name() != "IrradianceMeter"}
    assert kept.keys() == old.keys()
    for name in old.keys() - {"pair"}:
        for a, b in zip(str(kept[name]).splitlines(), str(old[name]).splitlines(), strict=True):
            assert (
                a == b or "sample" in a or "wavefront" in a
            )  # `mi.render` of other tests changes the samplers of the scene
    for name in ("window", "lens", "plan", "pair"):
        a, b = (np.array(x) for x in (mi.render(mi.load_file(str(tmp_path / "x.xml")), sensor=kept[name], spp=256),
                                      watched.render(old[name], spp=256)))  # fmt: skip
        np.testing.assert_allclose(a.mean(axis=(0, 1)), b.mean(axis=(0, 1)), rtol=0.03)


def test_pinhole_files_name_what_they_leave_out(watched, tmp_path):
    for write, name in ((export, "x.glb"), (write_page, "x.html")):
        if name.endswith("glb"):
            pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
        with pytest.warns(mr.RadiosityWarning) as caught:
            write(watched, tmp_path / name)
        told = "\n".join(str(warning.message) for warning in caught)
        for says in ("'window'", "crop window", "principal point", "'lens'", "thin lens", "'plan'", "'meter'", "'far'"):
            assert says in told
    assert [c.kind for c in cameras(watched.model.scene)].count("thinlens") == 2
    assert len(sensors(watched.model.scene)[0]) == 6


def test_hidden_emitters_are_left_out_of_files(tmp_path):
    """The mesh has no lamp where the scene hides it; the argument overrides that."""
    solution = mr.solve(plate(camera(), integrator=HIDING["aov"]), elements=200, rays=20_000)
    whole = lit_mesh(solution)
    count = {}
    for hide in (None, False):
        export(solution, tmp_path / "x.ply", hide_emitters=hide)
        count[hide] = int((tmp_path / "x.ply").read_bytes().split(b"element face ")[1].split(b"\n")[0])
    (number,) = (k for k, part in enumerate(solution.model.faces.parts) if part.shape.id() == "lamp")
    assert count == {None: int((whole.shape != number).sum()), False: len(whole.shape)}


def test_denoised_pictures_have_the_films_channels(tmp_path):
    pytest.importorskip("mitsuba_oidn", reason="needs mitsuba-oidn: pip install 'mi_radiosity[denoise]'")
    scene = plate(*(camera(film=film(name, size=32)) for name in FORMATS), integrator=HIDING["path"])
    solution = mr.solve(scene, elements=300, rays=60_000)
    for number, name in enumerate(FORMATS):
        noisy, clean = (np.array(solution.render(number, spp=64, shading="gather", denoise=d)) for d in (False, True))
        assert clean.shape == noisy.shape, name
        np.testing.assert_allclose(clean.mean(axis=(0, 1)), noisy.mean(axis=(0, 1)), rtol=0.03)
    meter = plate({"type": "radiancemeter", "to_world": LOOK, "film": film(size=1)})
    with pytest.raises(mr.RadiosityError, match="too small"):
        mr.solve(meter, elements=100, rays=5000).render(denoise=True)


def test_no_export_overwrites_what_it_did_not_name(tmp_path, capsys):
    """The .xml has a mesh of another name than an exported .ply; only that of an earlier export is overwritten."""
    solution = mr.solve(plate(camera()), elements=100, rays=5000)
    export(solution, tmp_path / "x.ply")
    before = (tmp_path / "x.ply").read_bytes()
    for _ in range(2):
        assert [p.name for p in export(solution, tmp_path / "x.xml")] == ["x.xml", "x_mesh.ply"]
    assert (tmp_path / "x.ply").read_bytes() == before
    for name in ("y_mesh.ply", "z_facets.csv"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(mr.RadiosityError, match=r"y_mesh\.ply goes beside y\.xml"):
        export(solution, tmp_path / "y.xml")
    with pytest.raises(mr.RadiosityError, match=r"z_facets\.csv goes beside z\.csv"):
        mr.write_factors(mr.view_factors(solution.model, rays=8), tmp_path / "z.csv")
    assert (tmp_path / "y_mesh.ply").read_text() == (tmp_path / "z_facets.csv").read_text() == "mine"
    assert not (tmp_path / "y.xml").exists() and not (tmp_path / "z.csv").exists()


def test_commands_do_not_write_over_what_they_read(tmp_path, capsys):
    scene, kept = tmp_path / "scene.xml", tmp_path / "kept.npz"
    scene.write_text(XML.replace("FORMAT", "rgb"))
    render = ["render", str(scene), "--elements", "100", "--rays", "5000", "--spp", "1", "-o"]
    assert main([*render, str(tmp_path / "x.png"), "--save", str(kept)]) == 0
    text, solved = scene.read_text(), kept.read_bytes()
    for words, says in (
        (["export", str(kept), "-o", str(scene)], "is read by this command"),
        ([*render, str(tmp_path / "x.png"), "--stats", str(scene)], "is read by this command"),
        ([*render, str(tmp_path / "x.png"), "--stats", str(tmp_path / "x.png")], "twice"),
    ):
        capsys.readouterr()
        assert main(words) == 2
        assert says in (error := capsys.readouterr().err) and error.count("\n") == 1
    assert scene.read_text() == text and kept.read_bytes() == solved
    assert Path(tmp_path / "x.png").stat().st_size > 0
