"""Shapes that are not triangles, instances, and what is refused; pictures against Mitsuba's `path`."""

import mi_radiosity as mr
from mi_radiosity.scene import Model, inspect
from mi_radiosity.scene.report import report
from mi_radiosity.solver.cost import estimate_cost

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from beside_path import compare
from conftest import balance, diffuse, lamp, rectangle
from test_lamps import SHINING, plate

at = mi.ScalarTransform4f
SHAPES = {
    "sphere": {"type": "sphere", "center": [0.5, -0.2, 0.5], "radius": 0.4},
    "mirrored sphere": {"type": "sphere", "to_world": at().translate([0.5, -0.2, 0.5]).scale([-0.4, 0.4, 0.4])},
    "cylinder": {"type": "cylinder", "p0": [0.5, -0.2, 0.1], "p1": [0.7, -0.1, 1.2], "radius": 0.3},
    "disk": {"type": "disk", "to_world": at().translate([0.5, -0.2, 0.6]).rotate([1, 0, 0], 30).scale([0.5, 0.3, 1])},
}
TRUE_AREA = {
    "sphere": 4 * np.pi * 0.4**2,
    "mirrored sphere": 4 * np.pi * 0.4**2,
    "cylinder": 2 * np.pi * 0.3 * np.sqrt(1.1**2 + 0.2**2 + 0.1**2),
    "disk": np.pi * 0.5 * 0.3,
}


def checkers():
    color = {f"color{k}": {"type": "rgb", "value": value} for k, value in enumerate((0.2, 0.8))}
    to_uv = at().scale([4, 4, 1])
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": to_uv} | color},
    }


def above(**more):
    return plate(lamp=rectangle(SHINING, bsdf=diffuse(), emitter=lamp(2)), **more)


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_meshes_follow_their_shapes(name, flipped):
    """Points, normals and texture coordinates of a mesh are those of the shape, and so is the area."""
    shape = mi.load_dict(SHAPES[name] | {"flip_normals": flipped, "bsdf": diffuse(two_sided=True)})
    truth = mi.load_dict({"type": "scene", "it": shape, "lamp": {"type": "constant"}})
    faces = Model(truth).faces
    assert faces.area.sum() == pytest.approx(TRUE_AREA[name], rel=1e-4)
    n = len(faces)
    si = faces.surface(dr.arange(mi.UInt32, n), *(dr.full(mi.Float, x, n) for x in (0.3, 0.4)))
    ray = mi.Ray3f(si.p + 0.1 * si.sh_frame.n, -si.sh_frame.n)
    true = truth.ray_intersect(ray)
    assert dr.all(true.is_valid()) and dr.min(dr.dot(si.sh_frame.n, true.sh_frame.n)) > 0.99
    assert dr.max(dr.abs(true.t - 0.1)) < 0.02
    assert np.isclose(np.array(si.uv), np.array(true.uv), atol=0.03).mean() > 0.8  # polar coordinates bend between


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_look_as_path_sees_them(name):
    solutions, _, _ = compare(above(it=SHAPES[name] | {"bsdf": checkers()}), elements=2500, rays=300_000)
    assert all(balance(solution) == pytest.approx(1, abs=2e-3) for solution in solutions)


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_shine(name):
    truth = plate(it=SHAPES[name] | {"bsdf": diffuse(0.3), "emitter": lamp(3)})
    solutions, _, _ = compare(truth, oracle=mr.Uniform(), elements=2500, rays=300_000)
    assert solutions[0].stats["power"]["emitted"] == pytest.approx(9 * TRUE_AREA[name], rel=1e-3)


def group(**members):
    return {"group": {"type": "shapegroup", **members}}


