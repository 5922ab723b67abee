"""Geometry that hurts: one scene per case, solved with every oracle."""

import mi_radiosity as mr
from mi_radiosity.scene import Model

import mitsuba as mi
import numpy as np
import pytest
from conftest import (
    ORACLES,
    balance,
    diffuse,
    group,
    icosphere,
    lamp,
    leaf_corners,
    leaf_values,
    mesh,
    quad,
    rectangle,
    scene,
)

T = mi.ScalarTransform4f
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
C11_2 = 0.41525323  # form factor of parallel squares of side 2 at distance 1 (C-11, X = Y = 2)
FLOOR, OTHER, LAMP, WALL = 0.3, 0.6, 0.5, 0.4


def ceiling(**parts):
    """A lamp over [-1, 1]² at z = 1 that shines down."""
    return rectangle(T().translate([0, 0, 1]).rotate([1, 0, 0], 180), bsdf=diffuse(LAMP), emitter=lamp(), **parts)


def room(scale=5.0, rho=WALL, **parts):
    return {"type": "cube", "flip_normals": True, "bsdf": diffuse(rho), "to_world": T().scale(scale), **parts}


def box(to_world, rho=OTHER, two_sided=False):
    return {"type": "cube", "bsdf": diffuse(rho, two_sided), "to_world": to_world}


def mean(solution, reflectance, name="irradiance"):
    """Area mean over the surfaces of a reflectance."""
    values, areas, patches = leaf_values(solution, name)
    here = np.isin(patches, group(solution.model, reflectance))
    return np.average(values[here, 0], weights=areas[here])


def plate_is_lit(solution):
    """Floor under a ceiling of its size: H = F / (1 − ρ ρ' F²), to 1.5 %."""
    expected = C11_2 / (1 - FLOOR * LAMP * C11_2**2)
    assert mean(solution, FLOOR) == pytest.approx(expected, rel=0.015)
    assert len(group(solution.model, FLOOR)) and np.array(solution.model.patches.area)[
        group(solution.model, FLOOR)
    ].sum() == pytest.approx(4, rel=1e-5)


def closed_room_is_right(emitted, area, rho=WALL, rel=0.01):
    """Mean indirect irradiance of a closed room of one ρ: Φ ρ / (S (1 − ρ))."""

    def check(solution):
        values, areas, _ = leaf_values(solution, "indirect")
        assert values[:, 0] @ areas / area == pytest.approx(emitted * rho / (area * (1 - rho)), rel=rel)

    return check


def with_degenerate_faces():
    points = np.vstack([SQUARE, [[0, 0, 0], [0, 0, 0]]])
    return scene(
        lamp=ceiling(), floor=mesh(points, [[0, 1, 2], [0, 2, 3], [0, 0, 1], [4, 5, 1], [0, 2, 4]], diffuse(FLOOR))
    ), plate_is_lit


def slivers():
    """A strip of 2 × 2e-6 above the floor is as bright as the point in its middle: four corners (B-3)."""

    def check(solution):
        x = np.linspace(-1, 1, 2001)

        def corner(a, b):
            return (
                (
                    a / np.sqrt(1 + a * a) * np.arctan(b / np.sqrt(1 + a * a))
                    + b / np.sqrt(1 + b * b) * np.arctan(a / np.sqrt(1 + b * b))
                )
                / 2
                / np.pi
            )

        direct = np.mean(2 * corner(1 - x, 1) + 2 * corner(1 + x, 1))
        # Its leaves get 16 lines and 32 rays each, and so have a noise of 4 %; this is four times that.
        assert mean(solution, FLOOR, "direct") == pytest.approx(direct, rel=0.16)
        assert mean(solution, OTHER) > 0

    strip = SQUARE * [1, 1e-6, 1]
    return scene(
        lamp=ceiling(), strip=quad(strip, bsdf=diffuse(FLOOR)), floor=quad(SQUARE * 3 - [0, 0, 1], bsdf=diffuse(OTHER))
    ), check


def coincident(other):
    return lambda: (scene(lamp=ceiling(), floor=quad(SQUARE, bsdf=diffuse(FLOOR)), again=other), plate_is_lit)


