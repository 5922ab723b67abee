"""Lamps: one class per kind, and all lamps of a scene behind one face."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.plugins import Registry

LIGHTS = Registry("emitter")


class Light:
    """A kind of lamp. A subclass names, as ``emitters``, the classes of Mitsuba's emitters it stands for.

    A kind that covers surfaces says ``on_surface = True`` and defines `exitance`: its light leaves from patches,
    as all reflected light does. Any other kind is made once per lamp, with ``emitter`` and the scene's bounding
    sphere (``centre`` [3], ``radius``), and defines `power`, `shoot` and `sample`. Places are those of the scene, in m.
    """

    emitters: tuple[str, ...] = ()
    on_surface = False

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        for name in vars(cls).get("emitters", ()):
            LIGHTS.add(name, cls)

    def __init__(self, emitter, centre, radius):
        self.emitter, self.centre, self.radius = emitter, centre, radius

    @staticmethod
    def exitance(shapes):
        """E = π L_e of shapes with such a lamp, W/m² (NumPy [shapes, 3])."""
        raise NotImplementedError

    def power(self):
        """What `shoot` sends into the scene, W (three floats)."""
        raise NotImplementedError

    def shoot(self, x, y, s, t):
        """Rays from four uniform numbers each (Float [n]): origin, unit direction, and the power each would
        carry were it the only one, whose mean is `power` (Point3f, Vector3f, Color3f [n])."""
        raise NotImplementedError

    def sample(self, point, s, t):
        """Towards the lamp from points, with two uniform numbers each: unit direction, distance, and the irradiance
        of an unblocked surface that faces that way, over the density of the sample (Vector3f, Float, Color3f [n])."""
        raise NotImplementedError


class Area(Light):
    """Mitsuba's `area` with a constant radiance L_e."""

    emitters = ("AreaLight",)
    on_surface = True

    @staticmethod
    def exitance(shapes):
        si = dr.zeros(mi.SurfaceInteraction3f, len(shapes))
        si.wi = mi.Vector3f(0, 0, 1)
        pointers = mi.ShapePtr(list(shapes))
        return np.pi * np.array(mi.Color3f(pointers.emitter().eval(si)), dtype=np.float64).reshape(3, -1).T


class Lights:
    """The lamps of a scene: ``exitance`` of its faces, W/m² [faces, 3], and the ``free`` ones that are no surfaces.

    Raises RadiosityError if there is no light where it is ``required``, or if a lamp's is impossible, naming the shape.
    """

    def __init__(self, faces, required=True):
        self.exitance, self.required = self._of_faces(faces), required
        box = faces.corners.min(axis=(0, 1)), faces.corners.max(axis=(0, 1))
        centre, radius = (box[0] + box[1]) / 2, float(np.linalg.norm(box[1] - box[0]) / 2)
        kinds = [(emitter, LIGHTS.find(emitter.class_name())) for emitter in faces.scene.emitters()]
        self.free = [kind(emitter, centre, radius) for emitter, kind in kinds if not kind.on_surface]
        lit = (self.exitance * faces.area[:, None]).any() or any(any(light.power()) for light in self.free)
        if required and not lit:
            raise RadiosityError("the scene has no light: give at least one shape an 'area' emitter")

    @staticmethod
    def _of_faces(faces):
        shapes = faces.scene.shapes()
        by_kind: dict[type, list[int]] = {}
        for number, shape in enumerate(shapes):
            if shape.is_emitter():
                by_kind.setdefault(LIGHTS.find(shape.emitter().class_name()), []).append(number)
        exitance = np.zeros((len(shapes), 3))
        for kind, numbers in by_kind.items():
            exitance[numbers] = kind.exitance([shapes[n] for n in numbers])
        exitance = exitance[faces.shape]
        faces.refuse(
            ~np.isfinite(exitance).all(axis=1) | (exitance < 0).any(axis=1),
            "emits a radiance that is negative or not a number: repair its emitter",
        )
        return exitance
