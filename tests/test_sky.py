"""Light of the sky and of the sun through a hole in a roof, against closed forms and quadrature of its own.

Mitsuba's `path` is no judge here: it leaks where Mitsuba has merged rectangles (docs/mitsuba_issues.md).
"""

import mi_radiosity as mr
from mi_radiosity.evaluation.reference import render_reference
from mi_radiosity.scene import Model

import mitsuba as mi
import numpy as np
import pytest

SIZE, HEIGHT, HOLE = 4.0, 3.0, (1.5, 2.5)  # m: floor of 4 × 4, roof at 3 with a hole of 1 × 1 in its middle
POINTS = [[2, 1e-3, 0.25], [2, 1e-3, 0.75], [2, 1e-3, 1.75], [2, 0.25, 1e-3], [2, 1.25, 1e-3], [0.75, 2.75, 1e-3]]
NORMALS = [[0, 1, 0]] * 3 + [[0, 0, 1]] * 3
MERGED = pytest.mark.parametrize("merged", [False, True], ids=["apart", "merged"])


def rectangle(centre, u, v):
    """A rectangle of half sides u and v whose BSDF it shares with the others."""
    matrix = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2], matrix[:3, 3] = u, v, np.cross(u, v), centre
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix), "bsdf": {"type": "ref", "id": "all"}}


SIDES = {
    "floor": ([2, 2, 0], [2, 0, 0], [0, 2, 0]),
    "south": ([2, 0, 1.5], [0, 0, 1.5], [2, 0, 0]),
    "north": ([2, 4, 1.5], [2, 0, 0], [0, 0, 1.5]),
    "west": ([0, 2, 1.5], [0, 2, 0], [0, 0, 1.5]),
    "east": ([4, 2, 1.5], [0, 0, 1.5], [0, 2, 0]),
}
ROOF = {
    "roof-south": ([2, 0.75, 3], [2, 0, 0], [0, -0.75, 0]),
    "roof-north": ([2, 3.25, 3], [2, 0, 0], [0, -0.75, 0]),
    "roof-west": ([0.75, 2, 3], [0.75, 0, 0], [0, -0.5, 0]),
    "roof-east": ([3.25, 2, 3], [0.75, 0, 0], [0, -0.5, 0]),
}
LID = {"lid": ([2, 2, 3], [2, 0, 0], [0, -2, 0])}


def room(emitter, merged, roof=ROOF, bsdf=None, **more):
    """A room under ``emitter`` whose surfaces have one BSDF, black by default."""
    bsdf = bsdf or {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}}
    sides = {name: rectangle(*side) for name, side in (SIDES | roof).items()}
    parts = {"type": "scene", "all": bsdf | {"id": "all"}, "emitter": emitter, **sides, **more}
    scene = mi.load_dict(parts, optimize=merged)
    if merged:  # the scene has what is tested: Mitsuba's box of it is not that of its faces
        box = scene.bbox()
        assert not box.valid() or np.any(np.array(box.max) < [SIZE, SIZE, 3])
    return scene


def through_hole(luminance, points=POINTS, normals=NORMALS, steps=200):
    """∫ L cos θ cos θ' / r² over the hole, by the midpoint rule (one value per point)."""
    side = np.linspace(*HOLE, 2 * steps + 1)[1::2]
    hole = np.stack([*np.meshgrid(side, side), np.full((steps, steps), HEIGHT)], axis=-1).reshape(-1, 3)
    values = []
    for point, normal in zip(np.array(points, dtype=float), np.array(normals, dtype=float)):
        d = hole - point
        r = np.linalg.norm(d, axis=1)
        kernel = np.maximum(d @ normal, 0) * d[:, 2] / r**4
        values.append((luminance(d / r[:, None]) * kernel).mean() * (HOLE[1] - HOLE[0]) ** 2)
    return np.array(values)


def corner_factor(a, b):
    """Form factor of a rectangle a × b, one away, whose corner is above an element parallel to it (B-3)."""
    x, y = np.hypot(1, a), np.hypot(1, b)
    return (a / x * np.arctan(b / x) + b / y * np.arctan(a / y)) / (2 * np.pi)


