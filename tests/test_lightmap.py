"""Lightmaps: their light against what is gathered, walls, furniture, seams, and the programs that read them."""

import shutil
import subprocess
from pathlib import Path

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.export.atlas import face_of, nearest, on_surface, unwrap, whole
from mi_radiosity.export.dividing import split
from mi_radiosity.export.lightmap import fill, lightmap
from mi_radiosity.export.lightmap_files import export_lightmap
from mi_radiosity.export.seams import bilinear, level_seams, seam_samples

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, icosphere, lamp, rectangle, scene

pytest.importorskip("xatlas", reason="needs xatlas: pip install 'mi_radiosity[export]'")
pytestmark = pytest.mark.fast
T = mi.ScalarTransform4f
ASSETS = Path("mi_radiosity/export/assets")


@pytest.fixture(scope="module")
def solution(cornell):
    return mr.solve(cornell, elements=4000, rays=1_500_000)


@pytest.fixture(scope="module")
def baked(solution):
    return lightmap(solution, 96, samples=64)


def shown(model, texels, n=4000):
    """Random places on the surface: points and normals [n, 3], and what a filter shows there [n, 3]."""
    atlas, rng = texels.atlas, np.random.default_rng(0)
    area = atlas.texel_area(model) * np.abs(np.linalg.det(atlas.place[:, 1:] - atlas.place[:, :1])) / 2
    piece = rng.choice(len(area), n, p=area / area.sum())
    weight = rng.dirichlet((1, 1, 1), n)
    points, normals, _, _ = on_surface(model, atlas, piece, weight)
    texel, share = bilinear(np.einsum("nk,nkc->nc", weight, atlas.place[piece]), atlas.size)
    light = texels.irradiance.reshape(-1, 3)[texel]
    return points, normals, (share[..., None] * light).sum(axis=1)


# ---- Light -----------------------------------------------------------------------------------------


def test_mean_is_that_of_the_solution(solution, baked):
    """The area mean of H, within 0.3 % and what the gathering states as its error."""
    leaves = solution.leaves()
    exact = np.average(leaves.irradiance, weights=leaves.open_area, axis=0)
    weight = baked.area / baked.area.sum()
    error = np.sqrt(((weight[..., None] * baked.error) ** 2).sum(axis=(0, 1)))
    assert (np.abs(baked.mean() - exact) < 3 * error + 0.003 * exact).all()
    assert baked.area.sum() == pytest.approx(leaves.open_area.sum(), rel=0.01)


def test_texels_are_gathered_where_they_lie(solution, baked):
    """What a filter shows at random points is their irradiance, but for noise, shadows' edges, and a texel's width."""
    points, normals, found = shown(solution.model, baked, 1000)
    exact = solution.irradiance(points, normals, samples=512)
    off = np.abs(found - exact) / (exact + 0.05 * exact.mean())
    assert np.median(off) < 0.05 and (off < 0.5).all(axis=1).mean() > 0.95


def test_a_wall_without_thickness_keeps_its_dark_side_black():
    """A room divided by a sheet: exactly 0 behind it wherever a filter looks, light right in front of it."""
    turn = T().rotate([0, 0, 1], 20)
    parts = scene(
        optimize=False,
        room={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.8), "to_world": turn},
        wall=rectangle(
            turn.translate([0.13, 0, 0]).rotate([0, 1, 0], 90).scale(1.1), bsdf=diffuse(0.8, two_sided=True)
        ),
        light=rectangle(
            turn.translate([0.5, 0, 0.9]).rotate([1, 0, 0], 180).scale(0.2), bsdf=diffuse(0), emitter=lamp(9)
        ),
    )
    solution = mr.solve(parts, elements=2000, rays=200_000)
    texels = lightmap(solution, 96, samples=32)
    points, normals, light = shown(solution.model, texels)
    axis = np.array([np.cos(np.radians(20)), np.sin(np.radians(20)), 0])
    x, facing = points @ axis - 0.13, normals @ axis
    inside = np.abs(points @ [[axis[0], -axis[1]], [axis[1], axis[0]], [0, 0]]).max(axis=1) < 1.001
    inside &= np.abs(points[:, 2]) < 1.001  # the sheet stands out of the room
    dark = inside & ((x < -1e-3) | ((np.abs(x) < 1e-3) & (facing < 0)))
    lit = inside & ((x > 1e-3) | ((np.abs(x) < 1e-3) & (facing > 0)))
    assert dark.sum() > 1000 and light[dark].max() == 0
    assert lit.sum() > 500 and light[lit].min() > 0.05


