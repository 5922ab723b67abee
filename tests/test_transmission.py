"""Light that surfaces transmit diffusely: closed forms, energy, and every way to show and keep it."""

import mi_radiosity as mr
from mi_radiosity.export import lit_mesh
from mi_radiosity.export.geometry import dark_faces
from mi_radiosity.export.page import _data
from mi_radiosity.scene import Model
from mi_radiosity.transport import Shooting

import mitsuba as mi
import numpy as np
import pytest
from conftest import balance, diffuse, lamp, leaf_values, rectangle, scene

pytestmark = pytest.mark.fast
T = mi.ScalarTransform4f
MIRROR = {"type": "conductor", "material": "none"}
BUDGET = {"elements": 300, "rays": 60_000}


def rgb(*color):
    return {"type": "rgb", "value": list(color) if len(color) > 1 else color[0]}


def cloth(color=0.8, diff_trans=2.0, **more):
    """Cloth that, by default, transmits ``color`` of the light, reflects none, and has no specular lobe."""
    color = color if isinstance(color, dict) else rgb(color)
    return {
        "type": "principledthin",
        "base_color": color,
        "diff_trans": diff_trans,
        "roughness": 1.0,
        "eta": 1.01,
    } | more


def pane(rho, tau):
    """A Lambertian BSDF with the reflectance ρ and the transmittance τ on both sides."""
    weight = 1 - tau / 0.95
    return {"type": "blendbsdf", "weight": weight, "a": cloth(0.95), "b": diffuse(rho / weight, two_sided=True)}


def facing(origin, towards, scale=1.0):
    """A square around a point, whose front faces another one."""
    return T().look_at(origin, towards, [0, 0, 1] if abs(towards[2] - origin[2]) < 0.5 else [0, 1, 0]).scale(scale)


def half_rooms(bsdf, walls_a, walls_b, **pane_parts):
    """Two cubes of side 2 with one wall in common, x = 0. walls_a, walls_b: parts of the other walls of each."""
    shapes = {"pane": rectangle(facing([0, 0, 0], [-1, 0, 0]), bsdf=bsdf, **pane_parts)}
    for name, x, walls in (("a", -1, walls_a), ("b", 1, walls_b)):
        for k, (dx, dy, dz) in enumerate([(x, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]):
            shapes[f"{name}{k}"] = rectangle(facing([x + dx, dy, dz], [x, 0, 0]), **walls)
    camera = {
        "type": "perspective",
        "fov": 100,
        "to_world": T().look_at([1.9, 0, 0], [0, 0, 0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb", "rfilter": {"type": "box"}},
    }
    return scene(optimize=False, **shapes, view=camera)


def side_of(solution, shape):
    """Leaves of a shape, front and back (two int arrays)."""
    leaves = solution.leaves()
    number = next(p.number for p in solution.model.faces.parts if p.shape.id() == shape)
    own = leaves.shape == number
    return np.flatnonzero(own & ~leaves.back), np.flatnonzero(own & leaves.back)


# ---- Closed forms ------------------------------------------------------------------------------------


@pytest.mark.parametrize("rho, tau, rho_1, rho_2", [(0.0, 0.8, 0.5, 0.7), (0.3, 0.5, 0.8, 0.2), (0.18, 0.72, 0.8, 0.9)])
def test_a_pane_between_parallel_plates(rho, tau, rho_1, rho_2):
    """Plates between mirrors are infinite.

    B_1 = E + ρ_1 B_a, B_2 = ρ_2 B_b, B_a = ρ B_1 + τ B_2, B_b = ρ B_2 + τ B_1.
    """
    walls = {
        f"mirror{k}": rectangle(facing([x, y, 0], [0, 0, 0]), bsdf=MIRROR)
        for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)])
    }
    room = scene(
        optimize=False,
        one=rectangle(facing([0, 0, -0.5], [0, 0, 0]), bsdf=diffuse(rho_1), emitter=lamp(2.0)),
        two=rectangle(facing([0, 0, 0.5], [0, 0, 0]), bsdf=diffuse(rho_2)),
        pane=rectangle(facing([0, 0, 0], [0, 0, -1]), bsdf=pane(rho, tau)),
        **walls,
    )
    solution = mr.solve(room, elements=100, rays=400_000)
    # H_a = B_1 and H_b = B_2.
    B_1, B_2 = np.linalg.solve([[1 - rho_1 * rho, -rho_1 * tau], [-rho_2 * tau, 1 - rho_2 * rho]], [2.0, 0.0])
    leaves, (front, back) = solution.leaves(), side_of(solution, "pane")
    for part, H, B in ((front, B_1, rho * B_1 + tau * B_2), (back, B_2, rho * B_2 + tau * B_1)):
        assert np.average(leaves.irradiance[part, 0], weights=leaves.area[part]) == pytest.approx(H, rel=0.01)
        assert np.average(leaves.radiosity[part, 0], weights=leaves.area[part]) == pytest.approx(B, rel=0.01)
    # Russian roulette between mirrors keeps power on average only.
    assert balance(solution) == pytest.approx(1, abs=0.005)
    assert solution.stats["power"]["shown"] == pytest.approx(solution.stats["power"]["absorbed"], rel=0.01)


