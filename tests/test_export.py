"""Exports: the lit mesh is closed and whole, and other programs show what our pictures show."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.export import export, lit_mesh
from mi_radiosity.export.textures import textures

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
ASSETS = Path("mi_radiosity/export/assets")


def srgb(linear):
    """8-bit sRGB values as floats."""
    x = np.clip(np.asarray(linear, dtype=float), 0, 1)
    return 255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def room(**more):
    """A closed room of 2 m: a table that crosses elements, a two-sided sheet, a rug in the plane of the floor."""
    camera = {
        "type": "perspective",
        "fov": 80,
        "to_world": T().look_at([0.3, -0.1, 0.98], [-0.1, -0.5, -1], [0, 1, 0]),
        "film": {
            "type": "hdrfilm",
            "width": 96,
            "height": 64,
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
    }
    shapes = {
        "walls": {"type": "cube", "flip_normals": True, "bsdf": diffuse([0.7, 0.6, 0.5])},
        "lamp": rectangle(
            T().translate([0, 0.99, 0.3]).rotate([1, 0, 0], 90).scale(0.3), bsdf=diffuse(), emitter=lamp(20)
        ),
        "table": {
            "type": "cube",
            "to_world": T().translate([-0.3, -0.8, -0.4]).scale([0.25, 0.2, 0.2]),
            "bsdf": diffuse([0.2, 0.4, 0.7]),
        },
        "sheet": rectangle(
            T().translate([0.5, -0.6, -0.3]).rotate([0, 1, 0], 40).scale(0.25),
            bsdf=diffuse([0.8, 0.2, 0.2], two_sided=True),
        ),
        "rug": rectangle(
            T().translate([0.2, -1, 0.1]).rotate([1, 0, 0], -90).scale(0.3), bsdf=diffuse([0.1, 0.5, 0.2])
        ),
    }
    return (
        scene(optimize=False, camera=camera, **shapes | more)
        if more
        else mi.load_dict({"type": "scene", "camera": camera, **shapes}, optimize=False)
    )


@pytest.fixture(scope="module")
def solution():
    return mr.solve(room(), elements=2500, rays=400_000)


@pytest.fixture(scope="module")
def mesh(solution):
    return lit_mesh(solution)


def border(vertices, triangles, surface):
    """Length of the sides that one triangle has alone within its surface; no side has more than two."""
    _, place = np.unique(np.round(vertices, 6), axis=0, return_inverse=True)
    sides = np.sort(place.ravel()[triangles][:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    rows = np.column_stack([np.repeat(surface, 3), sides.reshape(-1, 2)])
    rows, count = np.unique(rows, axis=0, return_counts=True)
    assert count.max() <= 2
    points = np.empty((place.max() + 1, 3))
    points[place.ravel()] = vertices
    alone = rows[count == 1]
    return np.linalg.norm(points[alone[:, 1]] - points[alone[:, 2]], axis=1).sum()


def test_surfaces_are_closed(solution, mesh):
    """Inside of a surface two triangles share every side: what is left over is as long as the border of its faces."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    key = np.column_stack([mesh.shape, mesh.back, np.round(normal, 3) + 0.0])
    surface = np.unique(key, axis=0, return_inverse=True)[1].ravel()
    # Every surface here is a square or a rectangle of two faces.
    edges = [4 * 2 * 6, 4 * 0.6, 3 * 2 * 0.9 + 2 * 2 * 0.8, 2 * 4 * 0.5, 4 * 0.6]  # the table has five sides
    assert len(mesh.triangles) > len(solution.leaves())
    assert border(mesh.vertices, mesh.triangles, surface) == pytest.approx(sum(edges), rel=1e-3)
    assert (normal * key[:, 2:]).sum(axis=1).min() > 0.99


def test_areas_add_up(solution, mesh):
    lit = mesh.leaf >= 0
    assert mesh.areas()[lit].sum() == pytest.approx(solution.model.patches.total_area, rel=1e-6)
    leaves = solution.leaves()
    np.testing.assert_allclose(np.bincount(mesh.leaf[lit], mesh.areas()[lit]), leaves.area, rtol=1e-4)
    assert (leaves.shape[mesh.leaf[lit]] == mesh.shape[lit]).all()
    assert (leaves.back[mesh.leaf[lit]] == mesh.back[lit]).all()