def test_furniture_does_not_darken_the_floor_around_it():
    """Texels under a box take the light around it: right beside it the floor is as bright as it is gathered there."""
    parts = scene(
        optimize=False,
        room={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.7), "emitter": lamp()},
        box={
            "type": "cube",
            "to_world": T().translate([0.013, 0.027, -0.8]).scale([0.4, 0.4, 0.2]),
            "bsdf": diffuse(0.7),
        },
    )
    solution = mr.solve(parts, elements=2000, rays=400_000)
    texels = lightmap(solution, 64, samples=64)
    points, normals, found = shown(solution.model, texels, 30_000)
    away = np.maximum(np.abs(points[:, 0] - 0.013), np.abs(points[:, 1] - 0.027)) - 0.4
    beside = (points[:, 2] < -0.999) & (away > 0.001) & (away < 1.5 / texels.atlas.per_metre)
    exact = solution.irradiance(points[beside], normals[beside], samples=128)
    assert beside.sum() > 100 and np.median(found[beside] / exact) == pytest.approx(1, abs=0.05)
    assert (found[beside] / exact).min() > 0.75


def smooth_ball():
    """A ball with vertex normals."""
    vertices, faces = icosphere(2, inwards=False)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(diffuse(0.5))
    ball = mi.Mesh("ball", len(vertices), len(faces), has_vertex_normals=True, props=properties)
    params = mi.traverse(ball)
    params["vertex_positions"] = params["vertex_normals"] = vertices.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return ball


def test_seams_of_a_smooth_surface_do_not_show():
    parts = scene(
        ball=smooth_ball(),
        light=rectangle(T().translate([0, 0, 2]).rotate([1, 0, 0], 180), bsdf=diffuse(0), emitter=lamp()),
    )
    solution = mr.solve(parts, elements=1500, rays=100_000)
    texels = lightmap(solution, 64, samples=32)
    a, b = seam_samples(solution.model, texels.atlas)

    def gap(values):
        light = values.reshape(-1, 3)
        return np.sqrt((np.subtract(*((w[..., None] * light[i]).sum(axis=1) for i, w in (a, b))) ** 2).mean())

    noise = np.random.default_rng(0).uniform(0.5, 1.5, texels.irradiance.shape)
    assert len(a[0]) > 20 and gap(noise) > 0.2
    assert gap(level_seams(solution.model, texels.atlas, noise, texels.open)) < 0.2 * gap(noise)
    assert gap(texels.irradiance) < 0.01 * texels.irradiance.max()


def test_denoising_keeps_the_mean_and_the_dark(solution):
    pytest.importorskip("mitsuba_oidn", reason="needs mitsuba-oidn: pip install 'mi_radiosity[denoise]'")
    exact, rough, smooth = (lightmap(solution, 64, n, denoise=d) for n, d in ((1024, False), (16, False), (16, True)))

    def rms(texels):
        return np.sqrt((((texels.irradiance - exact.irradiance)[texels.open]) ** 2).mean())

    assert rms(smooth) < 0.8 * rms(rough) and smooth.mean() == pytest.approx(exact.mean(), rel=0.02)


# ---- Parts -----------------------------------------------------------------------------------------


def test_charts_fit_and_do_not_touch(solution):
    atlas = unwrap(solution.model, whole(solution.model), 64)
    assert atlas.place.min() >= 0 and atlas.place.max() <= 64 and (atlas.chart >= 0).all()
    assert atlas.texel_area(solution.model) == pytest.approx(atlas.per_metre**-2, rel=0.4)
    with pytest.raises(mr.RadiosityError, match="larger size"):
        unwrap(solution.model, whole(solution.model), 8)


