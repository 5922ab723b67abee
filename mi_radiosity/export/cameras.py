"""The sensors of a scene, for other programs."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from ..core.errors import warn_of
from ..display.film import film_settings
from ..scene.tessellate import children

PINHOLE = ("perspective", "thinlens")  # sensors that glTF and the page have cameras for
KINDS = {  # class of a sensor: its plugin
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "thinlens",
    "OrthographicCamera": "orthographic",
    "RadianceMeter": "radiancemeter",
    "DistantSensorImpl": "distant",
    "BatchSensor": "batch",
}
FILTERS: dict[str, tuple[str, Callable[["mi.ReconstructionFilter"], dict[str, float]]]] = {  # class: plugin, parameters
    "BoxFilter": ("box", lambda rfilter: {}),
    "TentFilter": ("tent", lambda rfilter: {"radius": rfilter.radius()}),
    "GaussianFilter": (
        "gaussian",
        lambda rfilter: {"stddev": rfilter.radius() / 4},
    ),  # Mitsuba cuts it off at 4 of them
    "MitchellNetravaliFilter": ("mitchell", lambda rfilter: _printed(rfilter, "B", "C")),
    "CatmullRomFilter": ("catmullrom", lambda rfilter: {}),
    "LanczosSincFilter": ("lanczos", lambda rfilter: {"lobes": rfilter.radius()}),
}


SAMPLERS = {  # class: plugin
    "IndependentSampler": "independent",
    "StratifiedSampler": "stratified",
    "MultijitterSampler": "multijitter",
    "OrthogonalSampler": "orthogonal",
    "LowDiscrepancySampler": "ldsampler",
}


@dataclass(frozen=True)
class Film:
    """A film: its size and window in pixels, and how pictures are made of samples."""

    size: tuple[int, int]
    crop: tuple[int, int, int, int]  # x, y, width, height
    settings: dict[str, str]  # pixel_format, component_format, file_format
    sample_border: bool
    filter: str
    filter_parameters: dict[str, float]


@dataclass(frozen=True)
class Camera:
    """A sensor: where it stands and how its pictures are made. Numbers that its kind has none of are 0."""

    name: str
    kind: str  # Mitsuba's plugin
    to_world: np.ndarray  # [4, 4]; it looks along +z, with +y up and +x to the left
    film: Film
    sampler: str  # Mitsuba's plugin
    samples: int
    shutter: tuple[float, float]  # opens and closes, s
    x_fov: float = 0.0  # degrees, across the width of the film
    near: float = 0.0  # m
    far: float = 0.0  # m
    offset: tuple[float, float] = (0.0, 0.0)  # of the principal point, in widths and heights of the film
    aperture_radius: float = 0.0  # m
    focus_distance: float = 0.0  # m
    target: tuple[float, ...] = ()  # of a distant sensor
    members: "list[Camera]" = field(default_factory=list)  # of a batch

    @property
    def y_fov(self) -> float:
        """Degrees, across the height of the film."""
        width, height = self.film.size
        return float(np.degrees(2 * np.arctan(np.tan(np.radians(self.x_fov) / 2) * height / width)))


def cameras(scene: "mi.Scene") -> list[Camera]:
    """The perspective sensors of a scene, those in batches included; others are left out."""
    found, _ = sensors(scene)
    return [camera for camera in _single(found) if camera.kind in PINHOLE]


def sensors(scene: "mi.Scene") -> tuple[list[Camera], list[str]]:
    """All sensors of a scene that can be described, and the names of the others."""
    found, others = [], []
    for number, sensor in enumerate(scene.sensors()):
        name = sensor.id() or f"sensor-{number}"
        camera = _camera(sensor, name)
        if camera is None:
            others.append(name)
        else:
            found.append(camera)
    return found, others


def warn_of_lost_cameras(scene: "mi.Scene", what: str) -> None:
    """Issue a RadiosityWarning for each sensor of which ``what``, a kind of file with pinhole cameras, keeps less than
    the scene says."""
    found, others = sensors(scene)
    for camera in _single(found):
        if camera.kind not in PINHOLE:
            others.append(camera.name)
            continue
        lost = ["thin lens"] * (camera.kind == "thinlens") + ["principal point"] * any(camera.offset)
        lost += ["crop window"] * (camera.film.crop != (0, 0, *camera.film.size))
        if lost:
            warn_of(f"sensor '{camera.name}': {what} has pinhole cameras, so its {' and '.join(lost)} is left out")
    for name in others:
        warn_of(f"sensor '{name}': {what} has perspective cameras only, so it is left out")


def _single(found):
    """Cameras, and in the place of batches the cameras in them."""
    return [single for camera in found for single in (camera.members or [camera])]


def _camera(sensor, name):
    """The Camera of a sensor, or None if it cannot be described."""
    values, kind = dict(mi.traverse(sensor)), KINDS.get(sensor.class_name())
    film = _film(sensor.film())
    target = _target(sensor) if kind == "distant" else ()
    members: list[Camera | None] = []
    if kind == "batch":
        inner = [child for child in children(sensor) if isinstance(child, mi.Sensor)]
        members = [_camera(child, child.id() or f"{name}-{number}") for number, child in enumerate(inner)]
    if kind is None or film is None or target is None or None in members:
        return None
    offset = (_number(values.get(f"principal_point_offset_{axis}", 0)) for axis in "xy")
    opens = float(sensor.shutter_open())
    return Camera(
        name=name,
        kind=kind,
        to_world=np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0],
        film=film,
        sampler=SAMPLERS.get(sensor.sampler().class_name(), "independent"),
        samples=int(sensor.sampler().sample_count()),
        shutter=(opens, opens + float(sensor.shutter_open_time())),
        x_fov=_number(values.get("x_fov", 0)),
        near=_number(values.get("near_clip", 0)),
        far=_number(values.get("far_clip", 0)),
        offset=tuple(offset),
        aperture_radius=_number(values.get("aperture_radius", 0)),
        focus_distance=_number(values.get("focus_distance", 0)),
        target=target,
        members=members,
    )


def _film(film):
    """The Film of an hdrfilm, or None of others."""
    settings, rfilter = film_settings(film), film.rfilter()
    if "pixel_format" not in settings or rfilter.class_name() not in FILTERS:
        return None
    plugin, parameters = FILTERS[rfilter.class_name()]
    names = ("pixel_format", "component_format", "file_format")
    return Film(
        size=tuple(int(x) for x in film.size()),
        crop=tuple(int(x) for x in (*film.crop_offset(), *film.crop_size())),
        settings={name: settings[name].lower() for name in names},
        sample_border=bool(film.sample_border()),
        filter=plugin,
        filter_parameters={name: float(value) for name, value in parameters(rfilter).items()},
    )


def _printed(thing, *names):
    """Parameters that Mitsuba shows only in a description."""
    return {name: float(re.search(rf"\b{name}=([\d.eE+-]+)", str(thing))[1]) for name in names}


def _target(sensor):
    """The point that a distant sensor looks at, () if it has none; None if it looks at a shape."""
    text = str(sensor)
    point = re.search(r"target = \[+([^\]]*)\]", text)
    if point:
        return tuple(float(x) for x in point[1].split(","))
    return () if re.search(r"target = none", text) else None


def _number(value):
    return float(np.array(value).ravel()[0])


def up(scene: "mi.Scene") -> np.ndarray:
    """The axis of the scene that is nearest to what its first camera has above it, +y without one (float [3])."""
    found = cameras(scene)
    above = found[0].to_world[:3, 1] if found else np.array([0.0, 1.0, 0.0])
    axis = np.abs(above).argmax()
    return np.eye(3)[axis] * np.sign(above[axis])
