"""What others add: oracles, lamps, meshers, transports and shaders, from outside, by name."""

import json
from dataclasses import dataclass, replace

import mi_radiosity as mr
from mi_radiosity.cli import main
from mi_radiosity.core import plugins
from mi_radiosity.display import SHADERS
from mi_radiosity.oracles import ORACLES, parse
from mi_radiosity.scene import LIGHTS, MESHERS, Model, build_mesh, inspect
from mi_radiosity.transport import Flow

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, quad, rectangle, scene

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
BUDGET = dict(elements=300, rays=20_000)


@pytest.fixture(autouse=True)
def forget_what_was_added():
    registries = (ORACLES, LIGHTS, MESHERS, SHADERS)
    before = [dict(registry) for registry in registries]
    yield
    for registry, kept in zip(registries, before):
        registry.clear()
        registry.update(kept)


# ---- Oracles ---------------------------------------------------------------------------------------


def spread_oracle(seen):
    """An oracle that keeps several numbers of a pair, accepts below a level, and notes what it has seen."""

    @dataclass(frozen=True)
    class Spread(mr.Oracle):
        depth: float = 2.0
        name = "spread"

        def sigma(self, samples, pair):
            assert pair.rho is None and pair.B is None
            return samples.max(), samples.mean(), samples.min()

        def value(self, sigma, pair):
            high, mean, low = sigma
            arrays = (high, mean, low, pair.rho, pair.B, pair.area_receiver, pair.area_source, pair.level_receiver)
            seen.append([np.array(x) for x in (*arrays, pair.level_source)])
            deep = (pair.level_receiver >= self.depth) | (pair.level_source >= self.depth)
            return dr.select(deep, 0, (high - low) * mi.Float(pair.area_source) * dr.max(pair.rho * pair.B))

    return Spread


def test_an_oracle_with_several_numbers(cornell):
    """Its rule sees them in order, with ρ, B, areas and levels; a value of 0 is never split."""
    seen = []
    solution = mr.solve(cornell, spread_oracle(seen)(2), epsilon=1e-6, rays=1000)
    for high, mean, low, rho, B, area_i, area_j, level_i, level_j in seen:
        assert (high >= mean * (1 - 1e-6)).all() and (mean >= low * (1 - 1e-6)).all()
        assert rho.shape == B.shape == (3, len(high)) and (rho >= 0).all() and (B >= 0).all()
        assert (area_i > 0).all() and (area_j > 0).all() and max(level_i.max(), level_j.max()) <= 2
    assert any((high > mean).any() and (B > 0).any() for high, mean, _, _, B, *_ in seen)
    leaves = solution.leaves()
    assert leaves.level.max() == 2 and solution.stats["oracle"] == "spread"


def test_an_oracle_with_a_parameter_by_name(cornell):
    """Everywhere NAME:PARAMETER is, as text and back; what is no number is refused."""
    cls = spread_oracle([])
    assert parse("spread:3") == cls(3) and str(cls(3)) == "spread:3" and str(parse("spread")) == "spread:2"
    plugin = mi.load_dict({"type": "radiosity", "oracle": "spread:1", **BUDGET})
    assert plugin.options["oracle"] == cls(1)
    with pytest.raises(mr.RadiosityError, match="the depth of 'spread' must be a number, such as"):
        parse("spread:much")
    with pytest.raises(mr.RadiosityError, match="unknown oracle 'spraed': choose one of .*spread"):
        parse("spraed")


@pytest.mark.parametrize("text", ["gmi:0.5", "gmi:1.5", "mi", "ks", "power", "uniform"])
def test_oracles_are_called_what_they_are_asked_for_by(text):
    assert str(parse(text)) == text


PLUGIN = """
from dataclasses import dataclass

import mi_radiosity as mr


@dataclass(frozen=True)
class Bright(mr.Oracle):
    weight: float
    name = "bright"

    def sigma(self, samples, pair):
        return samples.max() ** self.weight * pair.area_receiver * pair.area_source
"""


