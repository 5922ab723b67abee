"""Shadings: how a solution looks where a camera ray meets it. One class each, known by its name."""

from dataclasses import dataclass, replace
from functools import cached_property, partial

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE
from ..core.plugins import Registry
from ..core.points import coordinates, cosine_direction
from ..scene.hit import Hit
from ..solver import Field, Solution
from ..transport import PathEnd, Paths, Places

LINE_WIDTH = 1.0  # pixels
LINE_SHADE = 0.25  # of the picture under an element outline
SHADERS = Registry("shading")


@dataclass
class Look:
    """Camera rays and what they meet; one entry per ray."""

    ray: "mi.RayDifferential3f"
    hit: Hit
    leaf: "mi.UInt32"  # the element at the hit
    emission: "mi.Color3f"  # E at the hit, W/m²
    reflectance: "mi.Color3f"  # ρ at the hit, textures and all
    lit: "mi.Bool"  # the ray meets a patch; the others are black
    sampler: "mi.Sampler"
    straight: "mi.Bool"  # nothing but null lobes came before


class Shader:
    """A way to show a Solution. A subclass gives itself a ``name``, by which the command line, XML and
    `Solution.render` know it from then on, and defines `irradiance`, or `radiance` itself."""

    name = ""
    reads = True  # are pictures made of what a solution has at the first vertex of a camera path, too?
    samples = False  # is more light gathered for every camera sample, so that pictures get better with time?
    colors = False  # is what it shows no light, so that neither coats nor lamps mirrored in them belong to it?

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "name" in vars(cls):
            SHADERS.add(cls.name, cls)

    def __init__(self, solution: Solution):
        self.solution = solution

    @classmethod
    def legend(cls, solution: Solution) -> str:
        """What there is to know to read its pictures: one line, or nothing."""
        return ""

    def irradiance(self, look: Look) -> "mi.Color3f":
        """H where rays meet patches, W/m² (Color3f [rays])."""
        raise NotImplementedError(f"{type(self).__name__} must define irradiance(look)")

    def radiance(self, look: Look) -> "mi.Color3f":
        """L = (E + ρ H) / π, W/(m² sr) (Color3f [rays]); τ H of the other side is added where a face transmits."""
        leaving = look.emission + look.reflectance * self.irradiance(look)
        if (behind := self._behind(look)) is not None:
            leaving += dr.select(behind.lit, behind.reflectance * self.irradiance(behind), 0)
        return leaving * dr.inv_pi

    def _behind(self, look):
        """The other side of the faces that rays meet, with τ in place of ρ (Look); None if no face transmits."""
        behind = self.solution.model.patches.behind(dr.select(look.lit, look.hit.patch, 0), look.lit)
        if behind is None:
            return None
        twin, tau, there = behind
        hit = replace(look.hit, patch=twin)
        leaf = self.solution.elements.leaf_at(twin, hit.u, hit.v, there)
        return replace(look, hit=hit, leaf=leaf, emission=mi.Color3f(0), reflectance=tau, lit=there)

    @cached_property
    def paths(self) -> Paths:
        """What follows camera rays past surfaces that are not plainly diffuse."""
        return paths_to_points(self.solution)

    def at_end(self, look: Look, end: PathEnd, number: "mi.UInt32", seed: "mi.UInt32") -> "mi.Color3f":
        """What camera paths bring from where they end (Color3f [rays]). number, seed: see `Paths.follow`."""
        return self.radiance(look) if self.colors else end.weight * self.radiance(look)


def paths_to_points(solution: Solution) -> Paths:
    """Camera paths that read a solution from their first vertex on, its ρ at points, textures and all."""
    model = solution.model
    return Paths(model, solution.elements, partial(_at_points, model), partial(_sun_is_left_out, solution))


def _at_points(model, leaf, patch, u, v, active):
    """ρ at points of patches, textures and all (Color3f [n])."""
    return model.reflectance_at(patch, u, v, active)


def _sun_is_left_out(solution, direction):
    return solution.gatherer.is_sharp_sky(direction)


class Gouraud(Shader):
    """Irradiance as a continuous field, see `Field`."""

    name = "gouraud"

    def __init__(self, solution: Solution) -> None:
        super().__init__(solution)
        self.field = solution.field

    def irradiance(self, look: Look) -> "mi.Color3f":
        return self.field.at(look.leaf, look.hit.u, look.hit.v, look.lit)


class Flat(Shader):
    """Every element in its own irradiance."""

    name = "flat"

    def __init__(self, solution: Solution) -> None:
        super().__init__(solution)
        self._irradiance = solution.irradiance()

    def irradiance(self, look: Look) -> "mi.Color3f":
        return dr.gather(mi.Color3f, self._irradiance, look.leaf, look.lit)


