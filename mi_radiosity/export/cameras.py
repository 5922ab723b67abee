"""The perspective sensors of a scene, for other programs."""

import re
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

KINDS = {"PerspectiveCamera", "ThinLensCamera"}


@dataclass(frozen=True)
class Camera:
    """A perspective sensor: where it stands and how its pictures are made."""

    name: str
    to_world: np.ndarray  # [4, 4]; it looks along +z, with +y up and +x to the left
    x_fov: float  # degrees, across the width of the film
    near: float  # m
    far: float  # m
    offset: tuple[float, float]  # of the principal point, in widths and heights of the film
    size: tuple[int, int]  # pixels
    crop: tuple[int, int, int, int]  # x, y, width, height
    filter: str
    formats: dict[str, str]  # pixel_format, component_format
    samples: int

    @property
    def y_fov(self) -> float:
        """Degrees, across the height of the film."""
        width, height = self.size
        return float(np.degrees(2 * np.arctan(np.tan(np.radians(self.x_fov) / 2) * height / width)))


def cameras(scene: "mi.Scene") -> list[Camera]:
    """What is known of the perspective sensors of a scene; others are left out."""
    return [_camera(sensor, number) for number, sensor in enumerate(scene.sensors()) if sensor.class_name() in KINDS]


def _camera(sensor, number):
    values, film = dict(mi.traverse(sensor)), sensor.film()
    return Camera(
        name=sensor.id() or f"sensor-{number}",
        to_world=np.array(sensor.world_transform().matrix, dtype=np.float64).reshape(4, 4, -1)[..., 0],
        x_fov=_number(values["x_fov"]),
        near=float(sensor.near_clip()),
        far=float(sensor.far_clip()),
        offset=(_number(values["principal_point_offset_x"]), _number(values["principal_point_offset_y"])),
        size=tuple(int(x) for x in film.size()),
        crop=tuple(int(x) for x in (*film.crop_offset(), *film.crop_size())),
        filter=film.rfilter().class_name().removesuffix("Filter").lower(),
        formats=dict(re.findall(r"\b(pixel_format|component_format) = (\w+)", str(film))),
        samples=int(sensor.sampler().sample_count()),
    )


def _number(value):
    return float(np.array(value).ravel()[0])


def up(scene: "mi.Scene") -> np.ndarray:
    """The axis of the scene that is nearest to what its first camera has above it, +y without one (float [3])."""
    found = cameras(scene)
    above = found[0].to_world[:3, 1] if found else np.array([0.0, 1.0, 0.0])
    axis = np.abs(above).argmax()
    return np.eye(3)[axis] * np.sign(above[axis])