def test_a_plugin_for_the_command_line(tmp_path):
    """Once its file was loaded, an oracle is known to the command line and to XML."""
    file, stats = tmp_path / "bright.py", tmp_path / "stats.json"
    file.write_text(PLUGIN)
    command = ["render", "scenes_xml/cornell_box.xml", "-o", str(tmp_path / "x.png"), "--stats", str(stats)]
    command += ["--oracle", "bright:2", "--elements", "100", "--rays", "5000", "--spp", "1"]
    assert main(command) != 0
    plugins.load(str(file))
    assert main(command) == 0 and json.loads(stats.read_text())["oracle"] == "bright"
    with pytest.raises(mr.RadiosityError, match="needs its weight: write bright:WEIGHT"):
        parse("bright")


@pytest.mark.parametrize(
    "text, says",
    [(None, "does not exist"), ("import nowhere_to_be_found", "install it"), ("1 / 0", "ZeroDivisionError")],
)
def test_plugins_that_fail_say_why(tmp_path, text, says):
    file = tmp_path / "wrong.py"
    if text:
        file.write_text(text)
    with pytest.raises(mr.RadiosityError, match=says):
        plugins.load(str(file))


def test_plugins_of_packages_are_known_to_the_api(tmp_path, monkeypatch):
    """Without a word of the user; one that fails is a warning."""
    from types import SimpleNamespace

    (tmp_path / "good.py").write_text(PLUGIN)
    entries = [SimpleNamespace(value=str(tmp_path / name)) for name in ("good.py", "missing.py")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: entries)
    plugins.welcome_installed.cache_clear()
    with pytest.warns(UserWarning, match="missing.py does not exist"):
        plugins.welcome_installed()
    plugins.welcome_installed()  # no second time
    assert parse("bright:2").weight == 2


# ---- Lamps -----------------------------------------------------------------------------------------


@pytest.fixture
def point_light():
    class Point(mr.Light):
        emitters = ("PointLight",)

        def __init__(self, emitter, scene, low, high):
            super().__init__(emitter, scene, low, high)
            parameters = mi.traverse(emitter)
            self.position, self.intensity = (
                kind(parameters[name]) for kind, name in ((mi.Point3f, "position"), (mi.Color3f, "intensity.value"))
            )

        def power(self):
            return [4 * np.pi * c[0] for c in self.intensity]

        def shoot(self, x, y, s, t):
            direction = mi.warp.square_to_uniform_sphere(mi.Point2f(x, y))
            return self.position, direction, 4 * np.pi * self.intensity

        def sample(self, point, s, t):
            distance = dr.norm(self.position - point)
            return (self.position - point) / distance, distance, self.intensity / dr.square(distance)

    return Point


def point(position, intensity=(1.0, 2.0, 3.0)):
    return {"type": "point", "position": position, "intensity": {"type": "rgb", "value": list(intensity)}}


def test_lamps_are_refused_until_they_are_known():
    del LIGHTS["PointLight"]
    with pytest.raises(mr.RadiosityError, match="PointLight"):
        mr.solve(scene(box={"type": "cube", "flip_normals": True}, lamp=point([0, 0, 0])), **BUDGET)


def test_a_point_light_over_a_floor(point_light):
    """H = I cos θ / r² at points, and power I Ω on the floor: exact both ways; beside an area lamp, the sum of both."""
    far = 3.0

    def floor(**more):
        return scene(floor=rectangle(T().scale(far), bsdf=diffuse(0.0)), **more)

    def solved(parts):
        return mr.solve(parts, rays=400_000)

    ceiling = rectangle(T().translate([0, 0, 4]).rotate([1, 0, 0], 180), bsdf=diffuse(0.0), emitter=lamp(5))
    both, one, other = (
        solved(floor(**parts))
        for parts in (
            dict(lamp=point([0, 0, 1]), more=ceiling),
            dict(lamp=point([0, 0, 1]), more=rectangle(T().translate([0, 0, 4]), bsdf=diffuse(0.0))),
            dict(more=ceiling),
        )
    )
    places = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0]], float)
    exact = np.outer(1 / (1 + (places**2).sum(axis=1)) ** 1.5, [1, 2, 3])
    np.testing.assert_allclose(one.irradiance(places, [0, 0, 1]), exact, rtol=1e-4)
    up = one.leaves()
    floor_leaves = np.isclose(up.vertices[:, :, 2], 0).all(axis=1)
    solid_angle = 4 * np.arctan(far * far / np.sqrt(2 * far * far + 1))  # of the floor, seen from 1 m above its middle
    power = up.area[floor_leaves] @ up.irradiance[floor_leaves]
    np.testing.assert_allclose(power, solid_angle * np.array([1, 2, 3]), rtol=5e-3)
    sums = [s.stats["power"]["emitted"] for s in (both, one, other)]
    assert sums[0] == pytest.approx(sums[1] + sums[2]) and sums[1] == pytest.approx(4 * np.pi * 6)
    alike = [s.irradiance(places, [0, 0, 1], samples=1 << 14) for s in (both, one, other)]
    np.testing.assert_allclose(alike[0], alike[1] + alike[2], rtol=5e-3)


