"""Exports hold the colours that surfaces have, or name the shape whose colours they do not hold."""

import re
import warnings

import mi_radiosity as mr
from mi_radiosity.export import export, lightmap, lit_mesh, write_page
from mi_radiosity.export.page import page
from mi_radiosity.export.textures import textures

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
COLORS = np.array([[0.9, 0.1, 0.2], [0.1, 0.8, 0.3], [0.2, 0.3, 0.7], [0.6, 0.6, 0.1]])  # of corners, or of faces
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


def attribute(name):
    return {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": name}}


def colored(name, bsdf=None, values=COLORS):
    """A square of two triangles with colours of its four corners, or of its faces."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf or attribute(name))
    shape = mi.Mesh("scan", 4, 2, props=properties, has_vertex_texcoords=True)
    params = mi.traverse(shape)
    params["vertex_positions"] = SQUARE.astype(np.float32).ravel()
    params["vertex_texcoords"] = ((SQUARE[:, :2] + 1) / 2).astype(np.float32).ravel()
    params["faces"] = np.uint32([0, 1, 2, 0, 2, 3])
    params.update()
    values = values if name.startswith("vertex_") else values[:2]
    shape.add_attribute(name, 3, values.astype(np.float32).ravel())
    return shape


def lit(**shapes):
    down = T().translate([0.3, 0, 2]).rotate([1, 0, 0], 180).scale(0.5)
    bulb = rectangle(down, bsdf=diffuse(0.2), emitter=lamp(4))
    return mr.solve(scene(optimize=False, **{"bulb": bulb} | shapes), elements=300, rays=60_000)


def of_points(points, values, by_face):
    """Colours at points of the square: by barycentric interpolation between corners, or of the face."""
    x, y = points[:, 0], points[:, 1]
    lower = x >= y  # triangle 0, 1, 2; the diagonal is on both
    if by_face:
        return np.where(lower[:, None], values[0], values[1])
    first = np.column_stack([(1 - x) / 2, (x - y) / 2, (1 + y) / 2])
    second = np.column_stack([(1 - y) / 2, (1 + x) / 2, (y - x) / 2])
    return np.where(lower[:, None], first @ values[[0, 1, 2]], second @ values[[0, 2, 3]])


def number_of(solution, name):
    return next(k for k, part in enumerate(solution.model.faces.parts) if part.shape.id() == name)


def told(write, *arguments):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        write(*arguments)
    return [str(warning.message) for warning in caught if issubclass(warning.category, mr.RadiosityWarning)]


@pytest.mark.parametrize("two_sided", [False, True])
@pytest.mark.parametrize("name", ["vertex_color", "face_tint"])
def test_colors_of_vertices_and_faces(name, two_sided, tmp_path):
    """ρ at every vertex of the exported mesh is the attribute there; faces keep their colour up to their edges."""
    bsdf = {"type": "twosided", "bsdf": attribute(name)} if two_sided else attribute(name)
    solution = lit(scan=colored(name, bsdf))
    mesh = lit_mesh(solution)
    chosen = mesh.shape == number_of(solution, "scan")
    middle = mesh.vertices[mesh.triangles[chosen]].mean(axis=1)  # tells the two faces apart at their diagonal
    corners = mesh.vertices[mesh.triangles[chosen]]
    inside = corners + 1e-6 * (middle[:, None] - corners)
    want = of_points(inside.reshape(-1, 3), COLORS, name.startswith("face_"))
    have = mesh.reflectance[mesh.triangles[chosen]].reshape(-1, 3)
    np.testing.assert_allclose(have, want, atol=1e-3)
    assert textures(mesh, solution.model.faces.parts) == {} and np.isnan(mesh.uv).all()
    for file in ("x.ply", "x.xml", "x.html"):
        assert told(write_page if file.endswith("html") else export, solution, tmp_path / file) == []


def test_colors_of_vertices_in_glb_and_page(tmp_path):
    """COLOR_0 is ρ H / π; the page has no texture, and its mean reflectance is that of the attribute."""
    gltf = pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
    solution = lit(scan=colored("vertex_color"))
    assert told(export, solution, tmp_path / "x.glb", 0.5) == []
    file = gltf.GLTF2().load(str(tmp_path / "x.glb"))
    part = next(m for m in file.meshes if m.name == "scan").primitives[0]

    def values(number, kind):
        view = file.bufferViews[file.accessors[number].bufferView]
        data = file.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        return np.frombuffer(data, kind).reshape(file.accessors[number].count, -1)

    color, H = values(part.attributes.COLOR_0, "<u2")[:, :3] / 65535, values(part.attributes._IRRADIANCE, "<f4")
    point = values(part.attributes.POSITION, "<f4")
    assert part.attributes.TEXCOORD_0 is None and point.shape[0] > 20
    (turn,) = (node.rotation for node in file.nodes if node.name == "mi_radiosity")
    assert turn[3] == pytest.approx(1)  # the camera's up is +y already
    np.testing.assert_allclose(color, of_points(point, COLORS, False) * H * 0.5 / np.pi, atol=2e-3)
    assert '"textures":[]' in page(solution)


def test_instances_keep_their_colors():
    """A member of a shape group, turned and moved: its attribute comes along."""
    group = {"type": "shapegroup", "scan": colored("vertex_color")}
    move = T().translate([0, 0, 0.2]).rotate([0, 0, 1], 90).scale(0.5)
    copy = {"type": "instance", "to_world": move, "group": {"type": "ref", "id": "group"}}
    solution = lit(group=group, copy=copy)
    mesh = lit_mesh(solution)
    points = (mesh.vertices - [0, 0, 0.2]) @ np.linalg.inv(np.array(move.matrix)[:3, :3]).T
    chosen = np.unique(mesh.triangles[mesh.shape == number_of(solution, "scan")])
    assert len(chosen) > 4
    np.testing.assert_allclose(mesh.reflectance[chosen], of_points(points[chosen], COLORS, False), atol=2e-3)


def bitmap(values, **more):
    array = np.ascontiguousarray(values, dtype=np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(array), "raw": True, "filter_type": "nearest", **more}


def test_textures_under_a_transform_stay_sharp():
    """A board of 60 × 40 cells: most pixels have one of its two colours, and each colour has half of the area."""
    board = {"type": "checkerboard", "color0": 0.1, "color1": 0.8, "to_uv": mi.ScalarTransform3f().scale([30, 20])}
    solution = lit(floor=rectangle(bsdf={"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": board}}))
    picture = textures(lit_mesh(solution), solution.model.faces.parts)
    image = picture[number_of(solution, "floor"), False].image[..., 0]
    pure = np.isclose(image, 0.1, atol=1e-4) | np.isclose(image, 0.8, atol=1e-4)
    assert image.shape >= (640, 960) and pure.mean() > 0.9 and image.mean() == pytest.approx(0.45, abs=0.01)


def test_blends_of_bitmaps_are_one_texture():
    """The mean of the picture is that of the two bitmaps and the weight (own arithmetic)."""
    rng = np.random.default_rng(0)
    a, b, w = rng.uniform(0.1, 0.9, (8, 8, 3)), rng.uniform(0.1, 0.9, (8, 8, 3)), rng.uniform(0, 1, (8, 8, 1))
    parts = {"a": {"type": "diffuse", "reflectance": bitmap(a)}, "b": {"type": "diffuse", "reflectance": bitmap(b)}}
    solution = lit(floor=rectangle(bsdf={"type": "blendbsdf", "weight": bitmap(w), **parts}))
    picture = textures(lit_mesh(solution), solution.model.faces.parts)[number_of(solution, "floor"), False]
    np.testing.assert_allclose(picture.image.mean(axis=(0, 1)), ((1 - w) * a + w * b).mean(axis=(0, 1)), rtol=0.01)


NOISE = np.random.default_rng(1).uniform(0.1, 0.9, (16, 16, 3))
TEXTURED = {"type": "diffuse", "reflectance": bitmap(NOISE)}
GLOSSY = {"type": "plastic", "diffuse_reflectance": bitmap(NOISE)}
GLOW = {"type": "area", "radiance": bitmap(NOISE)}
HUGE = {"type": "diffuse", "reflectance": bitmap(NOISE, to_uv=mi.ScalarTransform3f().scale([400, 1]))}
SPACE = {"type": "diffuse", "reflectance": {"type": "volume", "volume": {"type": "gridvolume", "raw": True}}}
LOST = {  # shape: what is lost in .glb and page, and in .ply and .xml
    "textured": (rectangle(bsdf=TEXTURED), [], ["at the vertices"]),
    "masked": (
        rectangle(bsdf={"type": "mask", "opacity": 0.5, "bsdf": TEXTURED}),
        ["diffuse lobe only", "means of its texture"],
        ["diffuse lobe only", "means of its texture"],
    ),
    "glossy": (rectangle(bsdf=GLOSSY), ["diffuse lobe", "means of its"], ["diffuse lobe", "means of its"]),
    "mirror": (rectangle(bsdf={"type": "conductor"}), ["diffuse lobe only"], ["diffuse lobe only"]),
    "glowing": (rectangle(bsdf=diffuse(), emitter=GLOW), ["emission's texture"], ["emission's texture"]),
    "sign": (rectangle(bsdf=TEXTURED, emitter=lamp(2)), ["it emits light"], ["at the vertices"]),
    "tiled": (rectangle(bsdf=HUGE), ["needs 6,400 x 16 pixels"], ["at the vertices"]),
    "mixed": (
        colored("vertex_color", {"type": "blendbsdf", "weight": 0.5, "a": attribute("vertex_color"), "b": TEXTURED}),
        ["at the vertices"],
        ["at the vertices"],
    ),
}


@pytest.mark.parametrize("name", LOST)
def test_what_is_lost_is_told_by_name(name, tmp_path):
    """One line for each loss, naming the shape, and no line of any other shape."""
    shape, in_pictures, at_vertices = LOST[name]
    floor = rectangle(T().translate([0, 0, -1]).scale(3), bsdf=diffuse())
    if isinstance(shape, mi.Mesh):
        shape.set_id(name)
    solution = lit(**{name: shape}, floor=floor)
    files = [("x.ply", at_vertices), ("x.xml", at_vertices), ("x.html", in_pictures), ("x.glb", in_pictures)]
    for file, wanted in files:
        if file == "x.glb":
            pytest.importorskip("pygltflib", reason="needs pygltflib: pip install 'mi_radiosity[export]'")
        lines = told(write_page if file == "x.html" else export, solution, tmp_path / file)
        assert len(lines) == len(wanted), lines
        for line, says in zip(lines, wanted):
            assert line.startswith(f"shape '{name}'") and says in line and "\n" not in line


def test_an_environment_is_told(tmp_path):
    solution = lit(floor=rectangle(bsdf=diffuse()), sky={"type": "constant", "radiance": 1.0})
    (line,) = told(export, solution, tmp_path / "x.xml")
    assert "environment" in line


def test_textures_in_space_are_at_the_vertices(tmp_path):
    """A reflectance that rises along x in space: at every vertex ρ is the ramp (closed form)."""
    grid = np.broadcast_to(np.float32([0.2, 0.8])[None, None, :, None], (2, 2, 2, 1))
    box = T().translate([-2, -1, -1]).scale([4, 2, 2])  # voxel centres at x = −1 and x = 1
    volume = SPACE["reflectance"]["volume"] | {"grid": mi.VolumeGrid(np.ascontiguousarray(grid)), "to_world": box}
    bsdf = {"type": "diffuse", "reflectance": {"type": "volume", "volume": volume}}
    solution = lit(floor=rectangle(bsdf=bsdf))
    mesh = lit_mesh(solution)
    chosen = np.unique(mesh.triangles[mesh.shape == number_of(solution, "floor")])
    want = 0.5 + 0.3 * mesh.vertices[chosen, 0]
    np.testing.assert_allclose(mesh.reflectance[chosen], np.repeat(want[:, None], 3, axis=1), atol=2e-3)
    (line,) = told(export, solution, tmp_path / "x.ply")
    assert re.search("'floor'.*at the vertices", line)


def test_lightmaps_hold_textures_of_emitters_and_albedos_of_lobes():
    """E of texels is that of the texture there; ρ of a plastic is the albedo of its diffuse lobe, 0.455 of 0.5."""
    pytest.importorskip("xatlas", reason="needs xatlas: pip install 'mi_radiosity[export]'")
    halves = np.repeat(np.float32([[[1, 1, 1], [3, 3, 3]]]), 2, axis=0)
    sign = rectangle(bsdf=diffuse(0.3), emitter={"type": "area", "radiance": bitmap(halves)})
    pane = rectangle(T().translate([2.5, 0, 0]), bsdf={"type": "plastic", "diffuse_reflectance": 0.5})
    solution = mr.solve(scene(optimize=False, sign=sign, pane=pane, lid=rectangle(
        T().translate([0, 0, 2]).rotate([1, 0, 0], 180), bsdf=diffuse()
    )), elements=200, rays=20_000)  # fmt: skip
    found = lightmap(solution, 96, 4)
    E = found.emission[found.open].max(axis=1) / np.pi
    shines = E[E > 0]
    assert np.isclose(shines, 1, atol=1e-3).mean() + np.isclose(shines, 3, atol=1e-3).mean() > 0.9
    assert shines.mean() == pytest.approx(2, rel=0.05)
    rho = found.reflectance[found.open].max(axis=1)
    assert (np.abs(rho - 0.455) < 0.02).any() and not (np.abs(rho - 0.45) > 0.3).any()
    assert dr.all(solution.model.patches.reflectance > 0, axis=None)
