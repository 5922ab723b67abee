"""What a solve leaves behind."""

import json
import os
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import NONE, opaque_index, owned, owned_vectors
from ..core.color import LUMENS_PER_WATT, LUMINANCE
from ..core.errors import RadiosityError
from ..core.files import writing
from ..core.llvm import require_variant
from ..core.numbers import real_number, whole_number
from ..mesh import Elements, Exposure, Scattering
from ..mesh.crown import Crown
from ..mesh.elements import mean_exitance
from ..mesh.subdivision import NODES
from ..scene import Model
from ..scene.lamps import Lamps
from ..scene.nearest import nearest_face
from ..transport import Gatherer, ViewFactors, view_factors
from ..transport.landings import Landings
from ..transport.probe import probe
from .field import Field
from .layers import ARRAYS, Layers, Scales

FORMAT = 5
TREE = ("patch", "parent", "child", "place", "u0", "v0", "scale")
COLORS = ("reflectance", "direct", "indirect")
PARTS = ("caustic", "sharp")  # where there is some
EXPOSURE = ("open_area", "crossed", "slot")


@dataclass(frozen=True)
class Leaves:
    """The leaves of a solution as NumPy arrays, one row each."""

    vertices: np.ndarray  # [leaves, 3, 3] m, in the coordinates of the scene
    shape: np.ndarray  # [leaves] number of the shape in scene.shapes()
    face: np.ndarray  # [leaves] number of the face within its shape, or within the member of an instance
    back: np.ndarray  # [leaves] bool: the back of the face
    level: np.ndarray  # [leaves] how often its patch was split
    area: np.ndarray  # [leaves] m²
    open_area: np.ndarray  # [leaves] m² that nothing covers
    irradiance: np.ndarray  # [leaves, 3] W/m²
    radiosity: np.ndarray  # [leaves, 3] W/m²

    def __len__(self) -> int:
        return len(self.area)