RHO, TAU, RHO_WALL, B_A = 0.25, 0.5, 0.6, 2.0
B_B = TAU / (1 - RHO) * B_A


@pytest.fixture(scope="module")
def furnace():
    """Two rooms, the light in each of which is the same everywhere: B_a = E + ρ B_a + τ B_b, B_b = ρ B_b + τ B_a."""
    walls = [{"bsdf": diffuse(RHO_WALL), "emitter": lamp((1 - RHO_WALL) * B)} for B in (B_A, B_B)]
    return half_rooms(pane(RHO, TAU), *walls, emitter=lamp((1 - RHO) * B_A - TAU * B_B))


@pytest.fixture(scope="module")
def solved(furnace):
    return mr.solve(furnace, layers=True, elements=600, rays=300_000)


def test_the_furnace_has_the_same_light_everywhere(solved):
    leaves = solved.leaves()
    want = np.where(leaves.vertices[:, :, 0].mean(axis=1) < -1e-3, B_A, B_B)
    front, back = side_of(solved, "pane")
    want[front], want[back] = B_A, B_B
    for found in (leaves.irradiance, leaves.radiosity):
        assert np.average((found[:, 0] / want - 1) ** 2, weights=leaves.area) ** 0.5 < 0.06
        assert np.average(found[:, 0] / want, weights=leaves.area) == pytest.approx(1, rel=0.003)
    assert balance(solved) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("shading", ["gouraud", "flat", "direct", "gather"])
def test_the_furnace_in_pictures(solved, shading):
    picture = np.array(solved.render(1, spp=64, shading=shading))
    assert picture.mean() == pytest.approx(B_B / np.pi, rel=0.005)
    assert picture[6:10, 6:10].mean() == pytest.approx(B_B / np.pi, rel=0.01)  # the pane


def test_points_on_the_pane(solved):
    points = [[0, 0.1, 0.2], [0, -0.5, 0.3]]
    for normal, B in (([-1, 0, 0], B_A), ([1, 0, 0], B_B)):
        np.testing.assert_allclose(solved.radiosity(points, [normal]), B, rtol=0.03)
        np.testing.assert_allclose(solved.irradiance(points, [normal], samples=1024), B, rtol=0.02)


def test_kept_and_relit(solved, furnace, tmp_path):
    """A file has all that is needed; light is the sum of what each emitter gives, on both sides of the pane."""
    solved.save(tmp_path / "kept.npz")
    loaded = mr.Solution.load(tmp_path / "kept.npz", furnace)
    np.testing.assert_array_equal(np.array(solved.radiosity()), np.array(loaded.radiosity()))
    names = solved.layers.names
    each = [np.array(solved.relight({n: float(n == one) for n in names}).radiosity()) for one in names]
    np.testing.assert_allclose(np.sum(each, axis=0), np.array(solved.radiosity()), rtol=1e-4)
    _, back = side_of(solved, "pane")
    only_a = solved.relight({n: float(not n.startswith("b")) for n in names})
    values = only_a.leaves()
    assert (values.radiosity[back] > values.irradiance[back] * RHO * 1.5).all()
    power = only_a.stats["power"]
    assert power["absorbed"] + power["escaped"] + power["unshot"] == pytest.approx(power["emitted"], rel=1e-6)