def instance(to_world, **parts):
    return {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": to_world}


PLACES = [
    at().translate([0.5, -0.2, 0.35]).rotate([0.6, 0.8, 0], 30).scale(0.3),
    at().translate([-0.4, 0.3, 1.0]).scale([-0.2, 0.3, 0.1]),
]


def members(to_world=None):
    """A cube of flat sides, a smooth ball with a texture, and a slanted square whose front is below."""
    place = to_world or at()
    return {
        "cube": {"type": "cube", "bsdf": diffuse([0.8, 0.2, 0.2]), "to_world": place},
        "ball": {"type": "sphere", "bsdf": checkers(), "to_world": place @ at().translate([0, 0, 1.6]).scale(0.5)},
        "roof": rectangle(place @ at().translate([0, 0, 2.4]), bsdf=diffuse(0.6), flip_normals=True),
    }


def test_instances_are_as_good_as_written_out():
    """Patches, their sides and ρ, and the light on them, are those of the same shapes written out, mirrored or not."""
    instances = {f"instance{k}": instance(to_world) for k, to_world in enumerate(PLACES)}
    truth = above(**group(**members()), **instances)
    copied = Model(truth)
    # Mitsuba has no spheres that are scaled unevenly, so only the first is written out with its ball.
    balls = {"ball": [True, False]}
    written = {
        f"{name}{k}": shape
        for k, to_world in enumerate(PLACES)
        for name, shape in members(to_world).items()
        if balls.get(name, [True, True])[k]
    }
    plain = Model(above(**written))
    for part in ("cube", "roof"):
        found = [part_of(model, part) for model in (copied, plain)]
        np.testing.assert_allclose(found[0], found[1], atol=1e-4)
    solutions, _, _ = compare(truth, elements=copied.patches.count + 2000, rays=300_000)
    assert all(balance(solution) == pytest.approx(1, abs=2e-3) for solution in solutions)
    assert set(solutions[0].leaves().shape) <= set(range(len(truth.shapes())))


def test_edits_inside_of_groups_are_noticed():
    """A solution of a scene is not shown of one whose instances have changed."""
    truth = above(**group(**members()), instance=instance(PLACES[0]))
    solution = mr.solve(truth, elements=2500, rays=100_000)
    solution.require_unchanged()
    (cube,) = (part.shape for part in solution.model.faces.parts if part.shape.id() == "cube")
    params = mi.traverse(cube)
    params["bsdf.reflectance.value"] = mi.Color3f(0.1)
    params.update()
    with pytest.raises(mr.RadiosityError, match="edited since it was solved"):
        solution.render(spp=1)


def part_of(model, name):
    """Centroids, normals and ρ of the patches of shapes with a name, in a canonical order."""
    face, shape = np.array(model.patches.face), model.faces.shape
    chosen = [name in model.faces.name(shape[f]) for f in face]
    rows = [
        model.faces.corners.mean(axis=1)[face],
        np.array(model.patches.normal).T,
        np.array(model.patches.reflectance).T,
    ]
    rows = np.hstack(rows)[chosen]
    return rows[np.lexsort(np.round(rows[:, ::-1], 3).T)]


def odd_shape(kind, folder):
    """A shape that cannot be solved."""
    if kind.endswith("curve"):
        file = folder / "curve.txt"
        file.write_text("".join(f"{x} 0 1 0.1\n" for x in (0.0, 0.2, 0.5, 0.7, 1.0)))
        return {"filename": str(file)}
    if kind == "sdfgrid":
        return {"grid": mi.TensorXf(np.linspace(-1, 1, 8, dtype=np.float32).reshape(2, 2, 2, 1))}
    numbers = {"centers": [[0, 0, 1]], "scales": [[0.1, 0.1, 0.1]], "quaternions": [[0, 0, 0, 1]]}
    return {name: mi.TensorXf(np.array(value, dtype=np.float32)) for name, value in numbers.items()}


@pytest.mark.parametrize(
    "kind, says",
    [
        ("linearcurve", "curves"),
        ("bsplinecurve", "curves"),
        ("sdfgrid", "distance fields"),
        ("ellipsoids", "ellipsoids"),
        ("ellipsoidsmesh", "ellipsoids"),
    ],
)
def test_shapes_refused_by_name(kind, says, tmp_path):
    odd = {"type": kind, "id": "odd", "bsdf": diffuse(), **odd_shape(kind, tmp_path)}
    with pytest.raises(mr.RadiosityError, match=f"'odd'.*{says}.*mesh"):
        Model(above(odd=odd))


def test_media_refused_by_name():
    fog = {"type": "sphere", "id": "fog", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    with pytest.raises(mr.RadiosityError, match="'fog'.*remove the medium"):
        Model(above(fog=fog))


def test_inspect_lists_everything(tmp_path):
    shapes = {kind: {"type": kind, **odd_shape(kind, tmp_path)} for kind in ("linearcurve", "sdfgrid")}
    found = [finding.what for finding in inspect(above(**shapes))]
    assert found == ["shape 'linearcurve' (LinearCurve)", "shape 'sdfgrid' (SDFGrid)"]


def test_a_report_says_what_everything_is(tmp_path):
    odd = {"type": "sdfgrid", "id": "odd", **odd_shape("sdfgrid", tmp_path)}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}}
    glass = {"type": "sphere", "center": [0, 0, 1.2], "radius": 0.2, "bsdf": {"type": "plastic"}}
    fair = above(**group(**members()), it=instance(PLACES[0]), glass=glass, sky=sky)
    found = report(fair)
    rows = {row.name: row for row in found.shapes}
    ball, cube = rows["shape 'ball' of instance 'it'"], rows["shape 'cube' of instance 'it'"]
    assert ball.kind == "Sphere" and ball.fronts == ball.faces and cube.faces == 12 and cube.backs == 0
    assert rows["shape 'glass'"].treatment == "diffuse lobe, others traced" and cube.treatment == "diffuse"
    assert sum(row.fronts + row.backs for row in found.shapes) == found.model.patches.count
    lamps = {lamp.kind: lamp for lamp in found.lamps}
    assert (
        lamps["AreaLight"].power == pytest.approx([2 * 0.96] * 3) and min(lamps["ConstantBackgroundEmitter"].power) > 0
    )
    cost, solution = estimate_cost(found.model), mr.solve(found.model, rays=10_000)
    assert cost.elements == pytest.approx(solution.stats["elements"], abs=3) and cost.seconds > 0 < cost.memory
    refused = report(above(odd=odd, sky=sky))
    assert refused.model is None and "odd" in refused.refused[0] and "mesh" in refused.shapes[-1].treatment