def rug():
    """A plate of half the size in the floor's plane is lit as if it lay on the floor."""

    def check(solution):
        on_floor = scene(
            lamp=ceiling(),
            floor=quad(SQUARE, bsdf=diffuse(FLOOR)),
            rug=quad(SQUARE * [0.5, 0.5, 1] + [0, 0, 1e-4], bsdf=diffuse(OTHER)),
        )
        reference = mr.solve(on_floor, elements=1500, rays=300_000)
        assert mean(solution, OTHER) == pytest.approx(mean(reference, OTHER), rel=0.015)
        assert mean(solution, FLOOR) == pytest.approx(mean(reference, FLOOR), rel=0.015)

    return scene(
        lamp=ceiling(), floor=quad(SQUARE, bsdf=diffuse(FLOOR)), rug=quad(SQUARE * [0.5, 0.5, 1], bsdf=diffuse(OTHER))
    ), check


def crossing_rugs():
    """Two plates that cross each other in the floor's plane are lit as if they lay on it, the smaller on top."""

    def parts(lift):
        turn = T().rotate([0, 0, 1], 30)
        return scene(
            lamp=ceiling(),
            floor=quad(SQUARE, bsdf=diffuse(FLOOR)),
            large=rectangle(T().translate([0.2, 0.1, lift]) @ turn @ T().scale([0.6, 0.3, 1]), bsdf=diffuse(OTHER)),
            small=rectangle(T().translate([0, 0.3, 2 * lift]).scale([0.3, 0.4, 1]), bsdf=diffuse(WALL)),
        )

    def check(solution):
        reference = mr.solve(parts(1e-4), elements=2500, rays=1_000_000)
        for rho in (FLOOR, OTHER, WALL):
            assert mean(solution, rho) == pytest.approx(mean(reference, rho), rel=0.015)
            assert shown_area(solution, rho) == pytest.approx(shown_area(reference, rho), rel=0.015)
        assert shown_area(solution, WALL) == pytest.approx(0.48, rel=1e-4)

    return parts(0), check


def shown_area(solution, reflectance):
    _, areas, patches = leaf_values(solution)
    return areas[np.isin(patches, group(solution.model, reflectance))].sum()


def crossing_lamps():
    """Two lamps of 4 m² in the ceiling that share 1 m² shine as one of 7 m²."""

    def down(x):
        return T().translate([x, x, 5]).rotate([1, 0, 0], 180)

    lamps = {name: rectangle(down(x), bsdf=diffuse(WALL), emitter=lamp()) for name, x in (("one", 0), ("two", 1))}

    def check(solution):
        assert solution.stats["power"]["emitted"] / 3 == pytest.approx(7, rel=0.01)
        closed_room_is_right(7, 600)(solution)

    return scene(room=room(), **lamps), check


def lamp_in_ceiling():
    """A lamp in the plane of the ceiling gives all its light to the room."""
    down = T().translate([0, 0, 5]).rotate([1, 0, 0], 180)
    return scene(room=room(), lamp=rectangle(down, bsdf=diffuse(WALL), emitter=lamp())), closed_room_is_right(4, 600)


def interpenetrating_boxes():
    """What of a box is inside of another stays dark."""

    def check(solution):
        corners = leaf_corners(solution)  # [leaves, 3, 3]
        values, _, patches = leaf_values(solution)

        def inside(low, high):
            return ((corners > np.add(low, 1e-3)) & (corners < np.subtract(high, 1e-3))).all(axis=(1, 2))

        in_a, in_b = inside([-2, -2, -5], [0, 0, -3]), inside([-1, -1, -4], [1, 1, -2])
        hidden = (in_a & np.isin(patches, group(solution.model, FLOOR))) | (
            in_b & np.isin(patches, group(solution.model, OTHER))
        )
        assert (values[hidden] == 0).all() and (values[~hidden].max(axis=1) > 0).mean() > 0.8

    return scene(
        room=room(),
        lamp=rectangle(T().translate([0, 0, 4.9]).rotate([1, 0, 0], 180), bsdf=diffuse(LAMP), emitter=lamp()),
        a=box(T().translate([-1, -1, -4]), OTHER),
        b=box(T().translate([0, 0, -3]), FLOOR),
    ), check


def walled(x, right=None, left=None):
    """A room of 10 m that a wall of 1 mm at ``x`` closes in two, with emitters on the right and perhaps on the left."""

    def lit(at, emitter):
        return rectangle(T().translate([at, 0, 4.9]).rotate([1, 0, 0], 180), bsdf=diffuse(LAMP), emitter=emitter)

    return scene(
        room=room(),
        lamp=lit(2.5, right or lamp()),
        wall=box(T().translate([x, 0, 0]).scale([0.0005, 5, 5])),
        **({"other": lit(-3.5, left)} if left else {}),
    )


