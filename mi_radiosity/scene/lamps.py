"""The lamps of a scene one by one: named, dimmed and recoloured without reading the scene again."""

import copy
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned_vectors
from .lights import Light
from .model import Model


class Lamps:
    """What emits in a model: shapes, then lamps that are no surfaces, in an order that only names and geometry decide.

    ``names``: ids in the scene, or "lamp-K" for the K-th one if it has none. ``power``: what they emit, W [lamps, 3].
    """

    def __init__(self, model: Model):
        self.model = model
        patches, faces = model.patches, model.faces
        self._emission = np.array(patches.emission, dtype=np.float64).reshape(3, -1).T
        shape = np.where(self._emission.any(axis=1), faces.shape[np.array(patches.face)], -1)
        # Patches are in an order of their own, which is the same in every process.
        found, first = np.unique(shape, return_index=True)
        shapes = faces.scene.shapes()
        on_surface = sorted((shapes[s].id(), int(p), int(s)) for s, p in zip(found, first) if s >= 0)
        self._free = sorted((f for f in model.lights.free if any(f.power())), key=lambda f: f.emitter.id())
        ids = [name for name, _, _ in on_surface] + [f.emitter.id() for f in self._free]
        self.names = tuple(name or f"lamp-{k}" for k, name in enumerate(ids))
        self._number = np.full(len(shapes) + 1, -1)  # its last entry is that of patches that do not emit
        self._number[[s for _, _, s in on_surface]] = np.arange(len(on_surface))
        self._of_patch = self._number[shape]
        self._on_surface = len(on_surface)
        area = np.array(patches.area, dtype=np.float64)[:, None]
        surfaces = [(self._emission * area)[self._of_patch == k].sum(axis=0) for k in range(len(on_surface))]
        self.power = np.array([*surfaces, *(f.power() for f in self._free)], dtype=np.float64).reshape(-1, 3)

    def __len__(self) -> int:
        return len(self.names)

    def dimmed(self, scales: np.ndarray) -> Model:
        """The model with the lamps' emission times ``scales`` [lamps, 3]; all else, and its fingerprint, as it is."""
        factor = np.vstack([scales, np.ones(3)])
        model, lights, rays = copy.copy(self.model), copy.copy(self.model.lights), copy.copy(self.model.rays)
        emission = self._emission * factor[self._of_patch]
        rays.patches = replace(self.model.patches, emission=owned_vectors(mi.Color3f, emission))
        lights.exitance = self.model.lights.exitance * factor[self._number[self.model.faces.shape]]
        free = zip(self._free, scales[self._on_surface :])
        lights.free = [Dimmed(light, scale) for light, scale in free if scale.any()]
        model.patches, model.lights, model.rays = rays.patches, lights, rays
        return model


class Dimmed(Light):
    """A lamp that is no surface, times a colour."""

    def __init__(self, light: Light, scale: np.ndarray):
        super().__init__(light.emitter, light.centre, light.radius)
        self._light, self._scale = light, [float(x) for x in scale]
        self._color = mi.Color3f(*(dr.opaque(mi.Float, x) for x in self._scale))

    def power(self) -> list[float]:
        return [float(p) * s for p, s in zip(self._light.power(), self._scale)]

    def shoot(self, x: "mi.Float", y: "mi.Float", s: "mi.Float", t: "mi.Float") -> tuple:
        origin, direction, power = self._light.shoot(x, y, s, t)
        return origin, direction, power * self._color

    def sample(self, point: "mi.Point3f", s: "mi.Float", t: "mi.Float") -> tuple:
        direction, distance, irradiance = self._light.sample(point, s, t)
        return direction, distance, irradiance * self._color