class Mesh(Gouraud):
    """Gouraud, with the outlines of the elements."""

    name = "mesh"

    def radiance(self, look: Look) -> "mi.Color3f":
        return super().radiance(look) * dr.select(self._on_outline(look), LINE_SHADE, 1)

    def _on_outline(self, look):
        """Is a pixel within half a line of the border of its leaf?"""
        patches, elements, ray = self.solution.model.patches, self.solution.elements, look.ray
        patch = dr.select(look.lit, look.hit.patch, 0)
        p0 = dr.gather(mi.Point3f, patches.p0, patch) + patches.origin
        e1, e2 = dr.gather(mi.Vector3f, patches.e1, patch), dr.gather(mi.Vector3f, patches.e2, patch)
        normal = dr.cross(e1, e2)

        def local(origin, direction):
            """Barycentric coordinates on the leaf where a ray meets the plane of its patch."""
            x = origin + direction * (dr.dot(p0 - origin, normal) / dr.dot(direction, normal)) - p0
            a, b = elements.own_point(look.leaf, *coordinates(x, e1, e2), look.lit)
            return mi.Vector3f(1 - a - b, a, b)

        here = local(ray.o, ray.d)
        dx, dy = local(ray.o_x, ray.d_x) - here, local(ray.o_y, ray.d_y) - here
        per_pixel = dr.sqrt(dx * dx + dy * dy)
        return look.lit & look.straight & dr.any(here < 0.5 * LINE_WIDTH * per_pixel)


class Gather(Shader):
    """Light gathered at every pixel: one line to the lamps and one ray into the solved room per sample, by multiple
    importance. As sharp as path tracing, whose paths it ends at their second diffuse lobe."""

    name = "gather"
    reads = False
    samples = True

    def __init__(self, solution: Solution) -> None:
        super().__init__(solution)
        self._gatherer = solution.gatherer
        # What no sample can find is shown as it was shot.
        caustic = solution.caustic
        some = caustic is not None and dr.any(caustic > 0, axis=None)
        self._caustic = Field(solution, caustic) if some else None
        self.paths = self._gatherer.paths_with(caustic if some else None)

    def at_end(self, look: Look, end: PathEnd, number: "mi.UInt32", seed: "mi.UInt32") -> "mi.Color3f":
        traced, camera = look.hit.traced, mi.Point3f(look.ray.o - self.solution.model.patches.origin)
        look = replace(look, lit=look.lit & ~traced)
        lit = dr.select(look.lit, self.radiance(look), 0)
        if self.solution.model.materials.all_plain:
            return lit
        end = replace(end, leaf=dr.select(traced, end.leaf, NONE))
        light = self._gatherer.reflected_by(end) + end.weight * self._gatherer.by_sharp_light(camera, end, number, seed)
        return lit + light * dr.inv_pi

    def irradiance(self, look: Look) -> "mi.Color3f":
        lamps, room = self._samples(look)
        if self._caustic is not None:
            room += self._caustic.at(look.leaf, look.hit.u, look.hit.v, look.lit)
        return lamps + room

    def _samples(self, look):
        """H from the lamps and from the room, a sample of each (two Color3f [rays])."""
        places, sampler = self._places(look), look.sampler
        lot, at, to = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
        number, seed = (mi.UInt32(sampler.next_1d() * 2.0**32) for _ in range(2))
        direction = cosine_direction(places.normal, to.x, to.y)
        side = dr.gather(mi.Vector3f, self.solution.model.patches.normal, look.hit.patch, look.lit)
        above = look.lit & (dr.dot(direction, side) > 0)
        lines, _ = self._gatherer.lines(places, lot, at.x, at.y, 1.0, look.lit)
        room, met = self._gatherer.rays(places, direction, number, seed, 1.0, above)
        return lines + met, room

    def _places(self, look):
        model = self.solution.model
        patches, hit = model.patches, look.hit
        patch = dr.select(look.lit, hit.patch, 0)
        normal = dr.gather(mi.Vector3f, patches.normal, patch)
        if model.faces.smooth:
            face, back = dr.gather(mi.UInt32, patches.face, patch), dr.gather(mi.Bool, patches.back, patch)
            normal = mi.Vector3f(model.faces.surface(face, hit.u, hit.v).sh_frame.n) * dr.select(back, -1, 1)
        return Places(patches.point(patch, hit.u, hit.v), normal, dr.select(look.lit, look.leaf, 0))


class Direct(Gather):
    """Light of the lamps gathered at every pixel, the rest from the continuous field."""

    name = "direct"
    reads = True

    def __init__(self, solution: Solution) -> None:
        super().__init__(solution)
        self.paths = paths_to_points(solution)
        self._field = Field(solution, solution.indirect)

    def irradiance(self, look: Look) -> "mi.Color3f":
        return self._samples(look)[0] + self._field.at(look.leaf, look.hit.u, look.hit.v, look.lit)