def overcast(direction):
    """CIE sky 16, Moon and Spencer: (1 + 2 cos Z) / 3 of the radiance of the zenith."""
    return (1 + 2 * np.maximum(direction[..., 2], 0)) / 3


def clear(direction):
    """CIE sky 12 with the sun at 60° in the direction (0, ½, √3/2), relative to the zenith's (ISO 15469)."""
    sun, a, b, c, d, e = np.array([0, 0.5, 0.75**0.5]), -1, -0.32, 10, -3, 0.45
    cosine = np.maximum(direction[..., 2], 1e-3)

    def indicatrix(angle):
        return 1 + c * (np.exp(d * angle) - np.exp(d * np.pi / 2)) + e * np.cos(angle) ** 2

    angle = np.arccos(np.clip(direction @ sun, -1, 1))
    gradation = (1 + a * np.exp(b / cosine)) / (1 + a * np.exp(b))
    return gradation * indicatrix(angle) / indicatrix(np.pi / 6)


def envmap(luminance, width=1024):
    """An envmap with +z up whose radiance is ``luminance`` of directions."""
    phi, theta = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(width // 2) + 0.5) / (width // 2))
    phi, theta = 2 * np.pi * phi, np.pi * theta
    # Mitsuba's own coordinates have +y up; the picture's direction is (sin φ sin θ, cos θ, −cos φ sin θ).
    local = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    world = local @ np.array(turn.matrix)[:3, :3].T
    image = np.repeat(luminance(world)[..., None], 3, axis=-1).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(image), "to_world": turn}


CONSTANT = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
SKIES = {
    "constant": (lambda: CONSTANT, lambda d: np.ones(d.shape[:-1])),
    "overcast": (lambda: envmap(overcast), overcast),
    "clear": (lambda: envmap(clear), clear),
}


def test_quadrature_agrees_with_the_closed_form():
    """The hole seen from below its corner and its middle, B-3."""
    below = [[1.5, 1.5, 0], [2, 2, 0]]
    want = np.pi * np.array([corner_factor(1 / 3, 1 / 3), 4 * corner_factor(0.5 / 3, 0.5 / 3)])
    np.testing.assert_allclose(through_hole(lambda d: 1.0, below, [[0, 0, 1]] * 2), want, rtol=1e-5)


@MERGED
@pytest.mark.parametrize("name", SKIES)
def test_irradiance_at_points_below_a_hole(name, merged):
    emitter, luminance = SKIES[name]
    solution = mr.solve(room(emitter(), merged), elements=400, rays=20_000)
    found = solution.irradiance(POINTS, NORMALS, samples=16384)[:, 1]
    np.testing.assert_allclose(found, through_hole(luminance), rtol=0.03)


@MERGED
def test_leaves_below_a_hole(merged):
    """The mean irradiance of floor and walls: by reciprocity what the hole sends to them."""
    solution = mr.solve(room(CONSTANT, merged), elements=600, rays=1_000_000)
    leaves = solution.leaves()
    centre = leaves.vertices.mean(axis=1)
    inside = solution_faces_in(leaves)
    want = {}
    steps = (np.arange(40) + 0.5) / 40
    u, v = (x.ravel() for x in np.meshgrid(steps, steps))
    floor = np.column_stack([4 * u, 4 * v, 0 * u])
    south = np.column_stack([4 * u, 0 * u, 3 * v])
    want["floor"] = through_hole(lambda d: 1.0, floor, np.tile([0, 0, 1], (len(u), 1)), 40).mean()
    want["south"] = through_hole(lambda d: 1.0, south, np.tile([0, 1, 0], (len(u), 1)), 40).mean()
    for name, at in (("floor", centre[:, 2] < 1e-4), ("south", centre[:, 1] < 1e-4)):
        chosen = at & inside
        mean = np.average(leaves.irradiance[chosen, 1], weights=leaves.area[chosen])
        assert mean == pytest.approx(want[name], rel=0.04), name


def solution_faces_in(leaves):
    """Which leaves face the middle of the room (bool [leaves])?"""
    edges = leaves.vertices[:, 1:] - leaves.vertices[:, :1]
    normal = np.cross(edges[:, 0], edges[:, 1])  # of the order of corners, not of the side
    towards = (normal * ([2, 2, 1.5] - leaves.vertices[:, 0])).sum(axis=1) > 0
    return towards != leaves.back