def test_triangles_face_their_light(solution, mesh):
    """Their order of corners is that of the lit side."""
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    leaf = np.array(solution.elements.leaves)[mesh.leaf]
    patch = np.array(solution.elements.patch)[leaf]
    normal = np.array(solution.model.patches.normal).T[patch]
    assert (np.cross(b - a, c - a) * normal).sum(axis=1)[mesh.leaf >= 0].min() > 0


def test_a_constant_light_stays_constant(solution):
    n = len(solution.elements)
    even = replace(solution, direct=dr.full(mi.Color3f, 1, n), indirect=dr.full(mi.Color3f, 2, n))
    mesh = lit_mesh(even)
    np.testing.assert_allclose(mesh.direct, 1, rtol=1e-5)
    np.testing.assert_allclose(mesh.irradiance, 3, rtol=1e-5)
    np.testing.assert_allclose(mesh.radiosity, mesh.emission + 3 * mesh.reflectance, rtol=1e-5)


def test_mean_light_is_that_of_the_solution(solution, mesh):
    """The mean irradiance of every shape, where nothing covers it, to 3 %."""
    leaves = solution.leaves()
    H = mesh.irradiance[mesh.triangles].mean(axis=1)
    for shape in (0, 3, 4):
        ours = np.average(H[mesh.shape == shape], axis=0, weights=mesh.areas()[mesh.shape == shape])
        its = np.average(
            leaves.irradiance[leaves.shape == shape], axis=0, weights=leaves.open_area[leaves.shape == shape]
        )
        np.testing.assert_allclose(ours, its, rtol=0.03)


def test_dark_faces_stay():
    """A box in a box: no light comes between them, and still something is there."""
    inner = {"type": "cube", "to_world": T().scale(0.5), "flip_normals": True, "bsdf": diffuse()}
    bulb = rectangle(T().scale(0.1), bsdf=diffuse(), emitter=lamp())
    solution = mr.solve(scene(optimize=False, inner=inner, bulb=bulb, outer={"type": "cube"}), elements=100, rays=5000)
    mesh = lit_mesh(solution)
    dark = mesh.leaf < 0
    assert mesh.areas()[dark].sum() == pytest.approx(24) and mesh.radiosity[mesh.triangles[dark]].max() == 0


def test_other_mitsuba_shows_the_same(solution, tmp_path):
    """`path` of the .xml equals our picture: RMSE below 1.5 of 255, noise of both included."""
    export(solution, tmp_path / "room.xml")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["room.xml", "room_mesh.ply"]
    glowing = mi.load_file(str(tmp_path / "room.xml"))
    path = mi.load_dict({"type": "path", "max_depth": -1})
    ours, its = (np.array(x) for x in (solution.render(spp=64), mi.render(glowing, integrator=path, spp=64)))
    difference = srgb(ours) - srgb(its)
    assert ours.shape == its.shape and np.sqrt((difference**2).mean()) < 1.5 and abs(difference.mean()) < 0.2


