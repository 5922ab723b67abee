"""The back of a one-sided surface is not the inside of a solid: open shells, rooms whose walls face out, and solids."""

import mi_radiosity as mr
from mi_radiosity.export.grids import Grid
from mi_radiosity.export.measure import measure
from mi_radiosity.scene import Model

import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, icosphere, lamp, mesh, rectangle, scene
from scipy import integrate

pytestmark = pytest.mark.fast

T = mi.ScalarTransform4f
DOWN = T().translate([0, 0, 0.97]).rotate([1, 0, 0], 180).scale(0.3)


def cube(scale, *where, **parts):
    return {"type": "cube", "to_world": T().translate(where or [0, 0, 0]).scale(scale), "bsdf": diffuse(), **parts}


def walls(shape="cube"):
    """A room with outward normals around [-1, 1]³: a cube, or a ball of 5,120 faces."""
    if shape == "cube":
        return cube(1.0)
    vertices, faces = icosphere(4, inwards=False)
    return mesh(2 * vertices, faces, diffuse(), name="room")


EMITTERS = {
    "area": rectangle(DOWN, emitter=lamp(10.0)),
    "point": {"type": "point", "position": [0, 0, 0.97], "intensity": {"type": "rgb", "value": 1.0}},
    "spot": {"type": "spot", "to_world": T().look_at([0, 0, 0.97], [0, 0, 0], [1, 0, 0]), "cutoff_angle": 60},
}


@pytest.mark.parametrize("emitter", EMITTERS)
@pytest.mark.parametrize("room", ["cube", "ball"])
def test_rooms_whose_walls_face_out(room, emitter):
    """A block is as open, and as bright, as without the walls, which reflect nothing to their inside."""
    parts = {"block": cube(0.3, 0, 0, -0.4), "other": cube(0.2, 0.6, 0.2, 0), "emitter": EMITTERS[emitter]}
    bare, walled = scene(optimize=False, **parts), scene(optimize=False, **parts, room=walls(room))
    alone, inside = (mr.solve(s, elements=300, rays=100_000).leaves() for s in (bare, walled))
    number = [s.id() for s in walled.shapes()].index("block")
    mine, theirs = inside.shape == number, alone.shape == [s.id() for s in bare.shapes()].index("block")
    assert mine.any()
    np.testing.assert_allclose(inside.open_area[mine], inside.area[mine], rtol=1e-6)
    power = [(l.irradiance[of, 0] @ l.area[of]) for l, of in ((inside, mine), (alone, theirs))]
    assert power[0] == pytest.approx(power[1], rel=0.03)
    assert inside.irradiance[mine].max() < 1.3 * alone.irradiance[theirs].max()


def test_solids_stay_solids():
    """A box without a bottom on the floor of a room whose walls face out: what it covers of the floor stays covered."""
    box = scene(
        optimize=False,
        room=cube(1.0),
        floor=rectangle(T().translate([0, 0, -0.9]), bsdf=diffuse()),
        leg=cube([0.5, 0.5, 0.4], 0, 0, -0.8),
        emitter=EMITTERS["area"],
    )
    solution = mr.solve(box, elements=1000, rays=100_000)
    leaves = solution.leaves()
    floor = leaves.shape == [s.id() for s in box.shapes()].index("floor")
    assert leaves.open_area[floor].sum() == pytest.approx(4 - 1, rel=0.02)


def test_a_panel_close_to_the_ceiling(cornell):
    """The gap above the emitter counts as covered where leaves are cut by its border; nothing in it explodes."""
    solution = mr.solve(mi.load_dict(mi.cornell_box(), optimize=False), elements=2000, rays=100_000)
    leaves = solution.leaves()
    ceiling = (np.abs(leaves.vertices[:, :, 1] - 1) < 1e-3).all(axis=1)
    middle = leaves.vertices.mean(axis=1)
    above = ceiling & (np.abs(middle[:, 0]) < 0.15) & (np.abs(middle[:, 2]) < 0.12)
    assert above.any()
    assert leaves.irradiance[above].max() < leaves.irradiance[ceiling & ~above].max()


def test_points_in_the_dark_are_not_in_a_solid():
    """In a room whose walls face out: the shadow of the block is dark, its inside is left out."""
    block = cube(0.3, 0, 0, -0.4)
    solution = mr.solve(scene(block=block, emitter=EMITTERS["area"], room=walls()), elements=300, rays=50_000)
    points = np.array([[0.0, 0, -0.95], [0, 0, -0.4], [0, 0, 0.5]])
    grid = Grid(points, np.tile([0.0, 0, 1], (3, 1)), [])
    assert measure(solution, grid, samples=64).solid.tolist() == [False, True, False]


def test_loaded_solutions_agree_on_what_is_solid(tmp_path):
    """The same sides, though rays are traced among other patches."""
    walled = scene(block=cube(0.3, 0, 0, -0.4), emitter=EMITTERS["area"], room=walls("ball"))
    model = Model(walled)
    again = Model(walled, model.patches.sides)
    assert model.unreached
    np.testing.assert_array_equal(np.array(model.rays._kind), np.array(again.rays._kind))


# ---- View factors, without any emitter -------------------------------------------------------------


def vertical(x, y, height):
    """Four walls of a hall [-x, x] × [-y, y], facing in."""
    found = {}
    for name, angle, half, distance in (("a", 0, x, y), ("b", 90, y, x), ("c", 180, x, y), ("d", 270, y, x)):
        stands = T().translate([0, distance, height / 2]).rotate([1, 0, 0], 90).scale([half, height / 2, 1])
        found[name] = rectangle(T().rotate([0, 0, 1], angle) @ stands, bsdf=diffuse())
    return found


