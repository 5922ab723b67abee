"""Shapes under random transforms: what is solved has the places and the sides that Mitsuba's rays hit."""

import mi_radiosity as mr
from mi_radiosity.core.arrays import NONE
from mi_radiosity.scene import Model

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

pytestmark = pytest.mark.fast
T = mi.ScalarTransform4f
RAYS = 4000
KINDS = {
    "sphere": {"type": "sphere", "center": [0.2, -0.3, 0.1], "radius": 0.8},
    "negative radius": {"type": "sphere", "center": [0.2, -0.3, 0.1], "radius": -0.8},
    "cylinder": {"type": "cylinder", "p0": [0.2, 0, -0.5], "p1": [0, 0.4, 0.9], "radius": 0.6},
    "disk": {"type": "disk"},
    "rectangle": {"type": "rectangle"},
    "cube": {"type": "cube"},
}


def random_transform(rng, mirrored, sheared):
    """A rotation, times a stretch by 0.5 to 2 per axis, a shear, or both, times a mirror in one or three axes."""
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    shear = np.eye(3) + sheared * np.triu(rng.uniform(-0.5, 0.5, (3, 3)), 1)
    scale = rng.uniform(0.5, 2, 3) if sheared else np.full(3, rng.uniform(0.5, 2))
    scale[rng.permutation(3)[: rng.choice([1, 3])]] *= -1 if mirrored else 1
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation @ shear * scale, rng.normal(size=3)
    return T(matrix)


def rays_through(box, seed):
    """Rays from around a scene and from within its box, so that both sides of its surfaces are hit."""
    rng = np.random.default_rng(seed)
    centre, radius = (
        (np.array(box.max) + np.array(box.min)) / 2,
        np.linalg.norm(np.array(box.max) - np.array(box.min)) / 2,
    )
    start = rng.normal(size=(RAYS, 3))
    start *= np.where(np.arange(RAYS) % 2, 1.5, 0.2)[:, None] / np.linalg.norm(start, axis=1)[:, None]
    towards = rng.uniform(-1, 1, (RAYS, 3)) / 3**0.5 - start
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    x = [mi.Float(np.ascontiguousarray(c, dtype=np.float32)) for c in (*(centre + radius * start).T, *towards.T)]
    return mi.Point3f(*x[:3]), mi.Vector3f(*x[3:]), radius


def check_against_rays(truth, seed):
    """The same rays hit the same side of the same place, and the same light, but for those that graze an outline.

    A circle of radius r that n ≥ 12 segments replace is off by at most r (1 − cos(π/n)) < 0.035 r.
    """
    origin, towards, radius = rays_through(truth.bbox(), seed)
    si, model = truth.ray_intersect(mi.Ray3f(origin, towards)), Model(truth)
    hit, t = model.rays.trace(origin, towards), model.faces.tracing.ray_intersect(mi.Ray3f(origin, towards)).t
    cosine, valid = np.array(-dr.dot(si.sh_frame.n, towards)), np.array(si.is_valid())
    steep = valid & (np.abs(cosine) > 0.3)  # elsewhere, rays go past the one and hit the other
    assert steep.sum() > RAYS / 20 and 0.01 < (cosine[steep] > 0).mean() < 1
    same = np.array(hit.valid)[steep]
    assert same.mean() > 0.99
    apart = np.abs(np.array(t)[steep][same] - np.array(si.t)[steep][same])
    assert np.quantile(apart, 0.99) < 0.1 * radius and np.median(apart) < 0.02 * radius
    front = ~np.array(hit.back)
    assert (front == (cosine > 0))[steep][same].mean() > 0.99
    shines = np.array(si.emitter(truth).eval(si).x) > 0
    power = np.array(dr.gather(mi.Color3f, model.patches.emission, hit.patch, hit.patch != NONE).x)
    assert shines[steep].any() and (shines == (power > 0))[steep][same].mean() > 0.99


def shining(kind, to_world, flipped):
    return KINDS[kind] | {"to_world": to_world, "flip_normals": flipped, "bsdf": diffuse(), "emitter": lamp()}


@pytest.mark.parametrize("flipped", [False, True], ids=["", "flipped"])
@pytest.mark.parametrize("kind", KINDS)
def test_shapes_are_where_mitsuba_traces_them(kind, flipped):
    """Turned, mirrored, stretched and sheared, with and without ``flip_normals``."""
    for seed, (mirrored, sheared) in enumerate(np.ndindex(2, 2)):
        rng = np.random.default_rng([seed, flipped])
        to_world = random_transform(rng, mirrored, sheared)
        check_against_rays(scene(it=shining(kind, to_world, flipped)), seed)


@pytest.mark.parametrize("kind", KINDS)
def test_instances_are_where_mitsuba_traces_them(kind):
    """A member of a group whose own transform is mirrored and sheared, under instances that are, too."""
    for seed, (inner, outer) in enumerate(np.ndindex(2, 2)):
        rng = np.random.default_rng([seed, 7])
        member = shining(kind, random_transform(rng, inner, True), bool(seed % 2))
        del member["emitter"]  # Mitsuba allows no emitters in groups
        placed = {
            "type": "instance",
            "group": {"type": "ref", "id": "group"},
            "to_world": random_transform(rng, outer, True),
        }
        light = rectangle(T().translate([0, 0, 2.5]).scale(0.5), bsdf=diffuse(), emitter=lamp())
        truth = scene(group={"type": "shapegroup", "it": member}, placed=placed, light=light)
        check_against_rays(truth, seed)


@pytest.mark.parametrize("kind", ["rectangle", "disk"])
@pytest.mark.parametrize("mirrored", [False, True], ids=["", "mirrored"])
def test_directional_areas_shine_whatever_the_transform(kind, mirrored):
    """`directionalarea` of exitance 1 lights the place straight ahead with 1 W/m², and the back with nothing."""
    to_world = T().scale([-0.5 if mirrored else 0.5, 0.5, 0.5])
    emitter = {"type": "directionalarea", "radiance": {"type": "rgb", "value": 1.0}}
    walls = {
        "above": rectangle(T().translate([0, 0, 1]).rotate([1, 0, 0], 180), bsdf=diffuse(0.1)),
        "below": rectangle(T().translate([0, 0, -1]), bsdf=diffuse(0.1)),
    }
    panel = {"type": kind, "to_world": to_world, "bsdf": diffuse(0), "emitter": emitter}
    solution = mr.solve(scene(panel=panel, **walls), mr.Uniform(), elements=100, rays=10_000)
    found = solution.irradiance(np.array([[0.05, 0.03, 1], [0.05, 0.03, -1]]), np.array([[0, 0, -1.0], [0, 0, 1.0]]))
    np.testing.assert_allclose(found[:, 0], [1, 0], atol=0.01)


def test_textures_of_stretched_spheres_follow_mitsuba():
    """Where Mitsuba finds texture coordinates at all: it has NaN near the poles of a sphere that is stretched."""
    truth = scene(ball={"type": "sphere", "to_world": T().scale([1, 0.8, 0.9]), "bsdf": diffuse(), "emitter": lamp()})
    origin, towards, _ = rays_through(truth.bbox(), 5)
    ray = mi.Ray3f(origin, towards)
    found, want = (np.array(s.ray_intersect(ray).uv).T for s in (Model(truth).faces.tracing, truth))
    off = np.abs((found - want + 0.5) % 1 - 0.5).max(axis=1)[np.isfinite(want).all(axis=1) & (want != 0).any(axis=1)]
    assert len(off) > RAYS / 4 and np.quantile(off, 0.9) < 0.02
