"""Pictures: continuity, the integrator, agreement with path, kept solutions."""

from dataclasses import replace

import mi_radiosity as mr
from mi_radiosity.solver import Field

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import border_values, diffuse, gaps_between_leaves, lamp, rectangle, scene


@pytest.fixture(scope="module")
def solution(cornell):
    return mr.solve(cornell, elements=3000, rays=200_000)


def test_the_field_is_continuous(solution):
    """Wherever two leaves of one surface meet, hanging vertices included, they agree."""
    gaps = gaps_between_leaves(solution)
    assert len(gaps) > 3000 and gaps.max() < 1e-4


def test_the_field_stops_at_edges(solution):
    """Floor and wall do not share values where they meet."""
    points, normals, values, _ = border_values(solution)
    key = np.round(points * 2**14).astype(np.int64)
    order = np.lexsort(key.T)
    same = (key[order][1:] == key[order][:-1]).all(axis=1) & (
        np.abs((normals[order][1:] * normals[order][:-1]).sum(axis=1)) < 0.5
    )
    assert (np.abs(values[order][1:] - values[order][:-1]).max(axis=1)[same] > 1e-3).mean() > 0.5


def test_a_constant_field_stays_constant():
    furnace = mi.load_file("scenes_xml/box_furnace.xml")
    solution = mr.solve(furnace, elements=600, rays=20_000)
    n = len(solution.elements)
    solution = replace(solution, direct=dr.full(mi.Color3f, 1, n), indirect=dr.full(mi.Color3f, 2, n))
    leaves = np.array(solution.elements.leaves)
    nodes = np.array(Field(solution).nodes).reshape(3, -1, 6)[:, leaves]
    assert nodes == pytest.approx(3, rel=1e-6)


@pytest.mark.parametrize("shading", ["gouraud", "flat"])
def test_picture_agrees_with_path(cornell, shading):
    """The image means of solver and path agree within 1 %, and no pixel block is far off."""
    ours = np.array(mr.solve(cornell, elements=6000, rays=1_000_000).render(spp=32, shading=shading))
    path = np.array(mi.render(cornell, integrator=mi.load_dict({"type": "path", "max_depth": -1}), spp=64))
    assert ours.mean() == pytest.approx(path.mean(), rel=0.01)

    def blocks(image):
        return image.reshape(16, 16, 16, 16, 3).mean(axis=(1, 3))

    difference = np.abs(blocks(ours) - blocks(path))
    assert np.median(difference / blocks(path).clip(1e-3)) < 0.03


def test_second_view_solves_nothing(solution, monkeypatch):
    monkeypatch.setattr("mi_radiosity.display.integrator.solve", lambda *a, **k: pytest.fail("solved again"))
    assert np.array(solution.render(spp=1)).shape == (256, 256, 3)


def test_outlines_darken(solution):
    plain, mesh = (np.array(solution.render(spp=4, shading=s)) for s in ("gouraud", "mesh"))
    assert 0.4 < mesh.mean() / plain.mean() < 0.97


def test_integrator_from_a_dictionary_solves_once(cornell, monkeypatch):
    from mi_radiosity.display import integrator as module

    calls = []
    monkeypatch.setattr(module, "solve", lambda *a, **k: calls.append(k) or mr.solve(*a, **k))
    plugin = mi.load_dict({"type": "radiosity", "oracle": "ks", "elements": 500, "rays": 20_000, "seed": 3})
    first = np.array(mi.render(cornell, integrator=plugin, spp=1))
    mi.render(cornell, integrator=plugin, spp=2)
    assert len(calls) == 1 and calls[0]["elements"] == 500 and first.mean() > 0
    plugin.parameters_changed([])
    mi.render(cornell, integrator=plugin, spp=1)
    assert len(calls) == 2 and "ks" in plugin.to_string().lower()