@dataclass(frozen=True)
class Solution:
    """Radiosity of a scene, good for every view of it.

    model: the scene as patches. elements: the mesh. exposure: what of it is open. direct, indirect: irradiance H in
    W/m² (Color3f [elements]), straight from the lamps and all other; interior elements hold the area average.
    landings: where light came down on leaves that a wall crosses. stats: the numbers of the run (see README). layers:
    the light of every lamp by itself, if it was asked for. caustic: the part of ``indirect`` that only shooting finds
    (see `Flow`): surfaces show it as sharp as elements are, and points in free space are not told of it. sharp: the
    part of ``direct`` that is as if from points (see `Flow`); who gathers light looks for that by himself.
    """

    model: Model
    elements: Elements
    exposure: Exposure
    direct: "mi.Color3f"
    indirect: "mi.Color3f"
    landings: Landings
    stats: dict
    layers: Layers | None = None
    caustic: "mi.Color3f | None" = None
    sharp: "mi.Color3f | None" = None

    def irradiance(
        self,
        points: ArrayLike | None = None,
        normals: ArrayLike | None = None,
        *,
        lux: bool = False,
        samples: int = 1024,
        seed: int = 0,
        return_error: bool = False,
        progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
    ) -> "np.ndarray | tuple[np.ndarray, np.ndarray] | mi.Color3f":
        """Irradiance H at any points of the scene, gathered there: W/m² per channel (NumPy [n, 3]), or with ``lux``
        illuminance, lx (NumPy [n]): 179 lm/W times the luminance of H by Rec. 709's weights.

        points [n, 3] in m; normals [n, 3], of any length, towards the side that is lit; samples: lines to the lamps,
        and as many rays into the room, per point, rounded up to a multiple of 16. With ``return_error`` the result is
        a pair: the values and their standard errors, which are rather too large than too small, and do not know of
        the errors of the solution. Light of lamps that no ray can meet, such as `point`, which comes through glass or
        off mirrors, is known of surfaces only: points within 1 % of the scene's diagonal of one have its.
        Without points: H of all elements (Color3f [elements]).
        Raises RadiosityError for points or normals that are not finite, or do not fit together.
        """
        if points is None:
            return self.direct + self.indirect
        where, towards = _checked_points(points, normals)
        samples, seed = whole_number("samples", samples), whole_number("seed", seed, None)
        report = partial(progress, "gather")
        found = probe(self.gatherer, self.model, where, towards, samples, seed, lambda done: report(done, len(where)))
        if self.caustic is not None and len(where):
            hit, near = self._surface_at(where, towards)
            found[0][:] += self._on_patches(Field(self, self.caustic), hit, near)
        if lux:
            # The channels' errors go together, as their samples are the same.
            found = (LUMENS_PER_WATT * found[0] @ LUMINANCE, LUMENS_PER_WATT * found[1] @ LUMINANCE)
        return found if return_error else found[0]

    def radiosity(self, points: ArrayLike | None = None, normals: ArrayLike | None = None) -> "np.ndarray | mi.Color3f":
        """B = E + ρ H, W/m², of the continuous field on the surface nearest to each point (NumPy [n, 3]); NaN for
        points farther from all than 1 % of the scene's diagonal. Where a face transmits diffusely, τ H of its other
        side is added.

        points [n, 3] in m; normals [n, 3], of any length: which side of a surface is meant; by default the front, or
        the back if light reaches only that. Without points: B of all elements (Color3f [elements]).
        Raises RadiosityError for points or normals that are not finite, or do not fit together.
        """
        if points is None:
            every = dr.arange(mi.UInt32, len(self.elements))
            return self.elements.emission(every) + self.scattering.of_elements(self.irradiance())
        where, given = _checked_points(points, (0, 0, 1) if normals is None else normals)
        if len(where) == 0:
            return np.zeros((0, 3))
        hit, near = self._surface_at(where, None if normals is None else given)
        return np.where(np.array(near)[:, None], np.array(self._shown_radiosity(hit)).T, np.nan)

    def _surface_at(self, points, normals):
        """The surface nearest to points, on the side of the normals, or of what is lit without (Hit); and is it near?
        (Bool [n])"""
        model, rays = self.model, self.model.rays
        towards = np.zeros_like(points) if normals is None else normals
        face, u, v, near = nearest_face(model.faces, points, towards, model.faces.lift)
        facing = dr.dot(owned_vectors(mi.Vector3f, towards), dr.gather(mi.Vector3f, rays.front, face))
        front, back = (rays.side(face, dr.full(mi.Bool, side, len(points)), u, v, near) for side in (False, True))
        return dr.select(front.patch == NONE if normals is None else facing < 0, back, front), near

    def _on_patches(self, field, hit, active):
        """A field where something meets patches, 0 where not (NumPy [n, 3])."""
        lit = active & (hit.patch != NONE)
        leaf = self.elements.leaf_at(hit.patch, hit.u, hit.v, lit)
        return np.array(dr.select(lit, field.at(leaf, hit.u, hit.v, lit), 0)).T

    def _shown_radiosity(self, hit):
        """B where something meets patches, 0 where not (Color3f [n])."""
        patches, lit = self.model.patches, hit.patch != NONE
        patch = dr.select(lit, hit.patch, 0)
        leaf = self.elements.leaf_at(patch, hit.u, hit.v, lit)
        emission = self.model.lights.at(patches, patch, hit.u, hit.v, lit)
        reflectance = self.model.reflectance_at(patch, hit.u, hit.v, lit)
        light = emission + reflectance * self.field.at(leaf, hit.u, hit.v, lit)
        if (behind := patches.behind(patch, lit)) is not None:
            twin, tau, there = behind
            leaf = self.elements.leaf_at(twin, hit.u, hit.v, there)
            light += tau * dr.select(there, self.field.at(leaf, hit.u, hit.v, there), 0)
        return dr.select(lit, light, 0)

    @cached_property
    def scattering(self) -> Scattering:
        """What of the irradiance leaves the elements diffusely."""
        return Scattering(self.elements, self.exposure)

    @cached_property
    def field(self) -> Field:
        """H as a continuous field over the surfaces."""
        return Field(self)

    @cached_property
    def gatherer(self) -> Gatherer:
        """What gathers irradiance at any places, by this solution's radiosity."""
        light = self.direct + self.indirect
        # Gather rays look for sharp light where they end, but only for the part that is reflected there.
        reflected = self.scattering.of_elements(light if self.sharp is None else light - self.sharp, light)
        looks = self.sharp is not None
        return Gatherer(self.model, self.elements, self.exposure, self.landings, reflected, looks, self.sharp)

    def leaves(self) -> Leaves:
        """Geometry and light of all leaves, neighbours after neighbours."""
        e, faces, leaf = self.elements, self.model.faces, self.elements.leaves
        patch = dr.gather(mi.UInt32, e.patch, leaf)
        face = np.array(dr.gather(mi.UInt32, e.patches.face, patch))
        corners = [np.array(e.patches.point(patch, *e.patch_point(leaf, a, b))).T for a, b in NODES[:3]]

        def of(kind, array):
            return np.array(dr.gather(kind, array, leaf)).T

        return Leaves(
            vertices=np.stack(corners, axis=1) + faces.centre,
            shape=np.array([part.number for part in faces.parts])[faces.shape[face]],
            face=face - np.searchsorted(faces.shape, faces.shape[face]),
            back=np.array(dr.gather(mi.Bool, e.patches.back, patch)).astype(bool),
            level=np.array(e.level(leaf)),
            area=of(mi.Float, e.area),
            open_area=of(mi.Float, self.exposure.open_area),
            irradiance=of(mi.Color3f, self.irradiance()),
            radiosity=of(mi.Color3f, self.radiosity()),
        )

    def render(
        self,
        sensor: "mi.Sensor | int" = 0,
        spp: int = 16,
        shading: str = "gouraud",
        seed: int = 0,
        denoise: bool = False,
        seconds: float | None = None,
        show: "Callable[[Callable[[], mi.TensorXf], int], None] | None" = None,
        hide_emitters: bool | None = None,
    ) -> "mi.TensorXf":
        """Picture from a sensor (mi.Sensor or its number); nothing is solved again.

        shading: ``gather`` and ``direct`` gather light at every pixel, ``gouraud`` and ``flat`` show what was solved.
        denoise: remove the noise of the samples, four per pixel at least and most where they are needed, by Open Image
        Denoise (extra ``denoise``).
        seconds: take as many samples as fit, instead of ``spp``; show(image, samples) is told after
        every pass, image() being the picture then.
        hide_emitters: are emitters and the sky invisible to the camera? By default what the scene's own integrator
        says. The picture has the channels of the sensor's film.
        Raises RadiosityError if the scene has been edited since it was solved.
        """
        spp, seed = whole_number("spp", spp), whole_number("seed", seed, None)
        seconds = None if seconds is None else real_number("seconds", seconds, 0)
        integrator = mi.load_dict({"type": "radiosity"})
        integrator.show(self, shading, hide_emitters)
        return integrator.picture(self.model.scene, sensor, seed, spp, denoise, seconds, show)

    def relight(self, scales: Scales) -> "Solution":
        """The solution with lamps dimmed or recoloured, exact by superposition, and without a ray.

        scales: by the lamps' names (ids of their shapes) or numbers, what their emission in the scene is multiplied by:
        one number or RGB; lamps that are not named stay as the scene has them. The scene itself is left alone.
        Raises RadiosityError if it was solved without layers, for unknown lamps and impossible scales.
        """
        if self.layers is None:
            raise RadiosityError("this solution keeps no light by lamp: solve with layers=True")
        values = self.layers.read(scales)
        light, stats = self.layers.summed(values), self.stats | {"power": self.layers.balance(values)}
        return Solution(exposure=self.exposure, stats=stats, **light)

    def view_factors(self, level: str = "face", rays: int | None = None, **options: Any) -> ViewFactors:
        """View factors between shapes, faces or leaves of the mesh, those that light can reach.

        level: "shape", "face" or "leaf"; rays and further options as in `mi_radiosity.view_factors`.
        """
        return view_factors(self.model, level, rays, elements=self.elements, **options)

    def require_unchanged(self) -> None:
        """Raise RadiosityError if the scene is not as it was when it was solved."""
        if not self.model.state.same_as(self.model.scene):
            raise RadiosityError("the scene has been edited since it was solved: solve it again")

    # ---- Files ---------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str], source: dict | None = None) -> None:
        """Write the solution as NumPy archive (.npz); no file is left half-written.

        source: where the scene came from, for `source_of` to tell.
        """
        e = self.elements
        arrays: dict[str, Any] = {name: np.array(getattr(e, name)) for name in TREE}
        arrays |= {name: np.array(getattr(self.exposure, name)) for name in EXPOSURE}
        for name, color in zip(COLORS, (e.reflectance, self.direct, self.indirect)):
            arrays[name] = np.array(color, dtype=np.float32).reshape(3, -1)
        parts = {name: getattr(self, name) for name in PARTS}
        arrays |= {name: np.array(h, dtype=np.float32).reshape(3, -1) for name, h in parts.items() if h is not None}
        arrays |= self.layers.arrays() if self.layers else {}
        arrays |= {"landings": np.array([self.landings.u, self.landings.v]).reshape(2, -1)}
        if e.crown:
            arrays["clusters"] = np.array(e.crown.labels)
        with writing(path) as temporary, open(temporary, "wb") as file:
            np.savez_compressed(
                file,
                format=FORMAT,
                fingerprint=self.model.fingerprint,
                sides=self.model.patches.sides,
                stats=json.dumps(self.stats),
                source=json.dumps(source),
                **arrays,
            )

    @staticmethod
    def source_of(path: str | os.PathLike[str]) -> dict | None:
        """Where the scene of a kept solution came from, as `save` was told; None if it was not.

        Raises RadiosityError if the file is no solution, or damaged as far as this is read.
        """
        with _archive(path) as file:
            return json.loads(str(file["source"])) if "source" in file else None

    @staticmethod
    def load(path: str | os.PathLike[str], scene: "mi.Scene | Model") -> "Solution":
        """Read a solution of ``scene``.

        Raises RadiosityError if the file is no solution, is damaged, or belongs to another scene.
        """
        require_variant()
        data, stats = _read(path)
        model = scene if isinstance(scene, Model) else Model(scene)
        if str(data["fingerprint"]) != model.fingerprint:
            raise RadiosityError(
                f"{path} belongs to another scene: solve this one, or load the scene it was saved from"
            )
        model = model.with_sides(data["sides"])
        reflectance, direct, indirect = (owned_vectors(mi.Color3f, data[name].T) for name in COLORS)
        arrays = {name: owned(mi.Float if data[name].dtype.kind == "f" else mi.UInt32, data[name]) for name in TREE}
        area = dr.gather(mi.Float, model.patches.area, arrays["patch"]) * arrays["scale"] ** 2
        crown, exitance = None, None
        if "clusters" in data:
            crown = Crown(model.patches, list(data["clusters"]))
            above = opaque_index(model.patches.count) + dr.arange(mi.UInt32, len(crown))
            dr.scatter(area, owned(mi.Float, crown.area), above)
        if model.lights.textured:
            frame = (arrays[name] for name in ("patch", "u0", "v0", "scale"))
            exitance = mean_exitance(model.patches, model.lights, *frame)
        elements = Elements(model.patches, arrays | {"area": area, "reflectance": reflectance}, exitance, crown)
        crossed = owned(mi.UInt32, data["crossed"]) == 1
        slots = int((data["slot"] != NONE).sum())
        exposure = Exposure(owned(mi.Float, data["open_area"]), crossed, owned(mi.UInt32, data["slot"]), slots)
        light = {name: owned_vectors(mi.Color3f, data[name].T) for name in PARTS if name in data}
        landings = Landings(slots, *data["landings"])
        solution = Solution(model, elements, exposure, direct, indirect, landings, stats, **light)
        if "lamps" not in data:
            return solution
        layers = Layers.load(data, Lamps(model), elements)
        return replace(solution, layers=layers).relight(dict(enumerate(layers.scales)))