def behind(solution, x):
    """Radiosity and area of the leaves that lie left of x altogether."""
    values, areas, _ = leaf_values(solution)
    here = (leaf_corners(solution)[..., 0] <= x - 0.0004).all(axis=1)
    assert here.sum() > 5
    return values[here, 0], areas[here]


def thin_wall(x):
    """Behind it there is nothing, not a bit, and nothing to be seen; elements end at the wall or cross it."""

    def check(solution):
        np.testing.assert_array_equal(behind(solution, x)[0], 0)
        for target in ([x, 0, -5], [x, 0, 5], [x, 5, 0]):
            eye = mi.load_dict(
                {
                    "type": "perspective",
                    "fov": 60,
                    "to_world": T().look_at([x - 3, 0.1, 0.1], target, [0.3, 0.2, 1]),
                    "film": {"type": "hdrfilm", "width": 64, "height": 64},
                }
            )
            assert np.array(solution.render(eye, spp=16)).max() == 0

    return lambda: (walled(x), check)


def dark_room():
    """A room without light behind a wall is not modelled, and what bounds it is dark."""

    def check(solution):
        assert len(group(solution.model, OTHER)) == 0 and solution.model.unreached >= 12
        closed_room_is_right(24, 24, FLOOR)(solution)

    return scene(
        lit=room(1, FLOOR, emitter=lamp()), dark={**room(1, OTHER), "to_world": T().translate([2.001, 0, 0])}
    ), check


def open_scene():
    """Nothing but two plates: what misses them escapes."""

    def check(solution):
        plate_is_lit(solution)
        up, down = mean(solution, FLOOR), mean(solution, LAMP)
        power = solution.stats["power"]
        assert power["escaped"] / 3 == pytest.approx(4 + 4 * FLOOR * up + 4 * LAMP * down - 4 * (up + down), rel=3e-3)

    return scene(lamp=ceiling(), floor=quad(SQUARE, bsdf=diffuse(FLOOR))), check


def tiny_lamp():
    """A lamp of 1e-8 of the area of the room."""
    half = (600 * 1e-8) ** 0.5 / 2
    down = T().translate([0, 0, 4.9]).rotate([1, 0, 0], 180).scale(half)
    return scene(room=room(), lamp=rectangle(down, bsdf=diffuse(WALL), emitter=lamp())), closed_room_is_right(
        600e-8, 600
    )


def many_lamps():
    """10,000 lamps, 20,000 patches."""
    g = (np.arange(100) + 0.5) / 50 - 1
    x, y = (a.ravel() for a in np.meshgrid(g, g))
    corners = np.stack(
        [
            np.column_stack([x + a * 0.003, y + b * 0.003, 0 * x + 0.99])
            for a, b in ((-1, -1), (-1, 1), (1, 1), (1, -1))
        ],
        axis=1,
    )
    faces = 4 * np.arange(10_000)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    lamps = mesh(corners.reshape(-1, 3), faces.reshape(-1, 3), diffuse(WALL), lamp())
    return scene(room=room(1), lamps=lamps), closed_room_is_right(0.36, 24 + 0.36, rel=0.02)


def furnace(rho):
    def build():
        def check(solution):
            assert mean(solution, rho, "radiosity") == pytest.approx(1 / (1 - rho), rel=1e-3)

        return scene(room=room(1, rho, emitter=lamp())), check

    return build


def transformed(matrix):
    """The closed room under a transformation that keeps it closed: ρ and Φ alone decide."""

    def build():
        size = np.cbrt(abs(np.linalg.det(np.array(matrix.matrix)[:3, :3])))
        down = matrix @ T().translate([0, 0, 0.9]).rotate([1, 0, 0], 180).scale(0.2)
        parts = scene(
            room={**room(), "to_world": matrix},
            lamp=rectangle(down, bsdf=diffuse(WALL, two_sided=True), emitter=lamp()),
        )
        return parts, closed_room_is_right(0.16 * size**2, (24 + 0.32) * size**2, rel=0.003)

    return build


def inverted_normals():
    """A ball whose triangles face outwards, two-sided, around a lamp: a closed room all the same."""
    vertices, faces = icosphere(1, inwards=False)
    area = np.linalg.norm(np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))), axis=1).sum() / 2
    inside = closed_room_is_right(0.36, area + 0.72)

    def check(solution):
        inside(solution)
        assert solution.stats["power"]["escaped"] == 0

    return scene(
        ball=mesh(vertices, faces, diffuse(WALL, two_sided=True)),
        lamp=rectangle(T().scale(0.3), bsdf=diffuse(WALL, two_sided=True), emitter=lamp()),
    ), check


