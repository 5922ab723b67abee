"""Mean reflectance and emission of faces and elements against exact means, for textures of any period."""

import mi_radiosity as mr
from mi_radiosity.export.geometry import lit_mesh
from mi_radiosity.export.textures import textures
from mi_radiosity.mesh import Tree
from mi_radiosity.scene import Model

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import diffuse, lamp, rectangle, scene

AT = mi.ScalarTransform4f
PERIODS = [1, 2, 4, 7, 16, 64, 89, 144, 250, 500]
TILE = np.full((32, 32, 3), 0.9, dtype=np.float32)
TILE[:4] = TILE[:, :4] = 0.05  # grout
PRINT = np.random.default_rng(7).uniform(0, 1, (5, 7, 3)).astype(np.float32) ** 3
COLORS = 0.1, 0.7


def bitmap(data, repeats=1.0, **more):
    return {
        "type": "bitmap",
        "raw": True,
        "data": mi.TensorXf(data),
        "to_uv": AT().scale([repeats, repeats, 1]),
        **more,
    }


def checkers(repeats):
    low, high = ({"type": "rgb", "value": c} for c in COLORS)
    return {"type": "checkerboard", "color0": low, "color1": high, "to_uv": AT().scale([repeats, repeats, 1])}


TEXTURES = {  # of a number of repeats, and their exact means
    "tiles": (lambda n: bitmap(TILE, n), TILE.mean(axis=(0, 1))),
    "print": (lambda n: bitmap(PRINT, n), PRINT.mean(axis=(0, 1))),
    "nearest": (lambda n: bitmap(PRINT, n, filter_type="nearest"), PRINT.mean(axis=(0, 1))),
    "checkers": (checkers, np.full(3, np.mean(COLORS))),
}


def floor(texture, **parts):
    """A textured floor under a plain emitter."""
    above = AT().translate([0, 0, 1]).rotate([1, 0, 0], 180).scale(0.3)
    shapes = {
        "floor": rectangle(bsdf={"type": "diffuse", "reflectance": texture}),
        "lamp": rectangle(above, emitter=lamp()),
    }
    return scene(optimize=False, **(shapes | parts))


def mean_over(model, shape, values, area, patch):
    """Mean over the rows whose patch is on a shape, by area [3]."""
    number = next(k for k, part in enumerate(model.faces.parts) if part.shape.id() == shape)
    on = model.faces.shape[np.array(model.patches.face)[patch]] == number
    return np.average(values[on], weights=area[on], axis=0)


def split_often(model, times=3):
    """Leaves of a mesh whose every element is split so often."""
    tree = Tree(model.patches, model.materials, model.lights)
    for _ in range(times):
        tree.split(dr.compress(tree.child == 0))
    return tree.freeze()


@pytest.mark.parametrize("name", TEXTURES)
def test_mean_reflectance_whatever_the_period(name):
    """Faces, and elements at every depth, have the exact mean over the floor to 1 %."""
    texture, exact = TEXTURES[name]
    for repeats in PERIODS:
        model = Model(floor(texture(repeats)))
        elements = split_often(model)
        rho, area = np.array(elements.reflectance).T, np.array(elements.area)
        patch, depth = np.array(elements.patch), np.array(elements.level(dr.arange(mi.UInt32, len(elements))))
        for level in range(4):
            at = depth == level
            found = mean_over(model, "floor", rho[at], area[at], patch[at])
            np.testing.assert_allclose(found, exact, rtol=0.01, err_msg=f"{repeats} repeats, depth {level}")


@pytest.mark.parametrize("name", TEXTURES)
def test_mean_emission_whatever_the_period(name):
    """The same of the exitance of a textured emitter."""
    texture, exact = TEXTURES[name]
    for repeats in PERIODS[::3]:
        emitter = {"type": "area", "radiance": texture(repeats)}
        shapes = {
            "lamp": rectangle(emitter=emitter),
            "roof": rectangle(AT().translate([0, 0, 1]), bsdf=diffuse(0.5, True)),
        }
        model = Model(scene(optimize=False, **shapes))
        elements = split_often(model)
        E, area, patch = np.array(elements.exitance).T, np.array(elements.area), np.array(elements.patch)
        leaf = np.array(elements.child) == 0
        for at in (leaf, ~leaf):
            found = mean_over(model, "lamp", E[at], area[at], patch[at])
            np.testing.assert_allclose(found, np.pi * exact, rtol=0.01, err_msg=f"{repeats} repeats")


