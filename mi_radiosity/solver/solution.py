"""What a solve leaves behind."""

import json
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.files import writing
from ..scene import Model
from ..scene.faces import owned
from ..mesh.elements import Elements

FORMAT = 2
TREE = ("patch", "parent", "child", "place", "u0", "v0", "scale", "open_area", "across")
COLORS = ("reflectance", "direct", "indirect")


@dataclass
class Solution:
    """Radiosity of a scene, good for every view of it.

    model: the scene as patches. elements: the element tree. direct, indirect: irradiance H in W/m²
    (Color3f [elements]) from the first flight of the lamps' light and from all later ones; interior
    elements hold the area average. stats: the numbers of the run (see README).
    """

    model: Model
    elements: Elements
    direct: "mi.Color3f"
    indirect: "mi.Color3f"
    stats: dict

    def irradiance(self):
        """H = direct + indirect, W/m² (Color3f [elements])."""
        return self.direct + self.indirect

    def radiosity(self):
        """B = E + ρ H, W/m² (Color3f [elements])."""
        return (
            dr.gather(mi.Color3f, self.model.emission, self.elements.patch)
            + self.elements.reflectance * self.irradiance()
        )

    def render(self, sensor=0, spp=16, shading="gouraud", seed=0):
        """Picture from a sensor (mi.Sensor or its number) as mi.TensorXf; nothing is solved again."""
        from ..display import render  # display builds on solver; this is its doorbell

        return render(self, sensor, spp=spp, shading=shading, seed=seed)

    def save(self, path):
        """Write the solution as NumPy archive (.npz); no file is left half-written."""
        e = self.elements
        arrays = {name: np.array(getattr(e, name)) for name in TREE}
        for name, color in zip(COLORS, (e.reflectance, self.direct, self.indirect)):
            arrays[name] = np.array(color, dtype=np.float32).reshape(3, -1)
        with writing(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                format=FORMAT,
                fingerprint=self.model.fingerprint,
                sides=self.model.sides,
                stats=json.dumps(self.stats),
                **arrays,
            )

    @staticmethod
    def load(path, scene):
        """Read a solution of ``scene``.

        Raises RadiosityError if the file is no solution, is damaged, or belongs to another scene.
        """
        try:
            with np.load(path) as file:
                data = {name: file[name] for name in file.files}
            if int(data["format"]) != FORMAT:
                raise RadiosityError(f"{path} was written by another version: solve the scene again")
            stats = json.loads(str(data["stats"]))
            fingerprint, sides = str(data["fingerprint"]), data["sides"]
            tree, colors = {name: data[name] for name in TREE}, {name: data[name] for name in COLORS}
        except FileNotFoundError:
            raise RadiosityError(f"{path} does not exist: save a solution first") from None
        except RadiosityError:
            raise
        except Exception as error:
            raise RadiosityError(
                f"{path} is not a readable solution ({type(error).__name__}): solve the scene again"
            ) from None
        model = scene if isinstance(scene, Model) else Model(scene)
        if fingerprint != model.fingerprint:
            raise RadiosityError(
                f"{path} belongs to another scene: solve this one, or load the scene it was saved from"
            )
        model.use_sides(sides)
        elements = Elements(model)
        for name, array in tree.items():
            setattr(elements, name, owned(mi.Float if array.dtype.kind == "f" else mi.UInt32, array))

        def color(name):
            return mi.Color3f(*(owned(mi.Float, c) for c in colors[name]))

        elements.reflectance = color("reflectance")
        elements.area = dr.gather(mi.Float, model.area, elements.patch) * elements.scale**2
        elements.leaves = int((tree["child"] == 0).sum())
        return Solution(model, elements, color("direct"), color("indirect"), stats)
