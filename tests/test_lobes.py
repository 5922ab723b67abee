"""Lobes that are not diffuse: every material of Mitsuba against `path`, energy, and what stays as it was."""

import gc
from importlib.util import find_spec
from weakref import ref

import mi_radiosity as mr
from mi_radiosity.core.color import srgb
from mi_radiosity.display.lux import VIRIDIS
from mi_radiosity.scene import Model
from mi_radiosity.scene.lobes import Lobes

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from beside_path import compare
from conftest import balance, diffuse

COLOR = {"type": "rgb", "value": [0.5, 0.3, 0.2]}
DIFFUSE = {"type": "diffuse", "reflectance": COLOR}
MATERIALS = {
    "plastic": {"type": "plastic", "diffuse_reflectance": COLOR},
    "rough plastic": {"type": "roughplastic", "diffuse_reflectance": COLOR, "alpha": 0.2},
    "conductor": {"type": "conductor", "material": "Al"},
    "rough conductor": {"type": "roughconductor", "alpha": 0.3},
    "principled": {"type": "principled", "base_color": COLOR, "roughness": 0.4, "specular": 0.5},
    "blend": {"type": "blendbsdf", "weight": 0.5, "a": DIFFUSE, "b": {"type": "roughconductor", "alpha": 0.3}},
    "glass": {"type": "dielectric"},
    "thin glass": {"type": "thindielectric"},
    "rough glass": {"type": "roughdielectric", "alpha": 0.3},
    "null": {"type": "null"},
    "mask": {"type": "mask", "opacity": 0.3, "bsdf": {"type": "twosided", "bsdf": DIFFUSE}},
    "thin principled": {"type": "principledthin", "base_color": COLOR, "diff_trans": 0.6, "roughness": 0.4},
    "two sides": {"type": "twosided", "a": DIFFUSE, "b": {"type": "conductor"}},
}
TRANSPARENT = ("glass", "thin glass", "rough glass", "null", "mask", "thin principled", "two sides")


def box(material):
    """The Cornell box with its tall block of another material, on a small film."""
    parts = mi.cornell_box()
    del parts["integrator"]
    parts["sensor"]["film"] |= {"width": 48, "height": 48, "rfilter": {"type": "box"}}
    bsdf = {"diffuse": DIFFUSE, **MATERIALS}[material]
    parts["large-box"]["bsdf"] = bsdf if material in TRANSPARENT else {"type": "twosided", "bsdf": bsdf}
    return mi.load_dict(parts)


@pytest.mark.parametrize("material", MATERIALS)
def test_pictures_agree_with_path(material):
    """The picture and every wall in it, in every channel, to 1 %; energy kept to 1 %."""
    solutions, _, _ = compare(box(material), elements=2000, rays=300_000)
    assert np.mean([balance(solution) for solution in solutions]) == pytest.approx(1, abs=0.01)