@MERGED
def test_gather_pictures_below_a_hole(merged):
    """Pictures of floor points: L = ρ E / π, with ρ so small that light that is reflected twice does not count."""
    rho = 0.01
    bsdf = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": rho}}}
    look = mi.ScalarTransform4f().look_at([2, 1.25, 2.9], [2, 1.25, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 2, "to_world": look, "film": film}
    solution = mr.solve(room(CONSTANT, merged, bsdf=bsdf, camera=camera), elements=400, rays=20_000)
    picture = np.array(solution.render(spp=16384, shading="gather"))[0, 0, 1]
    want = rho / np.pi * through_hole(lambda d: 1.0, [[2, 1.25, 0]], [[0, 0, 1]])[0]
    assert picture == pytest.approx(want, rel=0.04)


@MERGED
def test_sun_through_a_hole(merged):
    """A directional emitter: E cos θ where its beam falls, nothing elsewhere."""
    direction = np.array([0.1, 0.2, -1.0])
    emitter = {"type": "directional", "direction": direction.tolist(), "irradiance": {"type": "rgb", "value": 2.0}}
    solution = mr.solve(room(emitter, merged), elements=400, rays=20_000)
    beam = np.array([2, 2, HEIGHT]) + HEIGHT * direction  # where the middle of the hole is seen on the floor
    points = [[*beam[:2], 1e-3], [2, 1e-3, 0.25], [0.5, 0.5, 1e-3], [3.5, 1, 1e-3]]
    found = solution.irradiance(points, [[0, 0, 1], [0, 1, 0], [0, 0, 1], [0, 0, 1]], samples=64)[:, 1]
    want = [2 / np.linalg.norm(direction), 0, 0, 0]
    np.testing.assert_allclose(found, want, rtol=1e-3, atol=1e-6)


OUTSIDE = {
    "constant": CONSTANT,
    "sunsky": {"type": "sunsky", "sun_direction": [0.3, 0.5, 0.8], "to_world": mi.ScalarTransform4f()},
    "directional": {"type": "directional", "direction": [0.1, 0.3, -1], "irradiance": {"type": "rgb", "value": 2.0}},
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_closed_room_is_dark(name):
    """No light comes through walls of rough metal, whatever is outside. Mitsuba's box holds two small cubes only."""
    metal = {"type": "twosided", "bsdf": {"type": "roughconductor", "alpha": 0.3}}
    look = mi.ScalarTransform4f().look_at([2, 0.2, 1], [2, 4, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "fov": 70, "to_world": look, "film": film}
    at = mi.ScalarTransform4f
    cubes = {
        name: {"type": "cube", "to_world": at().translate([2, 2, z]).scale(0.2), "bsdf": {"type": "diffuse"}}
        for name, z in (("inside", 0.5), ("outside", 3.5))
    }
    scene = room(OUTSIDE[name], True, LID, metal, camera=camera, **cubes)
    solution = mr.solve(scene, elements=400, rays=20_000)
    assert np.array(solution.render(spp=64, shading="gather")).max() == 0
    assert np.all(solution.irradiance(POINTS, NORMALS, samples=256) == 0)


def test_round_shapes_are_as_fine_beside_merged_rectangles():
    """The size of the scene, and so the tessellation of a sphere, does not depend on how Mitsuba was loaded."""
    ball = {"type": "sphere", "radius": 0.3, "center": [2, 2, 1], "bsdf": {"type": "diffuse"}}
    apart, merged = (room(CONSTANT, merged, ball=ball) for merged in (False, True))
    assert len(Model(apart).faces) == len(Model(merged).faces)


def test_references_of_scenes_that_leak_are_refused(tmp_path):
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    camera = {"type": "perspective", "film": film}
    whole, merged = (room(CONSTANT, merged, camera=camera) for merged in (False, True))
    render_reference(whole, whole.sensors()[0], tmp_path / "whole.exr", spp=2)
    with pytest.raises(mr.RadiosityError, match="optimize=False"):
        render_reference(merged, merged.sensors()[0], tmp_path / "merged.exr", spp=2)