def test_exported(solved):
    """Vertices of the pane have the radiosity of its sides; the page has what comes through by emitter."""
    mesh = lit_mesh(solved.relight({}), by_lamp=True)
    number = next(k for k, part in enumerate(solved.model.faces.parts) if part.shape.id() == "pane")
    for back, B in ((False, B_A), (True, B_B)):
        vertices = np.unique(mesh.triangles[(mesh.shape == number) & (mesh.back == back)])
        np.testing.assert_allclose(mesh.radiosity[vertices], B, rtol=0.1)
        np.testing.assert_allclose(mesh.irradiance[vertices], B, rtol=0.1)
        assert mesh.radiosity[vertices].mean() == pytest.approx(B, rel=0.02)
    np.testing.assert_allclose(mesh.through[:, 1:].sum(axis=1), mesh.through[:, 0], atol=0.01 * B_A)
    assert not mesh.through[np.unique(mesh.triangles[mesh.shape != number])].any()
    arrays = _data(solved, mesh)["arrays"]
    count = 2 * len(solved.layers.names)
    assert sum(name.startswith("through") for name in arrays) == count
    assert sum(name.startswith("leaf_through") for name in arrays) == count


def test_lightmap(solved):
    pytest.importorskip("xatlas")
    from mi_radiosity.export.lightmap import lightmap

    texels = lightmap(solved, 96, samples=64)
    open_pane = texels.open & (np.abs(texels.albedo[..., 0] - RHO - TAU) < 0.01)
    found = texels.radiosity[open_pane][:, 0]
    near_a = np.abs(found / B_A - 1) < np.abs(found / B_B - 1)
    assert found[near_a].mean() == pytest.approx(B_A, rel=0.01)
    assert found[~near_a].mean() == pytest.approx(B_B, rel=0.01)
    assert 0.3 < near_a.mean() < 0.7
    np.testing.assert_allclose(
        (texels.albedo * texels.effective + texels.emission)[open_pane], texels.radiosity[open_pane], rtol=1e-6
    )


# ---- Emitters of all kinds behind a curtain ----------------------------------------------------------

LIGHTS = {
    # What shines, and the irradiance of the middle of the curtain from behind.
    "directional": ({"type": "directional", "direction": [-3, 0, -4], "irradiance": rgb(2.0)}, 2.0 * 0.6),
    "point": ({"type": "point", "position": [3, 0, 4], "intensity": rgb(50.0)}, 50 / 25 * 0.6),
    "constant": ({"type": "constant", "radiance": rgb(0.5)}, 0.5 * np.pi),
    "area": (rectangle(facing([2, 0, 0], [0, 0, 0], 0.1), emitter=lamp(100.0)), 100 / np.pi * 0.04 / 4),
}