def _read(path):
    """The arrays and the statistics in a file."""
    with _archive(path) as file:
        data = {name: file[name] for name in file.files}
        layers = [f"layers_{name}" for name in ARRAYS] if "lamps" in data else []
        for name in ("fingerprint", "sides", "landings", *TREE, *EXPOSURE, *COLORS, *layers):
            data[name]
        return data, json.loads(str(data["stats"]))


@contextmanager
def _archive(path):
    """What `save` has written, whose arrays are read when they are asked for."""
    try:
        with np.load(path) as file:
            if int(file["format"]) != FORMAT:
                raise RadiosityError(f"{path} was written by another version: solve the scene again")
            yield file
    except FileNotFoundError:
        raise RadiosityError(f"{path} does not exist: save a solution first") from None
    except RadiosityError:
        raise
    except Exception as error:
        why = type(error).__name__
        raise RadiosityError(f"{path} is not a readable solution ({why}): solve the scene again") from None


def _checked_points(points, normals):
    """Points and unit normals as float64 [n, 3]."""
    points = np.atleast_2d(np.asarray(points, dtype=np.float64))
    normals = np.atleast_2d(np.asarray(normals if normals is not None else [], dtype=np.float64))
    if points.shape[-1] != 3 or normals.shape[-1] != 3:
        raise RadiosityError("points and normals must be arrays of the shape [n, 3]")
    normals = np.broadcast_to(normals, points.shape) if len(normals) == 1 else normals
    if points.shape != normals.shape:
        raise RadiosityError(
            f"{len(points)} points do not fit {len(normals)} normals: give one normal each, or one for all"
        )
    length = np.linalg.norm(normals, axis=1)
    if not np.isfinite(points).all() or not (np.isfinite(length) & (length > 0)).all():
        raise RadiosityError("points and normals must be finite numbers, and no normal may be zero")
    return points, normals / length[:, None]
