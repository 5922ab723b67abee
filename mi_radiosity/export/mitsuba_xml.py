"""A Mitsuba scene that shines by itself as the solution does: any Mitsuba shows it, with any integrator."""

import os
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..core.files import check_side_file, writing
from .cameras import Camera
from .geometry import LitMesh
from .ply import write_ply


def mesh_path(path: str | os.PathLike[str]) -> Path:
    """Where the mesh of an exported scene is: NAME_mesh.ply beside NAME.xml."""
    return Path(path).with_name(f"{Path(path).stem}_mesh.ply")


def check_mesh_path(path: str | os.PathLike[str]) -> None:
    """Raise RadiosityError if the mesh of an exported scene would overwrite a file of anything else."""
    check_side_file(mesh_path(path), _mark(path).encode(), Path(path))


def write_xml(mesh: LitMesh, path: str | os.PathLike[str], views: list[Camera]) -> None:
    """Write the scene, and its mesh as NAME_mesh.ply beside it: a black surface that emits B / π.

    Raises RadiosityError if files cannot be written, or if NAME_mesh.ply is another file than that of an earlier
    export.
    """
    path = Path(path)
    check_mesh_path(path)
    scene = ElementTree.Element("scene", version="3.0.0")
    integrator = _add(scene, "integrator", type="path")
    _add(integrator, "integer", name="max_depth", value="1")
    for view in views:
        _add_sensor(scene, view)
    shape = _add(scene, "shape", type="ply", id="solution")
    _add(shape, "string", name="filename", value=mesh_path(path).name)
    _add(shape, "boolean", name="face_normals", value="true")
    # Black, and of no diffuse lobe: integrators would look for lamps there, and cannot sample these.
    _add(_add(shape, "bsdf", type="conductor"), "rgb", name="specular_reflectance", value="0")
    texture = _add(_add(shape, "emitter", type="area"), "texture", type="mesh_attribute", name="radiance")
    _add(texture, "string", name="name", value="vertex_radiosity_color")
    _add(texture, "float", name="scale", value=repr(1 / np.pi))
    ElementTree.indent(scene, "    ")
    write_ply(mesh, mesh_path(path), exposure=None, comments=[_mark(path)])
    with writing(path) as temporary:
        ElementTree.ElementTree(scene).write(temporary, encoding="utf-8", xml_declaration=True)


def _mark(path):
    """The comment by which the mesh of an exported scene is known."""
    return f"mesh of {Path(path).name}".replace("\n", " ")


def _add_sensor(parent, view):
    """A sensor with its film; those in a batch are elements of it."""
    sensor = _add(parent, "sensor", type=view.kind, id=view.name)
    for member in view.members:
        _add_sensor(sensor, member)
    _add_numbers(sensor, _sensor_numbers(view))
    if view.kind in ("perspective", "thinlens"):
        _add(sensor, "string", name="fov_axis", value="x")
    if view.target:
        _add(sensor, "point", name="target", value=_text(view.target))
    if view.kind != "batch":
        _add(_add(sensor, "transform", name="to_world"), "matrix", value=_text(view.to_world.ravel()))
    _add_film(sensor, view.film)
    _add(_add(sensor, "sampler", type=view.sampler), "integer", name="sample_count", value=str(view.samples))


def _sensor_numbers(view):
    """The numbers that a sensor of its kind has, by name."""
    numbers = {"shutter_open": view.shutter[0], "shutter_close": view.shutter[1]} if any(view.shutter) else {}
    if view.kind in ("perspective", "thinlens", "orthographic"):
        numbers |= {"near_clip": view.near, "far_clip": view.far}
    if view.kind in ("perspective", "thinlens"):
        numbers |= {"fov": view.x_fov}
    if view.kind == "perspective":
        numbers |= {f"principal_point_offset_{axis}": value for axis, value in zip("xy", view.offset) if value}
    if view.kind == "thinlens":
        numbers |= {"aperture_radius": view.aperture_radius, "focus_distance": view.focus_distance}
    return numbers


def _add_film(sensor, about):
    film = _add(sensor, "film", type="hdrfilm")
    names = "width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height"
    for name, number in zip(names, (*about.size, *about.crop)):
        _add(film, "integer", name=name, value=str(number))
    for name, value in about.settings.items():
        _add(film, "string", name=name, value=value)
    if about.sample_border:
        _add(film, "boolean", name="sample_border", value="true")
    rfilter = _add(film, "rfilter", type=about.filter)
    lobes = about.filter_parameters.get("lobes")
    if lobes is not None:
        _add(rfilter, "integer", name="lobes", value=str(round(lobes)))
    _add_numbers(rfilter, {name: value for name, value in about.filter_parameters.items() if name != "lobes"})


def _add_numbers(parent, numbers):
    for name, value in numbers.items():
        _add(parent, "float", name=name, value=repr(value))


def _text(values: Iterable[float]) -> str:
    return " ".join(repr(float(x)) for x in values)


def _add(parent, tag, **attributes):
    return ElementTree.SubElement(parent, tag, attributes)