def plate(x, y, z=0.0, up=True):
    turn = T() if up else T().rotate([1, 0, 0], 180)
    return rectangle(T().translate([0, 0, z]) @ turn.scale([x, y, 1]), bsdf=diffuse())


def ball(radius, *where, inwards=False):
    vertices, faces = icosphere(2, inwards)
    return mesh(radius * vertices + (where or (0, 0, 0)), faces, diffuse(), name="ball")


def factors(level="shape", rays=20_000, **shapes):
    found = mr.view_factors(scene(optimize=False, **shapes), level, rays)
    np.testing.assert_allclose(found.F.sum(axis=1)[found.areas > 0], 1, rtol=1e-9)
    return found


def to_backs(found, name):
    return found.F[found.names.index(name), found.names.index("backs")]


def parallel(x, y, h):
    """F of directly opposed rectangles x × y at distance h, by quadrature over one of them (catalogue C-11)."""

    def at(a, b):
        def corner(p, q):
            r, s = np.hypot(h, p), np.hypot(h, q)
            return (p / r * np.arctan(q / r) + q / s * np.arctan(p / s)) / (2 * np.pi)

        return sum(corner(p, q) for p in (a, x - a) for q in (b, y - b))

    return integrate.dblquad(at, 0, y, 0, x, epsabs=1e-6)[0] / (x * y)


@pytest.mark.parametrize("level", ["shape", "face"])
def test_a_ball_in_a_cube_that_faces_out(level):
    found = factors(level, 2000, ball=ball(0.4), room=cube(1.0))
    assert found.areas.sum() - 24 == pytest.approx(1.973, rel=1e-3)  # of an icosphere of 320 faces
    rows = [k for k, name in enumerate(found.names) if name.startswith("ball")]
    np.testing.assert_allclose(found.F[rows].toarray()[:, -1], 1, rtol=1e-6)


def test_two_balls_in_a_cube_that_faces_out():
    """As in the open, where the rest is sky and ground."""
    two = {"ball": ball(0.3, -0.5, 0, 0), "other": cube(0.2, 0.5, 0, 0)}
    inside, outside = factors(room=cube(1.0), **two), factors(**two)
    for name in two:
        k = [f.names.index(name) for f in (inside, outside)]
        assert inside.areas[k[0]] == pytest.approx(outside.areas[k[1]], rel=1e-6)
        beyond = outside.F[k[1]].toarray().ravel()[len(outside.areas) :].sum()
        assert to_backs(inside, name) == pytest.approx(beyond, abs=3e-3)


@pytest.mark.parametrize("half, height", [((1, 1), 2), ((20, 10), 2.5)])
@pytest.mark.parametrize("turned", ["floor", "ceiling"])
def test_a_floor_or_ceiling_that_faces_out(half, height, turned):
    """All of the plate on the other side is open, also in the middle of a flat hall."""
    x, y = half
    plates = {"floor": plate(x, y, 0, turned != "floor"), "ceiling": plate(x, y, height, turned == "ceiling")}
    found = factors(**vertical(x, y, height), **plates)
    other = "ceiling" if turned == "floor" else "floor"
    assert found.areas[found.names.index(other)] == pytest.approx(4 * x * y, rel=1e-6)
    assert to_backs(found, other) == pytest.approx(parallel(2 * x, 2 * y, height), abs=5e-3)


def test_a_dome_that_faces_out():
    """With a ball under it, and without: all of the floor is open, and A_dome F_dome,floor = A_floor F_floor,dome."""
    vertices, faces = icosphere(2, inwards=False)
    upper = faces[vertices[faces][:, :, 2].mean(axis=1) > 0]
    shapes = {"dome": mesh(vertices, upper, diffuse(), name="dome"), "floor": plate(0.5, 0.5, -0.01)}
    assert to_backs(factors(**shapes), "floor") > 0.95
    with_ball = factors(ball=ball(0.1, 0.2, 0, 0.3), **shapes)
    areas = dict(zip(with_ball.names, with_ball.areas))
    assert areas["floor"] == pytest.approx(1, rel=1e-6)
    assert areas["ball"] == pytest.approx(0.1**2 * 1.973 / 0.4**2, rel=1e-3)


def test_legs_on_the_floor_of_a_hall_with_a_ceiling_that_faces_out():
    """The hall is open, the inside of the legs, which have no bottom in the hall, is not."""
    legs = {f"leg{k}": cube([0.5, 0.5, 0.6], 4 * k - 6, 0, 0.5) for k in range(4)}
    found = factors(rays=100_000, **vertical(10, 5, 3), floor=plate(10, 5), ceiling=plate(10, 5, 3), **legs)
    assert found.areas[found.names.index("floor")] == pytest.approx(200 - 4, rel=3e-3)


def test_closed_meshes_that_intersect():
    """Cubes of edge 1 that share a cube of edge 0.7: three faces of each lose 0.7² inside of the other."""
    found = factors(rays=50_000, a=cube(0.5), b=cube(0.5, 0.3, 0.3, 0.3))
    np.testing.assert_allclose(found.areas, 6 - 3 * 0.7**2, rtol=5e-3)


def test_a_box_sunk_in_a_closed_slab():
    """Half of the box is inside: an area of 1 + 4 · ½ is open, and what it covers of the slab is not."""
    found = factors(rays=100_000, slab=cube([2, 2, 0.5], 0, 0, -0.5), box=cube(0.5))
    areas = dict(zip(found.names, found.areas))
    assert areas["box"] == pytest.approx(3, rel=5e-3) and areas["slab"] == pytest.approx(2 * 16 + 16 - 1, rel=5e-3)