CASES = {
    "degenerate faces": with_degenerate_faces,
    "slivers": slivers,
    "duplicate": coincident(quad(SQUARE, bsdf=diffuse(FLOOR))),
    "duplicate, other diagonal": coincident(quad(np.roll(SQUARE, 1, axis=0), bsdf=diffuse(FLOOR))),
    "duplicate, turned faces": coincident(mesh(SQUARE, [[1, 2, 0], [2, 3, 0]], diffuse(FLOOR))),
    "back to back": coincident(quad(SQUARE[::-1], bsdf=diffuse(OTHER))),
    "rug in the floor": rug,
    "crossing rugs": crossing_rugs,
    "crossing lamps": crossing_lamps,
    "lamp in the ceiling": lamp_in_ceiling,
    "interpenetrating boxes": interpenetrating_boxes,
    "thin wall": thin_wall(0),
    "thin wall across elements": thin_wall(-1.3),
    "thin wall by a corner": thin_wall(-2.49),
    "dark room": dark_room,
    "open": open_scene,
    "tiny lamp": tiny_lamp,
    "10,000 lamps": many_lamps,
    "rho 0": furnace(0.0),
    "rho 0.999": furnace(0.999),
    "mirrored": transformed(T().scale([1, -1, 1])),
    "mirrored thrice": transformed(T().scale([-1, -1, -1])),
    "tiny units": transformed(T().scale(1e-6)),
    "huge units": transformed(T().scale(1e6)),
    "far away": transformed(T().translate([1e4, -1e4, 1e4])),
    "inverted normals": inverted_normals,
}


@pytest.mark.parametrize("oracle", ORACLES, ids=str)
@pytest.mark.parametrize("case", CASES)
def test_holds_for_every_oracle(case, oracle):
    """Finite, not negative, energy kept to 1e-3, and what the case says."""
    parts, check = CASES[case]()
    model = Model(parts)
    # ρ = 0 leaves oracles nothing to refine: only a mesh that is not asked for by number may stay coarse.
    few = {} if case == "rho 0" else {"elements": model.patches.count + 1500}
    solution = mr.solve(model, oracle, rays=300_000, **few)
    values, _, _ = leaf_values(solution)
    assert np.isfinite(values).all() and (values >= 0).all()
    assert balance(solution) == pytest.approx(1, abs=1e-3)
    check(solution)


@pytest.mark.parametrize("other", [OTHER, FLOOR])
def test_coincident_faces_do_not_speckle(other):
    """Rays that come down on the floor meet one and the same of three coincident plates, whoever looks."""
    plates = {
        "floor": quad(SQUARE, bsdf=diffuse(FLOOR)),
        "a": quad(np.roll(SQUARE, 1, axis=0), bsdf=diffuse(other)),
        "b": quad(SQUARE, bsdf=diffuse(0.7)),
    }
    model = Model(scene(lamp=ceiling(), **plates))
    grid = np.random.default_rng(0).uniform(-1, 1, (2, 20_000)).astype(np.float32)
    for slope in (0, 0.3, 3):
        x = mi.Point3f(mi.Float(grid[0]) - slope * 0.5, mi.Float(grid[1]), 0.5)
        hit = model.rays.trace(x, mi.Vector3f(slope, 0, -1) + mi.Vector3f(0 * x.x, 0 * x.x, 0 * x.x))
        rho = np.array(model.patches.reflectance)[0][np.array(hit.patch)]
        assert np.ptp(rho) == 0
    assert any("lie in others" in w for w in model.warnings)


@pytest.mark.parametrize("rho, says", [(1.5, "bright.*more than 1"), (float("nan"), "bright.*not a number")])
def test_impossible_reflectances_are_refused_by_name(rho, says):
    with pytest.raises(mr.RadiosityError, match=says):
        texture = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((2, 2, 3), rho, np.float32))}
        bsdf = {"type": "diffuse", "reflectance": texture}
        mr.solve(scene(lamp=ceiling(), bright=quad(SQUARE, bsdf=bsdf, name="bright")))


def test_a_wall_keeps_two_lit_rooms_apart():
    """Ten times the light beyond a wall that elements cross does not show on this side of it, to 1 %."""

    def left(beyond):
        solution = mr.solve(walled(-1.3, lamp(beyond), lamp()), elements=3000, rays=2_000_000)
        values, areas = behind(solution, -4.999)
        assert areas.sum() == pytest.approx(100, rel=1e-5)
        return values @ areas

    assert left(10) == pytest.approx(left(1e-6), rel=0.01)
