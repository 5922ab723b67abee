"""The lamps of a scene one by one: named, dimmed and recoloured without reading the scene again."""

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned_vectors
from .lights import Light
from .model import Model


class Lamps:
    """What emits in a model: shapes, then lamps that are no surfaces, in an order that only names and geometry decide.

    ``names``: ids in the scene, or "lamp-K" for the K-th one if it has none. ``power``: what they emit, W [lamps, 3].
    Shapes of one id are one lamp, as those are that instances repeat.
    """

    def __init__(self, model: Model):
        self.model = model
        patches, faces = model.patches, model.faces
        self._emission = np.array(patches.emission, dtype=np.float64).reshape(3, -1).T
        shape = np.where(self._emission.any(axis=1), faces.shape[np.array(patches.face)], -1)
        # Patches are in an order of their own, which is the same in every process.
        found, first = np.unique(shape, return_index=True)
        on_surface: dict[tuple, list[int]] = {}
        for name, place, s in sorted(
            (faces.parts[s].shape.id(), int(p), int(s)) for s, p in zip(found, first) if s >= 0
        ):
            on_surface.setdefault((name,) if name else (name, place), []).append(s)
        free = [light for light in model.lights.free if any(light.power())]
        self._free = sorted(free, key=_identity)
        ids = [key[0] for key in on_surface] + [_identity(light) for light in self._free]
        self.names = tuple(name or f"lamp-{k}" for k, name in enumerate(ids))
        self._number = np.full(len(faces.parts) + 1, -1)  # its last entry is that of patches that do not emit
        for number, shapes in enumerate(on_surface.values()):
            self._number[shapes] = number
        self._of_patch = self._number[shape]
        self._on_surface = len(on_surface)
        area = np.array(patches.area, dtype=np.float64)[:, None]
        surfaces = [(self._emission * area)[self._of_patch == k].sum(axis=0) for k in range(len(on_surface))]
        self.power = np.array([*surfaces, *(f.power() for f in self._free)], dtype=np.float64).reshape(-1, 3)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def of_parts(self) -> np.ndarray:
        """The lamp that each part of the scene is, −1 for those that do not shine [parts]."""
        return self._number[:-1]

    def dimmed(self, scales: np.ndarray) -> Model:
        """The model with the lamps' emission times ``scales`` [lamps, 3]; all else, and its fingerprint, as it is."""
        factor, free = np.vstack([scales, np.ones(3)]), list(zip(self._free, scales[self._on_surface :]))
        model, rays = copy.copy(self.model), copy.copy(self.model.rays)
        model.fingerprint = self.model.fingerprint  # not that of dimmed lamps
        emission = owned_vectors(mi.Color3f, self._emission * factor[self._of_patch])
        model.patches = rays.patches = replace(self.model.patches, emission=emission)
        dimmed: list[Light] = [Dimmed(light, scale) for light, scale in free if scale.any()]
        model.lights, model.rays = self.model.lights.dimmed(factor[self._number[:-1]], dimmed), rays
        return model

    def exitance(self, exitance: "mi.Color3f | None", patch: "mi.UInt32", scales: np.ndarray) -> "mi.Color3f | None":
        """``exitance`` of elements of patches, where it varies over them, times the scales (Color3f [elements])."""
        if exitance is None:
            return None
        factor = np.vstack([scales, np.ones(3)])[self._of_patch]
        return exitance * dr.gather(mi.Color3f, owned_vectors(mi.Color3f, factor), patch)


def _identity(light):
    """The id of a lamp that is no surface: its own, or that of the shape it is on."""
    shape = light.emitter.get_shape()
    return light.emitter.id() or (shape.id() if shape is not None else "")


class Dimmed(Light):
    """A lamp that is no surface, times a colour."""

    def __init__(self, light: Light, scale: np.ndarray):
        super().__init__(light.emitter, light.scene, light.low, light.high)
        self._light, self._scale = light, [float(x) for x in scale]
        self.color = mi.Color3f(*(dr.opaque(mi.Float, x) for x in self._scale))

    def power(self) -> Sequence[float]:
        return [float(p) * s for p, s in zip(self._light.power(), self._scale)]

    def shoot(
        self, x: "mi.Float", y: "mi.Float", s: "mi.Float", t: "mi.Float"
    ) -> "tuple[mi.Point3f, mi.Vector3f, mi.Color3f]":
        origin, direction, power = self._light.shoot(x, y, s, t)
        return origin, direction, power * self.color

    def sample(self, point: "mi.Point3f", s: "mi.Float", t: "mi.Float") -> "tuple[mi.Vector3f, mi.Float, mi.Color3f]":
        direction, distance, irradiance = self._light.sample(point, s, t)
        return direction, distance, irradiance * self.color

    @property
    def may_be_sharp(self) -> bool:
        return self._light.may_be_sharp

    def is_sharp(self, direction: "mi.Vector3f") -> "mi.Bool":
        return self._light.is_sharp(direction)

    def density(self, direction: "mi.Vector3f") -> "mi.Float":
        return self._light.density(direction)

    def lights_up(self, rays: Any, *places: Any, **options: Any) -> "tuple[mi.Color3f, mi.Color3f, mi.Bool]":
        shared, alone, sharp = self._light.lights_up(rays, *places, **options)
        return shared * self.color, alone * self.color, sharp

    def fingerprint(self) -> bytes:
        return self._light.fingerprint()