def test_without_this_package(solution, tmp_path):
    """A plain Mitsuba, in a variant without Dr.Jit: its mean is ours, to 2 %."""
    export(solution, tmp_path / "room.xml")
    code = f"""import mitsuba as mi, numpy
mi.set_variant("scalar_rgb")
print(numpy.array(mi.render(mi.load_file(r"{tmp_path / "room.xml"}"), spp=16)).mean())"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=100)
    assert run.returncode == 0, run.stderr
    assert float(re.findall(r"[\d.]+", run.stdout)[-1]) == pytest.approx(
        np.array(solution.render(spp=64)).mean(), rel=0.02
    )


def test_ply(solution, mesh, tmp_path):
    """trimesh reads positions, colours and light; Mitsuba reads the light."""
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh: pip install 'mi_radiosity[test]'")
    export(solution, tmp_path / "room.ply", exposure=0.5)
    read = trimesh.load(tmp_path / "room.ply", process=False)
    assert len(read.faces) == len(mesh.triangles) and read.area == pytest.approx(mesh.areas().sum(), rel=1e-5)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(read.visual.vertex_colors[:, :3], srgb(mesh.radiosity / np.pi / 2), atol=0.51)
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(data["irradiance_g"].ravel(), mesh.irradiance[:, 1], rtol=1e-6)
    np.testing.assert_array_equal(read.metadata["_ply_raw"]["face"]["data"]["leaf"].ravel(), mesh.leaf)
    shape = mi.load_dict({"type": "ply", "filename": str(tmp_path / "room.ply")})
    light = np.array(mi.traverse(shape)["vertex_radiosity_color"]).reshape(-1, 3)
    np.testing.assert_allclose(light, mesh.radiosity, rtol=1e-6)


def test_glb(solution, mesh, tmp_path):
    """trimesh reads it: shapes by name, +y up, and the light; colours are radiance times the exposure."""
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh: pip install 'mi_radiosity[test]'")
    gltf = pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
    export(solution, tmp_path / "room.glb", exposure=0.05)
    read = trimesh.load(tmp_path / "room.glb")
    assert {"walls", "lamp", "table", "sheet", "rug"} <= {re.sub(r"_\d+$", "", name) for name in read.geometry}
    assert sum(len(part.faces) for part in read.geometry.values()) == len(mesh.triangles)
    light = np.concatenate([part.vertex_attributes["_RADIOSITY"] for part in read.geometry.values()])
    assert light.max() == pytest.approx(mesh.radiosity.max(), rel=1e-6)
    file = gltf.GLTF2().load(str(tmp_path / "room.glb"))
    assert file.extras["exposure"] == 0.05 and file.extensionsUsed == ["KHR_materials_unlit"]
    for mesh_ in file.meshes:
        for primitive in mesh_.primitives:
            color, radiosity = (values(file, getattr(primitive.attributes, n)) for n in ("COLOR_0", "_RADIOSITY"))
            np.testing.assert_allclose(color[:, :3] / 65535, np.clip(radiosity * 0.05 / np.pi, 0, 1), atol=1e-4)


def values(file, number):
    """What an accessor of a glTF file holds."""
    accessor = file.accessors[number]
    view, kind = file.bufferViews[accessor.bufferView], {5126: "<f4", 5123: "<u2"}[accessor.componentType]
    data = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    return np.frombuffer(data, kind).reshape(accessor.count, -1)


@pytest.fixture(scope="module")
def checkered():
    """A floor with a texture, under a lamp."""
    board = {"type": "checkerboard", "color0": 0.1, "color1": 0.8, "to_uv": mi.ScalarTransform3f().scale([3, 3])}
    return mr.solve(
        scene(
            optimize=False,
            floor=rectangle(bsdf={"type": "diffuse", "reflectance": board}),
            lamp=rectangle(T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(0.5), bsdf=diffuse(), emitter=lamp()),
        ),
        elements=400,
        rays=100_000,
    )


def test_textures_stay_sharp(checkered, tmp_path):
    """The texture is the base colour, the light is in the vertices."""
    gltf = pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
    mesh = lit_mesh(checkered)
    (picture,) = textures(mesh, checkered.model.faces.parts).values()
    rows = picture.image[[-1 - 512 // 12, 512 // 12]][:, 512 // 12, 0]  # the middle of two cells at the left border
    np.testing.assert_allclose(rows, [0.8, 0.1], atol=1e-6) if rows[0] > 0.5 else np.testing.assert_allclose(
        rows, [0.1, 0.8], atol=1e-6
    )
    export(checkered, tmp_path / "floor.glb", exposure=2)
    file = gltf.GLTF2().load(str(tmp_path / "floor.glb"))
    (textured,) = (p for m in file.meshes for p in m.primitives if p.attributes.TEXCOORD_0 is not None)
    color, H = (values(file, getattr(textured.attributes, n)) for n in ("COLOR_0", "_IRRADIANCE"))
    np.testing.assert_allclose(color[:, :3] / 65535, H * 0.8 * 2 / np.pi, atol=1e-4)
    point, place = (values(file, n) for n in (textured.attributes.POSITION, textured.attributes.TEXCOORD_0))
    np.testing.assert_allclose(place, np.column_stack([point[:, 0] + 1, 1 - point[:, 1]]) / 2, atol=1e-5)


def test_gltf_validator(solution, checkered, tmp_path):
    """Neither errors nor warnings."""
    pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
    if not shutil.which("node") or not (ASSETS / "node_modules/gltf-validator").is_dir():
        pytest.skip(f"needs Node.js and `npm ci` in {ASSETS}")
    for name, each in (("room", solution), ("floor", checkered)):
        export(each, tmp_path / f"{name}.glb", exposure="auto")
    files = [str(tmp_path / "room.glb"), str(tmp_path / "floor.glb")]
    run = subprocess.run(["node", str(ASSETS / "validate.js"), *files], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr


def test_auto_exposure(solution, mesh):
    """98 % of what is no lamp is not clipped."""
    from mi_radiosity.export.tone import exposure_of

    bright = (mesh.radiosity / np.pi).max(axis=1)[mesh.triangles].max(axis=1) * exposure_of(mesh, "auto")
    area = np.where(mesh.emission.max(axis=1)[mesh.triangles].max(axis=1) > 0, 0, mesh.areas())
    assert 0.975 < area[bright <= 1.0001].sum() / area.sum() < 0.99


# ---- Command line ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A solution and its scene, kept by the command line."""
    folder = tmp_path_factory.mktemp("kept")
    file, text = folder / "box.xml", Path("scenes_xml/box_furnace.xml").read_text()
    file.write_text(text.replace('value="0.5"/></bsdf>', 'value="$rho"/></bsdf>'))
    render = ["render", str(file), "-o", str(folder / "box.png"), "--save", str(folder / "box.npz"), "-D", "rho=0.25"]
    assert main([*render, "--elements", "200", "--rays", "9000", "--spp", "1"]) == 0
    return folder