def test_large_coordinates_and_wrap_modes():
    """Coordinates of a mesh that repeat a texture, mirrored and clamped: against the mean of very many points."""
    for wrap in ("repeat", "mirror", "clamp"):
        for filter_type in ("bilinear", "nearest"):
            texture = mi.load_dict(bitmap(PRINT, wrap_mode=wrap, filter_type=filter_type))
            shape = uv_mesh(37.3, bitmap(PRINT, wrap_mode=wrap, filter_type=filter_type))
            model = Model(floor(diffuse(), floor=shape))
            steps = (np.arange(2000) + 0.5) / 2000
            u, v = (37.3 * x.ravel().astype(np.float32) for x in np.meshgrid(steps, steps))
            si = dr.zeros(mi.SurfaceInteraction3f, len(u))
            si.uv = mi.Point2f(mi.Float(u), mi.Float(v))
            exact = np.array(texture.eval_3(si)).mean(axis=1)
            patch = np.arange(model.patches.count)
            rho, area = np.array(model.patches.reflectance).T, np.array(model.patches.area)
            found = mean_over(model, "floor", rho, area, patch)
            np.testing.assert_allclose(found, exact, rtol=0.01, err_msg=f"{wrap}, {filter_type}")


def uv_mesh(repeats, texture):
    """A square of two triangles whose texture coordinates go from 0 to ``repeats``."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": texture})
    shape = mi.Mesh("floor", 4, 2, props=properties, has_vertex_texcoords=True)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(np.column_stack([2 * corners - 1, np.zeros(4)]).astype(np.float32).ravel())
    params["vertex_texcoords"] = mi.Float((repeats * corners).astype(np.float32).ravel())
    params["faces"] = mi.UInt32(np.array([[0, 1, 2], [0, 2, 3]], dtype=np.uint32).ravel())
    params.update()
    return shape


def test_constant_reflectances_are_exact_beside_textures():
    """To the bit, in elements too."""
    wall = rectangle(AT().translate([2.5, 0, 0.5]), bsdf=diffuse(0.3, True))
    model = Model(floor(checkers(8), wall=wall))
    elements = split_often(model, 2)
    number = next(k for k, part in enumerate(model.faces.parts) if part.shape.id() == "wall")
    face = np.array(model.patches.face)[np.array(elements.patch)]
    rho = np.array(elements.reflectance)[:, model.faces.shape[face] == number]
    assert rho.size and np.all(rho == np.float32(0.3))


def test_means_do_not_depend_on_the_order_of_shapes():
    """The same shapes in another order, under other names, have the same means to the bit."""
    side = {name: rectangle(AT().translate([x, 0, 0]), bsdf={"type": "diffuse", "reflectance": checkers(n)})
            for name, x, n in (("a", 2.5, 3), ("b", -2.5, 70), ("c", 5, 9))}  # fmt: skip
    found = []
    for names in ("abc", "cba"):
        shapes = {f"{k}{name}": side[name] for k, name in enumerate(names)}
        elements = split_often(Model(floor(checkers(8), **shapes)), 2)
        found.append(np.array(elements.reflectance))
    np.testing.assert_array_equal(*found)


def test_masked_textures():
    """ρ of the diffuse lobe behind a mask of opacity 0.6 is 0.6 times the mean."""
    for repeats in (1, 16, 64, 250):
        texture = {"type": "diffuse", "reflectance": bitmap(TILE, repeats)}
        model = Model(floor(diffuse(), floor=rectangle(bsdf={"type": "mask", "opacity": 0.6, "nested": texture})))
        rho, area = np.array(model.patches.reflectance).T, np.array(model.patches.area)
        found = mean_over(model, "floor", rho, area, np.arange(model.patches.count))
        np.testing.assert_allclose(found, 0.6 * TILE.mean(axis=(0, 1)), rtol=0.02, err_msg=str(repeats))


@pytest.mark.parametrize(
    "repeats, name", [(3, "tiles"), (64, "tiles"), (512, "tiles"), (7, "checkers"), (512, "checkers")]
)
def test_exported_textures_have_the_mean(repeats, name):
    """Pictures that are too small for all texels hold means of texels."""
    texture, exact = TEXTURES[name]
    solution = mr.solve(floor(texture(repeats)), elements=100, rays=5_000)
    (picture,) = textures(lit_mesh(solution), solution.model.faces.parts).values()
    np.testing.assert_allclose(picture.image.mean(axis=(0, 1)), exact, rtol=0.01)