def curtain(light, bsdf, size=1.0):
    """A curtain in the plane x = 0 with light behind, x > 0, as a camera in front sees the middle."""
    camera = {
        "type": "perspective",
        "fov": 2,
        "to_world": T().look_at([-3, 0, 0], [0, 0, 0], [0, 0, 1]),
        "film": {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": "rgb", "rfilter": {"type": "box"}},
    }
    return scene(
        optimize=False,
        view=camera,
        light=light,
        curtain=rectangle(facing([0, 0, 0], [-1, 0, 0], size), bsdf=bsdf),
    )


def picture(solution, shading, spp=64):
    return np.array(solution.render(solution.model.scene.sensors()[1], spp=spp, shading=shading)).mean()


@pytest.mark.parametrize("kind", LIGHTS)
def test_light_from_behind(kind):
    """L = (τ H_b + ρ H_a) / π; only a sky shines on the front as well."""
    light, H = LIGHTS[kind]
    rho, tau = 0.2, 0.6
    # Elements are only refined where patches send light to each other.
    solution = mr.solve(curtain(light, pane(rho, tau), 0.5), elements=300 if kind == "area" else None, rays=60_000)
    want = (tau + rho * (kind == "constant")) * H / np.pi
    for shading in ("gouraud", "gather"):
        assert picture(solution, shading) == pytest.approx(want, rel=0.02), shading
    assert solution.model.unreached == 0
    assert not any("path" in warning for warning in solution.stats["warnings"])


def test_sun_and_sky_behind_cloth_beside_path():
    room = curtain(
        {"type": "sunsky", "sun_direction": [3, 0, 2], "to_world": T().rotate([0, 0, 1], 0)}, cloth(0.7, 1.2)
    )
    true = np.array(mi.render(room, sensor=1, integrator=mi.load_dict({"type": "path"}), spp=4096)).mean(axis=(0, 1))
    solution = mr.solve(room, rays=60_000)
    found = np.array(solution.render(room.sensors()[1], spp=64, shading="gather")).mean(axis=(0, 1))
    np.testing.assert_allclose(found, true, rtol=0.03)


@pytest.mark.parametrize(
    "wrap, share",
    [
        (lambda bsdf: {"type": "mask", "opacity": 0.5, "bsdf": bsdf}, 0.5),
        (lambda bsdf: {"type": "blendbsdf", "weight": 0.25, "a": bsdf, "b": diffuse(0.4)}, 0.75),
        (lambda bsdf: {"type": "blendbsdf", "weight": 0.25, "a": bsdf, "b": diffuse(0.4, two_sided=True)}, 0.75),
        (
            lambda bsdf: {
                "type": "mask",
                "opacity": 0.5,
                "m": {"type": "blendbsdf", "weight": 0.5, "a": bsdf, "b": bsdf},
            },
            0.5,
        ),
    ],
)
def test_nested(wrap, share):
    """A mask and a blend transmit their share of τ, whichever side light comes from."""
    model = Model(curtain(LIGHTS["point"][0], wrap(cloth(0.8))))
    np.testing.assert_allclose(model.materials.tau, 0.8 * share, rtol=0.01)
    assert (model.materials.rho <= 0.4 * (1 - share) + 0.01).all()


def test_textured_cloth():
    """Half of the squares transmit 0.8, the others 0.2: the mean is 0.5, on both sides of both faces."""
    checks = {"type": "checkerboard", "color0": rgb(0.8), "color1": rgb(0.2), "to_uv": T().scale(4)}
    room = curtain(LIGHTS["directional"][0], cloth(checks))
    np.testing.assert_allclose(Model(room).materials.tau, 0.5, rtol=0.02)
    solution = mr.solve(room, rays=60_000)
    front, back = side_of(solution, "curtain")
    B = leaf_values(solution)[0]
    assert B[front].mean() == pytest.approx(0.5 * 1.2, rel=0.02) and B[back].max() == 0


@pytest.mark.parametrize("more", [(), (1.0,)], ids=["transmitted", "reflected as well"])
def test_white_cloth_is_limited(more):
    """All of the light is sent on, or even 1.03 of it, as Mitsuba's thin cloth has it: 0.999 of it is."""
    model = Model(curtain(LIGHTS["point"][0], cloth(1.0, *more)))
    assert (model.materials.rho + model.materials.tau).max() <= 0.999 + 1e-9
    assert any("reflectance of 1" in warning for warning in model.warnings)


# ---- Which sides take part ---------------------------------------------------------------------------


def test_a_lampshade():
    """The light of a lamp in a closed shade gets out through the shade only; all of it is accounted for."""
    room = scene(
        optimize=False,
        shade={"type": "cube", "to_world": T().scale(0.5), "bsdf": cloth(0.6)},
        bulb={"type": "sphere", "radius": 0.1, "emitter": lamp(10.0)},
        floor=rectangle(T().translate([0, 0, -1]).scale(20), bsdf=diffuse(0.0)),
    )
    # Shooting keeps all power to the letter.
    solution = mr.solve(room, elements=1000, rays=200_000, transport=Shooting())
    leaves = solution.leaves()
    floor = leaves.vertices[:, :, 2].max(axis=1) < -0.9
    received = (leaves.irradiance[floor, 0] * leaves.open_area[floor]).sum()
    power, (front, back) = solution.stats["power"], side_of(solution, "shade")
    assert front.size and back.size and solution.model.unreached == 0
    assert balance(solution) == pytest.approx(1, abs=1e-6)
    # A cube of black cloth, ρ = 0: 0.6 of the light gets out; the shade keeps 0.4 of what gets to it. The black bulb
    # receives nothing, as cloth reflects nothing.
    out = received + power["escaped"] / 3
    assert out == pytest.approx(0.6 * power["emitted"] / 3, rel=1e-4)
    inside = (leaves.irradiance[back, 0] * leaves.area[back]).sum()
    assert inside == pytest.approx(power["emitted"] / 3, rel=1e-4)


def test_a_curtain_without_light_is_exported_as_dark():
    """An opaque box hides cloth from all light; cloth is no glass, so that exports show it black."""
    room = scene(
        optimize=False,
        box={"type": "cube", "bsdf": diffuse(0.5)},
        cloth=rectangle(T().scale(0.5), bsdf=cloth(0.8)),
        light={"type": "point", "position": [0, 0, 3], "intensity": rgb(1.0)},
    )
    model = Model(room)
    assert {model.faces.parts[s].shape.id() for s in model.faces.shape[dark_faces(model)]} >= {"cloth"}