def test_export_knows_the_scene(kept, tmp_path, capsys):
    out = tmp_path / "box.ply"
    assert main(["export", str(kept / "box.npz"), "-o", str(out)]) == 0
    assert str(out) in capsys.readouterr().out and out.read_bytes().startswith(b"ply\n")
    for folder in (tmp_path / "moved", tmp_path / "alone"):
        folder.mkdir()
        shutil.copy(kept / "box.npz", folder)
    (kept / "box.xml").rename(tmp_path / "moved/box.xml")  # beside the solution, as before
    try:
        assert main(["export", str(tmp_path / "moved/box.npz"), "-o", str(out)]) == 0
        assert main(["export", str(tmp_path / "alone/box.npz"), "-o", str(out)]) == 2
        assert "box.xml" in (message := capsys.readouterr().err) and "gone" in message and "--scene" in message
        given = ["--scene", str(tmp_path / "moved/box.xml")]
        assert main(["export", str(tmp_path / "alone/box.npz"), *given, "-o", str(out)]) == 0
        assert main(["export", str(tmp_path / "alone/box.npz"), *given, "-o", str(out), "-D", "rho=0.3"]) == 2
        assert "another scene" in capsys.readouterr().err
    finally:
        (tmp_path / "moved/box.xml").rename(kept / "box.xml")


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["-o", "x.obj"], ".ply, .glb, .xml"),
        (["-o", "nowhere/x.ply"], "does not exist"),
        (["-o", "x.ply", "--exposure", "0"], "greater than 0"),
        (["-o", "x.ply", "--exposure", "bright"], "'auto' or a number"),
        (["-o", "x.xml", "--exposure", "auto"], "holds light"),
        (["-o", "x.ply", "--seed", "0"], "--lightmap"),
        (["-o", "x.ply", "--scene", "none.xml"], "none.xml does not exist"),
        ([], "-o"),
    ],
)
def test_export_errors_are_one_line(kept, arguments, says, tmp_path, capsys):
    arguments = [str(tmp_path / a) if a.startswith(("x.", "nowhere/")) else a for a in arguments]
    assert main(["export", str(kept / "box.npz"), *arguments]) == 2
    message = capsys.readouterr().err
    assert says in message and message.count("\n") == 1 and list(tmp_path.iterdir()) == []


def test_solutions_that_do_not_say(solution, tmp_path, capsys):
    solution.save(tmp_path / "room.npz")
    assert mr.Solution.source_of(tmp_path / "room.npz") is None
    assert main(["export", str(tmp_path / "room.npz"), "-o", str(tmp_path / "x.ply")]) == 2
    assert "--scene" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "none.npz"), "-o", str(tmp_path / "x.ply")]) == 2
    assert "does not exist" in capsys.readouterr().err
    source = {"path": "room.xml", "variant": "llvm_ad_rgb", "definitions": [], "plugins": []}
    solution.save(tmp_path / "room.npz", source)
    assert mr.Solution.source_of(tmp_path / "room.npz") == json.loads(json.dumps(source))


def test_progress(solution, tmp_path):
    calls = []
    export(solution, tmp_path / "x.ply", progress=lambda *call: calls.append(call))
    assert calls[0] == ("export", 0, 2) and calls[-1] == ("export", 2, 2)