def test_points_nearest_to_others():
    rng = np.random.default_rng(0)
    triangles, points = rng.uniform(size=(200, 3, 2)), rng.uniform(-1, 2, size=(200, 2))
    weight, inside = nearest(triangles, points)
    assert weight.min() > -1e-12 and weight.sum(axis=1) == pytest.approx(1)
    found = np.linalg.norm(np.einsum("nk,nkc->nc", weight, triangles) - points, axis=1)
    tries = rng.dirichlet((0.5, 0.5, 0.5), 4000)
    others = np.linalg.norm(np.einsum("mk,nkc->nmc", tries, triangles) - points[:, None], axis=2).min(axis=1)
    assert (found <= others + 1e-9).all() and (found > others - 0.05).all()
    assert (found[inside] < 1e-9).all() and (found[~inside] > 0).all()


def test_split_triangles_cover_what_they_are_made_of():
    rng = np.random.default_rng(1)
    height = rng.normal(size=(300, 3)).round(0)
    index, corners = split(height, 1e-6)
    share = np.abs(np.linalg.det(corners))
    assert np.bincount(index, share) == pytest.approx(1) and share.min() > 1e-9
    parts = np.einsum("nkc,nc->nk", corners, height[index])
    assert ((parts.max(axis=1) < 1e-9) | (parts.min(axis=1) > -1e-9)).all()


def test_fill_goes_no_further_than_it_must():
    known = np.zeros((12, 12), dtype=bool)
    chart = np.full((12, 12), -1)
    chart[4:8, 4:8], known[4:8, 4:6] = 0, True
    values = fill(known[..., None] * 1.0, known, chart)[..., 0]
    assert (values[4:8, 4:8] == 1).all() and (values[2:10, 2:10] == 1).all()
    values[2:10, 2:10] = 0
    assert (values == 0).all()


# ---- Files -----------------------------------------------------------------------------------------


def test_exr_holds_the_irradiance(solution, tmp_path):
    found = export_lightmap(solution, tmp_path / "light.exr", 32, samples=16)
    assert np.array(mi.Bitmap(str(tmp_path / "light.exr"))) == pytest.approx(found.irradiance, rel=1e-3, abs=1e-4)


def test_lightmap_is_a_second_texture(solution, tmp_path):
    gltf = pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
    path = tmp_path / "box.glb"
    found = export_lightmap(solution, path, 64, samples=16)
    file = gltf.GLTF2().load(str(path))
    light = file.materials[0].extensions["MOZ_lightmap"]
    assert light["texCoord"] == 1 and light["intensity"] == pytest.approx(found.irradiance[found.open].max(), rel=0.5)
    assert all(p.attributes.TEXCOORD_1 is not None for m in file.meshes for p in m.primitives)
    assert any(m.emissiveFactor and max(m.emissiveFactor) > 0 for m in file.materials)
    view = file.bufferViews[file.images[file.textures[light["index"]].source].bufferView]
    (tmp_path / "light.png").write_bytes(file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength])
    pixels = np.array(mi.Bitmap(str(tmp_path / "light.png"))) / 255 * light["intensity"]
    assert pixels[found.open].mean() == pytest.approx(found.irradiance[found.open].mean(), rel=0.01)


def test_trimesh_shows_the_unlit_texture(solution, tmp_path):
    """Read by another program, textures at random points of triangles hold B / π there."""
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "box.glb"
    export_lightmap(solution, path, 128, samples=32, unlit=True)
    picture = trimesh.load(path)
    found, exact = [], []
    for node in picture.graph.nodes_geometry:
        transform, name = picture.graph[node]
        geometry = picture.geometry[name]
        points, face = trimesh.sample.sample_surface(geometry, 200, seed=0)
        weight = trimesh.triangles.points_to_barycentric(geometry.triangles[face], points)
        uv = (geometry.visual.uv[geometry.faces[face]] * weight[..., None]).sum(axis=1)
        image = np.asarray(geometry.visual.material.baseColorTexture.convert("RGB"), dtype=float) / 255
        texel, share = bilinear(np.column_stack([uv[:, 0], 1 - uv[:, 1]]) * len(image), len(image))
        linear = np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).reshape(-1, 3)
        found.append((share[..., None] * linear[texel]).sum(axis=1))
        world = trimesh.transform_points(points, transform)
        exact.append(solution.radiosity(world, geometry.face_normals[face] @ transform[:3, :3].T) / np.pi)
    off = np.abs(np.concatenate(found) - np.clip(np.concatenate(exact), 0, 1)).max(axis=1)
    assert np.median(off) < 0.01 and np.mean(off > 0.1) < 0.05