def test_inside_aov_and_from_xml(tmp_path):
    file = tmp_path / "scene.xml"
    text = open("scenes_xml/box_furnace.xml").read()
    integrator = (
        '<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="radiosity">'
        '<integer name="elements" value="100"/><integer name="rays" value="9000"/></integrator></integrator>'
    )
    file.write_text(
        text.replace('<integrator type="path"><integer name="max_depth" value="-1"/></integrator>', integrator)
    )
    image = np.array(mi.render(mi.load_file(str(file)), spp=4))
    assert image.shape == (64, 64, 4)
    assert image[..., :3].mean() == pytest.approx(2 / np.pi, rel=0.05) and image[..., 3].min() > 0


def test_misses_are_black_and_finite():
    plate = scene(
        lamp=rectangle(bsdf=diffuse(), emitter=lamp()),
        other=rectangle(mi.ScalarTransform4f().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.2), bsdf=diffuse()),
    )
    image = np.array(mr.solve(plate, elements=20, rays=1000).render(spp=4))
    assert np.isfinite(image).all() and image[0, 0].max() == 0


def test_save_and_load(solution, cornell, tmp_path):
    solution.save(tmp_path / "kept.npz")
    again = mr.Solution.load(tmp_path / "kept.npz", cornell)
    np.testing.assert_allclose(np.array(again.render(spp=1)), np.array(solution.render(spp=1)), rtol=1e-5, atol=1e-6)
    assert again.stats == solution.stats


def test_refused_solutions(solution, tmp_path):
    file = tmp_path / "kept.npz"
    solution.save(file)
    with pytest.raises(mr.RadiosityError, match="another scene"):
        mr.Solution.load(file, mi.load_file("scenes_xml/box_furnace.xml"))
    file.write_bytes(file.read_bytes()[:2000])
    with pytest.raises(mr.RadiosityError, match="not a readable solution"):
        mr.Solution.load(file, solution.model)
    with pytest.raises(mr.RadiosityError, match="does not exist"):
        mr.Solution.load(tmp_path / "none.npz", solution.model)


def test_unknown_shading_and_sensor(solution):
    with pytest.raises(mr.RadiosityError, match="shading"):
        solution.render(shading="toon")
    with pytest.raises(mr.RadiosityError, match="sensor 3"):
        solution.render(3)
    with pytest.raises(mr.RadiosityError, match="spp"):
        solution.render(spp=0)


def box(low, high, rho, **parts):
    """A box between two corners."""
    low, high = np.array(low), np.array(high)
    place = mi.ScalarTransform4f().translate((low + high) / 2).scale((high - low) / 2)
    return {"type": "cube", "to_world": place, "bsdf": diffuse(rho, two_sided=True), **parts}


@pytest.mark.parametrize("elements", [200, 1500])
def test_legs_that_end_in_solids_are_lit(elements):
    """Legs of a table that go through its top and the floor, so that all corners of their elements are inside of
    something: as bright in Gouraud shading as in flat, to 2 %, which is what `path` shows, to 30 % on so few
    elements."""
    T = mi.ScalarTransform4f
    feet = [(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    room = mi.load_dict(
        {
            "type": "scene",
            "leg in the middle of the picture": {
                "type": "perspective",
                "fov": 3,
                "to_world": T().look_at([1.7, 1.6, 0.45], [0.5, 0.5, 0.45], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}},
            },
            "room": box([-2, -2, 0], [2, 2, 4], 0.5, flip_normals=True),
            "top": box([-0.6, -0.6, 1], [0.6, 0.6, 1.1], 0.6),
            "lamp": rectangle(
                T().translate([1, 1, 3.9]).rotate([1, 0, 0], 180).scale(0.4), bsdf=diffuse(), emitter=lamp(15)
            ),
        }
        | {
            f"leg {k}": box([x - 0.03, y - 0.03, -0.05], [x + 0.03, y + 0.03, 1.05], 0.6)
            for k, (x, y) in enumerate(feet)
        }
    )
    solution = mr.solve(room, elements=elements, rays=300 * elements)
    gouraud, flat = (np.mean(solution.render(spp=64, shading=shading)) for shading in ("gouraud", "flat"))
    path = np.mean(mi.render(room, integrator=mi.load_dict({"type": "path", "max_depth": -1}), spp=256))
    assert gouraud == pytest.approx(flat, rel=0.02) and gouraud == pytest.approx(path, rel=0.3)