def seen(scene, name):
    """Pixels whose middle is on a shape (bool [height, width])."""
    sensor, (shape,) = scene.sensors()[0], (shape for shape in scene.shapes() if shape.id() == name)
    width, height = sensor.film().crop_size()
    k = dr.arange(mi.UInt32, width * height)
    place = mi.Point2f((k % width + 0.5) / width, (k // width + 0.5) / height)
    ray, _ = sensor.sample_ray(0, 0, place, 0)
    return np.array(scene.ray_intersect_preliminary(ray).shape == mi.ShapePtr(shape)).reshape(height, width)


@pytest.mark.parametrize("material", ["diffuse", "plastic"])
def test_hidden_lamps(material):
    """What is behind a lamp is seen, as `path` sees it; denoised, too."""
    room = box(material)
    where = seen(room, "light")
    hides = {"hide_emitters": True}
    path = np.array(mi.render(room, integrator=mi.load_dict({"type": "path", "max_depth": -1} | hides), spp=4096))
    radiosity = mi.load_dict({"type": "radiosity", "shading": "gather", "elements": 3000, "rays": 300_000} | hides)
    for denoise in (False, True) if find_spec("mitsuba_oidn") else (False,):
        ours = np.array(radiosity.picture(room, 0, 0, 64, denoise))[..., :3]
        assert where.sum() > 12 and path[where].max() < 3  # the lamp shines with 18
        assert ours[where].mean() == pytest.approx(path[where].mean(), abs=0.02 * float(path.mean()))
        assert ours[~where].mean() == pytest.approx(path[~where].mean(), rel=0.02)


@pytest.mark.parametrize("material", ["plastic", "rough conductor"])
def test_colors_have_no_coats(material):
    """Every pixel of `lux` shading is one of its colours, also on coats and in mirrors."""
    solution = mr.solve(box(material), elements=2000, rays=100_000)
    colors = srgb(np.array(solution.render(spp=1, shading="lux"))[..., :3].reshape(-1, 3))
    table = 255 * np.array(VIRIDIS) / 1000
    place = np.linspace(0, len(table) - 1, 3000)
    curve = np.column_stack([np.interp(place, np.arange(len(table)), column) for column in table.T])
    apart = np.abs(colors[:, None] - curve).max(axis=2).min(axis=1)[colors.any(axis=1)]  # beside the box it is black
    assert len(apart) > 1500 and (apart < 1).all() and len(np.unique(np.round(colors[:, 1]))) > 20


def test_outlines_are_not_looked_for_in_mirrors():
    room = box("conductor")
    mirror = seen(room, "large-box")
    solution = mr.solve(room, elements=2000, rays=100_000)
    plain, mesh = (np.array(solution.render(spp=16, shading=s))[..., :3] for s in ("gouraud", "mesh"))
    outlined = (mesh < 0.98 * plain).any(axis=2)
    assert mirror.sum() > 100 and outlined[mirror].mean() < 0.2 < outlined[~mirror].mean()  # those at its edges


@pytest.mark.parametrize(
    "material, albedo", [("plastic", 0.455), ("rough plastic", 0.441), ("principled", 0.388), ("blend", 0.268)]
)
def test_rho_is_the_albedo_of_sampled_diffuse_lobes(material, albedo):
    """At a reflectance of one half, as found by independent sampling to 1 %."""
    grey = {"type": "rgb", "value": 0.5}
    bsdf = {
        "plastic": {"type": "plastic", "diffuse_reflectance": grey},
        "rough plastic": {"type": "roughplastic", "diffuse_reflectance": grey},
        "principled": {"type": "principled", "base_color": grey, "roughness": 0.4, "specular": 0.5},
        "blend": {
            "type": "blendbsdf",
            "weight": 0.5,
            "a": {"type": "diffuse", "reflectance": grey},
            "b": {"type": "roughconductor"},
        },
    }[material]
    light = {"type": "sphere", "center": [0, 0, 3], "radius": 0.2, "emitter": {"type": "area", "radiance": 1.0}}
    model = Model(mi.load_dict({"type": "scene", "plate": {"type": "rectangle", "bsdf": bsdf}, "light": light}))
    shape = [part.shape.class_name() for part in model.faces.parts].index("Rectangle")
    assert model.materials.rho[0][model.faces.shape == shape] == pytest.approx(albedo, rel=0.01)


def test_mirrors_and_glass_make_no_patches():
    """A side without a diffuse lobe receives nothing: all that meets it goes on."""
    plain, glass = (Model(box(m)) for m in ("null", "plastic"))
    assert plain.patches.count == glass.patches.count - 22


@pytest.mark.parametrize("material", ["null", "two sides"])
def test_cameras_see_no_farther_than_they_are_told(material):
    """A camera's far clip ends its rays in front of the box, whatever the box is made of; its near clip does not."""
    parts = mi.cornell_box()
    parts["large-box"]["bsdf"] = MATERIALS[material]
    sensor = {"type": "perspective", "fov": 39, "to_world": parts["sensor"]["to_world"]}
    sensor |= {"film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}}
    solution = mr.solve(mi.load_dict(parts), elements=500, rays=20_000)
    near, far = (
        np.array(solution.render(mi.load_dict(sensor | {"near_clip": 0.1, "far_clip": clip}), spp=4, shading="gather"))
        for clip in (2, 100)
    )
    assert not near[..., :3].any() and far[..., :3].any()


def test_diffuse_scenes_are_not_followed(cornell):
    """Not a kernel more than before: no lobe is ever asked for."""
    assert Model(cornell).rays.lobes is None


# ---- Light that comes through lobes ----------------------------------------------------------------

AREA_LAMP = {
    "type": "sphere",
    "radius": 0.15,
    "bsdf": diffuse(0.0),
    "emitter": {"type": "area", "radiance": 25.0},
    "center": [0, 0.3, 0],
}
POINT_LAMP = {"type": "point", "position": [0, 0.3, 0], "intensity": 2.0}


def test_rays_that_are_followed_by_recorded_kernels_end_where_others_do():
    """To the bit, in several materials, with waves of any width, and of a second scene after a first."""
    for material in ("rough plastic", "mask"):
        scene, found = box(material), []
        for frozen in (True, False):
            with dr.scoped_set_flag(dr.JitFlag.KernelFreezing, frozen):
                model = Model(scene)
                found += [mr.solve(model, elements=400, rays=rays, seed=1).stats["power"] for rays in (3_000, 20_000)]
        assert found[:2] == found[2:] and found[0] != found[1]


def test_other_materials_and_shapes_may_be_there():
    """Those of no scene, too: Dr.Jit has them in its kernels."""
    others = [mi.load_dict(MATERIALS[material]) for material in ("rough conductor", "plastic")]
    others += [mi.load_dict({"type": "sphere"}), mi.load_dict({"type": "rectangle", "bsdf": MATERIALS["blend"]})]
    solution = mr.solve(box("rough glass"), elements=400, rays=3_000)
    del others
    again = mr.solve(solution.model, elements=400, rays=3_000)
    assert solution.stats["power"] == again.stats["power"]


def test_scenes_may_become_garbage_while_kernels_are_recorded(monkeypatch):
    """Dr.Jit ends the process when a scene is freed meanwhile; Python looks for garbage at every chance here."""
    scenes, step, thresholds = [box("glass"), box("glass")], Lobes._step, gc.get_threshold()

    def littering(*args):
        cycle = [scenes.pop() if scenes else None]
        cycle.append(cycle)
        del cycle
        assert [[] for _ in range(100)]  # allocations are what Python looks for garbage at
        return step(*args)

    monkeypatch.setattr(Lobes, "_step", littering)
    scene = box("mask")
    try:
        gc.set_threshold(1, 1, 1)
        mr.solve(scene, elements=400, rays=3_000)
    finally:
        gc.set_threshold(*thresholds)
    assert gc.isenabled() and not scenes


def test_a_scene_ends_with_its_solution():
    """Nothing of it waits for Python's garbage collection: while a scene is there, Dr.Jit compiles its materials into
    the kernels of all others."""
    gc.collect()
    gc.disable()
    try:
        solution = mr.solve(box("mask"), elements=400, rays=3_000)
        for shading in ("gouraud", "direct", "gather"):
            solution.render(spp=1, shading=shading)
        there = [ref(solution), ref(solution.model), ref(solution.model.rays), ref(solution.gatherer)]
        del solution
        assert not any(it() for it in there)
    finally:
        gc.enable()


def closed_room(lamp, glass=True):
    """A room of 2 × 2 × 2 m, ρ = 0.5, and a lamp in it, in a cube of glass."""
    at = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}}
    look = at().look_at([0, -0.9, 0], [0, 1, 0], [0, 0, 1])
    cover = {"type": "cube", "to_world": at().translate([0, 0.3, 0]).scale(0.3), "bsdf": {"type": "thindielectric"}}
    parts = {
        "type": "scene",
        "camera": {"type": "perspective", "fov": 90, "to_world": look, "film": film},
        "room": {"type": "cube", "flip_normals": True, "bsdf": diffuse(0.5)},
        "lamp": lamp,
    }
    return mi.load_dict(parts | ({"glass": cover} if glass else {}))


@pytest.mark.parametrize("lamp", [AREA_LAMP, POINT_LAMP], ids=["area", "point"])
def test_light_from_behind_glass_is_shown(lamp):
    """Nothing is lost in a closed room: what is shown is absorbed to the last watt, though no line finds the lamp."""
    room = closed_room(lamp)
    solution = mr.solve(room, elements=1500, rays=200_000)
    power, leaves = solution.stats["power"], solution.leaves()
    assert power["shown"] == pytest.approx(power["emitted"], rel=1e-3)
    kept = np.where(leaves.shape == [s.id() for s in room.shapes()].index("room"), 0.5, 1.0)
    assert (kept * leaves.area * leaves.irradiance.T).sum() == pytest.approx(power["emitted"], rel=1e-3)


@pytest.mark.parametrize("shading", ["gouraud", "direct", "gather"])
def test_pictures_agree_with_path_where_lamps_are_behind_glass(shading):
    compare(closed_room(AREA_LAMP), shading=shading, elements=1500, rays=400_000)


def test_light_of_points_through_glass_is_kept_and_named(tmp_path):
    """`path` cannot find it: thin glass takes nothing away, so the room with it is as bright as without."""
    room = closed_room(POINT_LAMP)
    solution = mr.solve(room, elements=1500, rays=400_000)
    assert "comes through glass" in solution.stats["warnings"][0]
    plain = mr.solve(closed_room(POINT_LAMP, glass=False), elements=1500, rays=400_000)
    assert plain.caustic is None and plain.stats["warnings"] == []
    for shading in ("gouraud", "direct", "gather"):
        ours, theirs = (np.mean(s.render(spp=64, shading=shading)) for s in (solution, plain))
        assert ours == pytest.approx(theirs, rel=0.01)
    at, up = [[0.3, 0.2, -1], [-0.5, 0.1, -1]], [0, 0, 1]
    np.testing.assert_allclose(solution.irradiance(at, up), plain.irradiance(at, up), rtol=0.1)
    solution.save(tmp_path / "kept.npz")
    loaded = mr.Solution.load(tmp_path / "kept.npz", room)
    np.testing.assert_array_equal(np.array(loaded.caustic), np.array(solution.caustic))
    layers = mr.solve(room, elements=1500, rays=100_000, layers=True)
    np.testing.assert_allclose(np.array(layers.relight({0: 2}).caustic), 2 * np.array(layers.caustic), rtol=1e-6)


def test_a_scene_without_a_diffuse_lobe_is_refused_in_one_line():
    for bsdf in ("dielectric", "conductor"):
        glass = {"type": "scene", "it": {"type": "sphere", "bsdf": {"type": bsdf}}, "lamp": POINT_LAMP}
        with pytest.raises(mr.RadiosityError, match="no surface has a diffuse lobe"):
            mr.solve(mi.load_dict(glass))


def test_lobes_tell_scenes_apart():
    """A solution of rough metal is none of smooth metal."""
    prints = []
    for alpha in (0.1, 0.1, 0.3):
        parts = mi.cornell_box()
        parts["large-box"]["bsdf"] = {"type": "roughconductor", "alpha": alpha}
        prints.append(Model(mi.load_dict(parts)).fingerprint)
    assert prints[0] == prints[1] != prints[2]
