"""A Mitsuba scene that shines by itself as the solution does: any Mitsuba shows it, with any integrator."""

import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..core.files import writing
from .cameras import Camera
from .geometry import LitMesh
from .ply import write_ply


def write_xml(mesh: LitMesh, path: str | os.PathLike[str], views: list[Camera]) -> None:
    """Write the scene, and its mesh beside it as .ply: a black surface that emits B / π."""
    path = Path(path)
    scene = ElementTree.Element("scene", version="3.0.0")
    integrator = _add(scene, "integrator", type="path")
    _add(integrator, "integer", name="max_depth", value="1")
    for view in views:
        _add_sensor(scene, view)
    shape = _add(scene, "shape", type="ply", id="solution")
    _add(shape, "string", name="filename", value=path.with_suffix(".ply").name)
    _add(shape, "boolean", name="face_normals", value="true")
    # Black, and of no diffuse lobe: integrators would look for lamps there, and cannot sample these.
    _add(_add(shape, "bsdf", type="conductor"), "rgb", name="specular_reflectance", value="0")
    texture = _add(_add(shape, "emitter", type="area"), "texture", type="mesh_attribute", name="radiance")
    _add(texture, "string", name="name", value="vertex_radiosity_color")
    _add(texture, "float", name="scale", value=repr(1 / np.pi))
    ElementTree.indent(scene, "    ")
    write_ply(mesh, path.with_suffix(".ply"), exposure=None)
    with writing(path) as temporary:
        ElementTree.ElementTree(scene).write(temporary, encoding="utf-8", xml_declaration=True)


def _add_sensor(scene, view):
    sensor = _add(scene, "sensor", type="perspective", id=view.name)
    numbers = {"fov": view.x_fov, "near_clip": view.near, "far_clip": view.far}
    numbers |= {f"principal_point_offset_{axis}": value for axis, value in zip("xy", view.offset) if value}
    for name, value in numbers.items():
        _add(sensor, "float", name=name, value=repr(value))
    _add(sensor, "string", name="fov_axis", value="x")
    matrix = " ".join(repr(float(x)) for x in view.to_world.ravel())
    _add(_add(sensor, "transform", name="to_world"), "matrix", value=matrix)
    film = _add(sensor, "film", type="hdrfilm")
    names = "width", "height", "crop_offset_x", "crop_offset_y", "crop_width", "crop_height"
    for name, number in zip(names, (*view.size, *view.crop)):
        _add(film, "integer", name=name, value=str(number))
    for name, value in view.formats.items():
        _add(film, "string", name=name, value=value)
    _add(film, "rfilter", type=view.filter)
    _add(_add(sensor, "sampler", type="independent"), "integer", name="sample_count", value=str(view.samples))


def _add(parent, tag, **attributes):
    return ElementTree.SubElement(parent, tag, attributes)