def test_a_point_light_in_a_closed_room(point_light):
    """Mean radiosity ρ Φ / (S (1 − ρ)): no power is lost on the way."""
    room = scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)}, lamp=point([0.2, 0.3, 0.5]))
    solution = mr.solve(room, elements=500, rays=50_000)
    leaves = solution.leaves()
    mean = leaves.area @ leaves.radiosity / leaves.area.sum()
    np.testing.assert_allclose(mean, 4 * np.pi * np.array([1, 2, 3]) / 24, rtol=1e-4)


def test_a_solution_knows_its_lamps(point_light, tmp_path):
    """Saved with one lamp, refused with another, be it only moved."""

    def room(position):
        return scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)}, lamp=point(position))

    mr.solve(room([0, 0, 0]), **BUDGET).save(tmp_path / "kept.npz")
    assert mr.Solution.load(tmp_path / "kept.npz", room([0, 0, 0])).stats["rays"] == 20_000
    with pytest.raises(mr.RadiosityError, match="another scene"):
        mr.Solution.load(tmp_path / "kept.npz", room([0, 0, 0.5]))


def test_a_lamp_that_moves_is_noticed(point_light):
    room = scene(box={"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)}, lamp=point([0, 0, 0]))
    solution, params = mr.solve(room, **BUDGET), mi.traverse(room)
    params["lamp.position"] = mi.Point3f(0, 0, 0.5)
    params.update()
    with pytest.raises(mr.RadiosityError, match="edited"):
        solution.require_unchanged()


# ---- Meshers ---------------------------------------------------------------------------------------


def test_a_mesher_for_a_shape():
    """Without one spheres are refused, and with one solved, as the mesh it makes: here an octahedron."""
    del MESHERS["Sphere"]
    parts = scene(
        optimize=False,
        ball={"type": "sphere", "radius": 0.5, "center": [0, 0, 1], "bsdf": diffuse(0.3), "emitter": lamp(2)},
        floor=rectangle(bsdf=diffuse(0.5)),
    )
    assert "are not modelled: export it as a mesh" in inspect(parts)[0].why

    @mr.mesher("Sphere")
    def octahedron(sphere, share):
        assert 0 < share < 1
        box = sphere.bbox()
        points = np.array(box.center()) + box.extents().x / 2 * np.vstack([np.eye(3), -np.eye(3)])
        faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
        return build_mesh(sphere, points, np.array(faces))

    assert not inspect(parts)
    solution = mr.solve(parts, **BUDGET)
    leaves, names = solution.leaves(), [shape.id() for shape in parts.shapes()]
    ball = leaves.shape == names.index("ball")
    area = 8 * np.sqrt(3) / 4 * 0.5  # eight triangles of side r √2
    assert leaves.area[ball].sum() == pytest.approx(area, rel=1e-5)
    assert solution.stats["power"]["emitted"] == pytest.approx(3 * 2 * area, rel=1e-5)
    assert np.linalg.norm(leaves.vertices[ball] - [0, 0, 1], axis=2).max() == pytest.approx(0.5, rel=1e-5)


# ---- Transports ------------------------------------------------------------------------------------


class Noted(mr.Transport):
    """Shooting that keeps what it was given."""

    def __init__(self, **how):
        self.shooting, self.given = mr.Shooting(**how), []

    def __call__(self, problem, rays, seed, first_share=0.5, progress=lambda done: None):
        flow = self.shooting(problem, rays, seed, first_share, progress)
        self.given.append((problem, rays, flow))
        return flow


def test_a_transport_of_ones_own(cornell):
    """It is given a finished mesh and all rays, and its flow is the solution."""
    noted = Noted()
    solution = mr.solve(cornell, transport=noted, **BUDGET)
    ((problem, rays, flow),) = noted.given
    assert isinstance(flow, Flow) and rays == 20_000 == solution.stats["power_rays"]
    assert problem.elements is solution.elements and problem.exposure is solution.exposure
    for shown in (solution, mr.solve(cornell, transport=mr.Shooting(), **BUDGET)):
        np.testing.assert_array_equal(np.array(shown.direct), np.array(flow.direct))


def test_what_ones_own_transport_finds_is_gathered_on_request(cornell):
    """With the rays that it leaves, and as the usual one's is."""
    noted = Noted()
    gathered = mr.solve(cornell, transport=mr.Gathering(first=noted, share=0.5), **BUDGET)
    ((_, rays, flow),) = noted.given
    stats = gathered.stats
    assert rays == stats["power_rays"] and stats["rays"] == 20_000 and 9_000 < stats["gather_rays"] <= 10_000
    assert not np.array_equal(np.array(gathered.direct), np.array(flow.direct))
    usual = mr.solve(cornell, transport=mr.Gathering(share=0.5), **BUDGET)
    np.testing.assert_array_equal(np.array(gathered.direct), np.array(usual.direct))


def test_pilot_and_transport_are_of_one_kind(cornell):
    """The pilot is noted, too; it casts its rays more than once as the mesh grows."""
    pilot = Noted(**vars(mr.transport.PILOT))
    solution = mr.solve(cornell, pilot=pilot, **BUDGET)
    assert sum(rays for _, rays, _ in pilot.given) == solution.stats["pilot_rays"]
    sizes = [len(problem.elements) for problem, _, _ in pilot.given]
    assert sizes == sorted(sizes) and sizes[0] < sizes[-1]
    np.testing.assert_array_equal(np.array(solution.direct), np.array(mr.solve(cornell, **BUDGET).direct))


def test_the_tail_of_shooting(cornell):
    """A small tail takes more iterations, and power is kept whatever it is."""
    transports = (mr.Shooting(tail=tail) for tail in (0.5, 0.001))
    short, long = (mr.solve(cornell, transport=transport, **BUDGET).stats for transport in transports)
    assert short["iterations"] < long["iterations"]
    for stats in (short, long):
        power = stats["power"]
        assert power["absorbed"] + power["escaped"] + power["unshot"] == pytest.approx(power["emitted"], rel=1e-3)


# ---- Shaders ---------------------------------------------------------------------------------------


def test_a_shader_by_name(cornell, tmp_path):
    """Known to Solution.render, to dictionaries and to the command line; others are named where it is not."""

    class Constant(mr.Shader):
        name = "constant"

        def irradiance(self, look):
            return mi.Color3f(dr.pi)

    white = scene(
        lamp=rectangle(T().translate([0, 0, 9]), bsdf=diffuse(0.1), emitter=lamp()),
        floor=rectangle(T().scale(9), bsdf=diffuse(0.5)),
        roof=quad(np.array([[-1, 1, 9.5], [1, 1, 9.5], [1, -1, 9.5], [-1, -1, 9.5]]), bsdf=diffuse(0.5)),
    )
    solution = mr.solve(white, mr.Uniform(), **BUDGET)
    np.testing.assert_allclose(np.array(solution.render(shading="constant", spp=4)), 0.5, rtol=1e-5)
    plugin = mi.load_dict({"type": "radiosity", "shading": "constant", "oracle": "uniform", **BUDGET})
    np.testing.assert_allclose(np.array(mi.render(white, integrator=plugin, spp=4)), 0.5, rtol=1e-5)
    command = ["render", "scenes_xml/cornell_box.xml", "-o", str(tmp_path / "x.exr"), "--shading", "constant"]
    assert main([*command, "--elements", "100", "--rays", "5000", "--spp", "1"]) == 0
    with pytest.raises(mr.RadiosityError, match="unknown shading 'constnat': choose one of gouraud, .*constant"):
        solution.render(shading="constnat")


def test_a_shader_without_irradiance_says_so(cornell):
    class Nothing(mr.Shader):
        name = "nothing"

    solution = replace(mr.solve(Model(cornell), **BUDGET))
    with pytest.raises(NotImplementedError, match="Nothing must define irradiance"):
        Nothing(solution).irradiance(None)
