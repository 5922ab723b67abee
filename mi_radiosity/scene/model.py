"""The scene as the solver sees it."""

import hashlib
from functools import cached_property
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.llvm import require_variant
from .faces import Faces
from .light_paths import light_paths
from .lights import Lights
from .materials import Materials, require_supported
from .overlap import find_overlaps
from .patches import make_patches
from .rays import Rays
from .reach import reached
from .solids import seen_by_light, seen_from_patches
from .state import Parameters, State


class Model:
    """A Mitsuba scene read once: ``faces``, ``materials``, ``lights``, ``patches`` and the ``rays`` between them.

    sides: patches to make (see `Patches`). By default those that light can reach; all of them if light reaches none, or
    if the scene need not be ``lit``, and may have no emitter. ``warnings``: what a user should know (list of str).
    ``unreached``: how many sides no light reaches. ``fingerprint``: SHA-256 of geometry, orientation, reflectance,
    lobes, emission and lamps. ``state``: what the scene was like when it was read.

    Raises RadiosityError for whatever is not modelled, naming the shape.
    """

    def __init__(self, scene: "mi.Scene", sides: np.ndarray | None = None, lit: bool = True) -> None:
        require_variant()
        if not isinstance(scene, mi.Scene):
            raise RadiosityError(
                f"the scene must be a mi.Scene of the variant {mi.variant()}, such as mi.load_file(...) returns, "
                f"not {type(scene).__name__}"
            )
        require_supported(scene)
        self.scene, self.state = scene, State(scene)
        self.faces = Faces(scene)
        self.materials = Materials(self.faces)
        self.lights = Lights(self.faces, required=lit)
        self._named = self._parameters()  # as they are now
        overlaps = self._find_overlaps()
        self.unreached = 0
        wanted = self._sides(self._candidate & ~overlaps.covered) if sides is None else sides
        patches = make_patches(self.faces, self.materials, self.lights, _some(wanted))
        rays, found = self._rays(patches, overlaps), np.ones(patches.count, dtype=bool)
        paths = light_paths(rays, self.lights) if lit and self.lights.any_power else None
        if lit and not paths:
            self.faces.warnings.append("no emitter has any power: the solution is black")
        rooms = seen_by_light(self.faces, paths.hits) if paths else np.zeros(0, dtype=bool)
        if sides is None and paths:
            found = reached(self._rays(patches, overlaps, rooms) if rooms.any() else rays, self.lights, paths)
            if not found.any():
                self.faces.warnings.append("no light reaches any surface with a diffuse lobe: the solution is black")
                found[:] = True
        if not found.all():
            self.unreached = int((~found).sum())
            patches = patches.only(np.flatnonzero(found))
        self.patches = patches
        kept, doubled = overlaps.among(self._numbers(patches.sides))
        self.rays = self._rays(patches, kept)
        if not paths:
            rooms = seen_from_patches(self.faces, self.rays)
        if rooms.any():
            self.rays = self._rays(patches, kept, rooms)
        self.warnings = self.faces.warnings + self._warn_of(doubled)

    def with_sides(self, sides: np.ndarray) -> "Model":
        """The same scene with other patches."""
        return self if np.array_equal(sides, self.patches.sides) else Model(self.scene, sides, self.lights.required)

    def reflectance_at(
        self, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float", active: "mi.Bool | bool" = True
    ) -> "mi.Color3f":
        """ρ at points of patches, with textures; the mean over the patch where other lobes are traced (Color3f [n])."""
        mean = dr.gather(mi.Color3f, self.patches.reflectance, patch, active)
        if not self.materials.textured:
            return mean
        face, back = (dr.gather(type(x), x, patch, active) for x in (self.patches.face, self.patches.back))
        at_point = self.materials.reflectance_at(face, u, v, back)
        return dr.select(active & ~self.materials.is_traced(face), at_point, mean)

    def _find_overlaps(self):
        """Faces in one another: one of them is lit and shown wherever several are."""
        f, sound = self.faces, ~self.faces.degenerate
        there = np.column_stack([sound, sound & self.materials.two_sided])  # [faces, front and back]
        emits = self.lights.exitance.any(axis=1)[:, None] & [True, False]
        # A side without a diffuse lobe receives nothing: what meets it goes on.
        lobe = ~self.materials.traced[f.shape][:, None] | self.materials.rho.any(axis=2).T | emits
        lobe |= self.materials.transmits[:, None]
        self._candidate = there & lobe if self.lights.required else there
        exitance = self.lights.exitance.sum(axis=1)
        return find_overlaps(
            f, self._candidate, np.column_stack([exitance, 0 * exitance]), self.materials.rho.sum(axis=2).T, f.lift
        )

    def _rays(self, patches, overlaps, in_room=None):
        return Rays(self.faces, patches, self.materials, overlaps.lookup(self.faces.centre), in_room)

    def _sides(self, which):
        """Sides chosen by a mask [faces, 2], in the order of the faces' ranks."""
        numbers = np.flatnonzero(which)
        return np.sort(2 * self.faces.rank[numbers // 2] + numbers % 2)

    def _numbers(self, sides):
        """2 · face + (1 for the back) of sides."""
        return 2 * self.faces.order[sides // 2] + sides % 2

    def _warn_of(self, doubled):
        if not len(doubled):
            return []
        return [
            f"{len(doubled)} faces lie in others, in {self.faces.names(doubled)}: "
            "where they do, a lamp or else the smaller surface is taken to be on top"
        ]

    @cached_property
    def fingerprint(self) -> str:
        digest, f = hashlib.sha256(), self.faces
        order, rho = f.order, np.round(self.materials.rho, 4).swapaxes(0, 1) + 0
        tau = [np.round(self.materials.tau, 4).swapaxes(0, 1)] if self.materials.transmits.any() else []
        for array in (f.corners, f.flipped, self.materials.two_sided, rho, *tau, self.lights.exitance):
            digest.update(np.ascontiguousarray(array[order], dtype=np.float32).tobytes())
        for named in self._named:
            digest.update(bytes(named))
        return digest.hexdigest()

    def _parameters(self):
        """What there is to know by name of lamps that are no surfaces, and of lobes that are traced."""
        f = self.faces
        found: list[bytes | Parameters] = [light.fingerprint() for light in self.lights.free]
        ends = np.searchsorted(f.shape, np.arange(len(f.parts) + 1))
        first = np.array([f.rank[start:end].min(initial=len(f)) for start, end in pairwise(ends)])
        for number in np.argsort(first, kind="stable"):
            if self.materials.traced[number]:
                found += [str(first[number]).encode(), Parameters(f.parts[number].shape.bsdf())]
        return found


def _some(sides):
    """Sides to make patches of: there must be any."""
    if len(sides):
        return sides
    raise RadiosityError("no surface has a diffuse lobe, so there is nothing to solve: add one, or use 'path'")