def test_gltf_validator(solution, tmp_path):
    pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
    if not shutil.which("node") or not (ASSETS / "node_modules/gltf-validator").is_dir():
        pytest.skip("needs node and gltf-validator: npm ci in mi_radiosity/export/assets")
    for name, unlit in (("lit.glb", False), ("unlit.glb", True)):
        export_lightmap(solution, tmp_path / name, 32, samples=16, unlit=unlit)
        run = subprocess.run(
            ["node", str(ASSETS / "validate.js"), str(tmp_path / name)], capture_output=True, text=True, timeout=60
        )
        assert run.returncode == 0, run.stdout


def test_textures_are_in_the_base_colour(tmp_path):
    gltf = pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
    checks = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": T().scale([2, 2, 1])}}
    light = rectangle(T().translate([0, 0, 1]).rotate([1, 0, 0], 180), bsdf=diffuse(0), emitter=lamp())
    parts = scene(optimize=False, floor=rectangle(bsdf=checks), light=light)
    solution = mr.solve(parts, mr.Uniform(), elements=100, rays=20_000)
    found = export_lightmap(solution, tmp_path / "floor.glb", 64, samples=16)
    floor = found.atlas.chart[solution.model.faces.shape[face_of(solution.model, found.atlas.pieces.patch)] == 0]
    assert len(set(floor)) == 1 and sorted(np.unique(found.reflectance[found.open].round(2)))[-1] == 0.4
    file = gltf.GLTF2().load(str(tmp_path / "floor.glb"))
    assert sum(m.pbrMetallicRoughness.baseColorTexture is not None for m in file.materials) == 1


@pytest.mark.parametrize(
    "arguments, says",
    [
        (["-o", "x.png", "--lightmap", "64"], ".exr or .glb"),
        (["-o", "x.exr", "--lightmap", "64", "--unlit"], "--unlit belongs to"),
        (["-o", "x.exr", "--lightmap", "4"], "choose 16 to"),
        (["-o", "x.exr", "--lightmap", "64", "--samples", "0"], "greater than 0"),
        (["-o", "x.exr", "--lightmap", "big"], "not a whole number"),
        (["-o", "nowhere/x.exr", "--lightmap", "64"], "nowhere does not exist"),
        (["-o", "x.glb", "--lightmap", "64", "--exposure", "-1"], "exposure"),
        (["-o", "x.exr", "--lightmap", "64", "--exposure", "2"], "holds light"),
        (["-o", "x.glb", "--denoise"], "add --lightmap SIZE"),
    ],
)
def test_one_line_errors(arguments, says, capsys, tmp_path):
    kept = tmp_path / "box.npz"
    if not kept.exists():
        mr.solve(mi.load_file("scenes_xml/box_furnace.xml"), elements=100, rays=2000).save(kept)
    assert main(["export", str(kept), "--scene", "scenes_xml/box_furnace.xml", *arguments]) == 2
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1


def test_command(tmp_path, capsys):
    kept = tmp_path / "box.npz"
    mr.solve(mi.load_file("scenes_xml/box_furnace.xml"), elements=100, rays=50_000).save(kept)
    arguments = ["export", str(kept), "--scene", "scenes_xml/box_furnace.xml", "-o", str(tmp_path / "box.exr")]
    assert main([*arguments, "--lightmap", "32", "--samples", "16"]) == 0
    assert "rays" in capsys.readouterr().out and (tmp_path / "box.exr").exists()
