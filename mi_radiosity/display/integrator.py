"""The `radiosity` integrator: any sensor looks at a solution through Mitsuba's own film."""

import time
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, select
from ..core.errors import RadiosityError
from ..core.llvm import require_variant
from ..core.numbers import real_number, whole_number
from ..oracles import make_oracle
from ..scene import refuse_gradients
from ..solver import solve
from ..transport import PathEnd
from .denoise import CleanPicture
from .pixels import FilmPicture, grow
from .scene_integrator import hides_emitters
from .shaders import SHADERS, Look

LATE = 0.1  # of the time, that may pass beyond it until the last image is as good as planned
OPTIONS = ("oracle", "alpha", "elements", "epsilon", "rays", "lines", "seed")  # of the plugin, as `solve` has them
NO_GRADIENTS = "a radiosity solution has no gradients yet: differentiate with 'prb'"


def _chosen(scene, sensor):
    """A sensor, or that of a number in the scene. Raises RadiosityError if there is none."""
    if isinstance(sensor, mi.Sensor):
        return sensor
    number, count = whole_number("the number of a sensor", sensor, None), len(scene.sensors())
    if not 0 <= number < count:
        raise RadiosityError(f"there is no sensor {number}: the scene has {count}, counted from 0")
    return scene.sensors()[number]


def _integrator_class():
    """The class for the active variant: Mitsuba's base class is another one in each."""

    class RadiosityIntegrator(mi.SamplingIntegrator):
        """
        Displays a radiosity solution: L = (E + ρ H) / π, with ρ looked up at the pixel.

        Parameters: ``oracle`` (NAME or NAME:PARAMETER), ``alpha``, ``elements``, ``epsilon``, ``rays``, ``lines``,
        ``seed`` as in `solve`; ``shading``: the name of a shader, ``gouraud`` (default), ``flat``, ``mesh``, …; and
        ``hide_emitters`` as Mitsuba's integrators have it.

        The scene is solved at its first picture and not again until it, or a parameter, changes.
        """

        def __init__(self, props: "mi.Properties") -> None:
            super().__init__(props)
            self.named_shading = props.get("shading") if "shading" in props else None
            self.shading = self.named_shading or "gouraud"
            SHADERS.find(self.shading)
            given = {name: props.get(name) for name in OPTIONS if name in props}
            self.options: dict[str, Any] = {"oracle": make_oracle(given.pop("oracle", "gmi"), given.pop("alpha", None))}
            for name, value in given.items():
                least = None if name == "seed" else 1
                self.options[name] = (
                    real_number(name, value, 0) if name == "epsilon" else whole_number(name, value, least)
                )
            # What the scene says itself, without defaults: the command line starts from these.
            self.named = dict(self.options)
            if "oracle" not in props and "alpha" not in props:
                del self.named["oracle"]
            self.hidden = self.hide_emitters
            self.progress = None
            self._forget()

        def _forget(self):
            self.solution, self._shader, self._given = None, None, False

        def _display(self, solution, given):
            self.solution, self._shader, self._given = solution, SHADERS.find(self.shading)(solution), given

        def show(self, solution, shading=None, hide_emitters=None):
            """Display ``solution`` from now on, in another shading perhaps. hide_emitters: None for what the integrator
            of the solution's scene says."""
            self.shading = shading or self.shading
            self.hidden = hides_emitters(solution.model.scene) if hide_emitters is None else bool(hide_emitters)
            self._display(solution, given=True)

        def prepare(self, scene):
            """The solution of ``scene``, solved now if there is none, or if the scene has been edited since."""
            require_variant()
            refuse_gradients(scene)
            if self.solution is not None and self.solution.model.state.same_as(scene):
                return self.solution
            if self._given:
                self.solution.require_unchanged()
                raise RadiosityError("the solution that is shown belongs to another scene: solve this one")
            self._forget()
            self._display(solve(scene, **self.options, progress=self.progress), given=False)
            return self.solution

        def picture(self, scene, sensor, seed, spp, denoise=False, seconds=None, show=None):
            """What `mi.render` gives, of a sensor or its number; denoised, or as good as ``seconds`` make it, if asked
            for."""
            sensor = _chosen(scene, sensor)
            if seconds is None and not denoise:
                return self.render(scene, sensor, seed=seed, spp=spp)
            start = time.perf_counter()
            self.prepare(scene)
            if denoise:
                picture = CleanPicture(self._see, sensor, self._sample, seed)
            else:
                picture = FilmPicture(scene, sensor, self._sample, seed)
            if seconds is None:
                picture.take(spp)
            else:
                whole = seconds - (time.perf_counter() - start)
                done = grow(picture, whole, show or (lambda image, samples: None))
                left = seconds - (time.perf_counter() - start)
                seconds = min(max(left, picture.finishing(whole, done)), left + LATE * seconds)
            return picture.image(seconds)

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            self.prepare(scene)
            chosen, spp = _chosen(scene, sensor), whole_number("spp", spp, 0)
            seed = whole_number("seed", seed[0] if dr.is_array_v(seed) else seed, None)
            picture = FilmPicture(scene, chosen, self._sample, seed)
            picture.add(spp or chosen.sampler().sample_count())
            return picture.image() if develop else None

        def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
            raise RadiosityError(NO_GRADIENTS)

        def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
            raise RadiosityError(NO_GRADIENTS)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            self.prepare(scene)
            return self._sample(sampler, ray, active)

        def _see(self, ray, active=True):
            """What rays of a camera meet first."""
            return self.solution.model.rays.seen(ray, active, lamps=not self.hidden)

        def _sample(self, sampler, ray, active=True, met=None):
            """What `sample` gives of a scene that is prepared; ``met``: what rays meet first, if that is known."""
            solution, shader = self.solution, self._shader
            model, rays, plain = solution.model, solution.model.rays, solution.model.materials.all_plain
            if met is None:
                met = self._see(ray, active)
            hit = rays.locate(met, ray.d)
            on_patch = active & hit.valid & (hit.patch != NONE)
            emission = model.lights.at(model.patches, hit.patch, hit.u, hit.v, on_patch)

            # Follow rays past surfaces that are not plainly diffuse.
            number = seed = mi.UInt32(0)
            first: tuple = ()
            if not plain:
                number, seed = (mi.UInt32(sampler.next_1d() * 2.0**32) for _ in range(2))
                # The first vertex is as well spread as the ray is.
                shadow, direction = (sampler.next_1d(), *sampler.next_2d()), (sampler.next_1d(), *sampler.next_2d())
                first = (*shadow, *direction)
            follows = active & hit.valid
            end = shader.paths.follow(met, hit, ray, number, seed, follows, shader.reads, False, first)
            if shader.colors and not plain:  # no coat lies over them, but where rays go on straight they do
                leaf = solution.elements.leaf_at(hit.patch, hit.u, hit.v, on_patch)
                end = select(on_patch & ~end.straight, PathEnd.at(leaf, hit), end)

            # What is there, and what was found on the way.
            lit = follows & (end.leaf != NONE)
            reflectance = model.reflectance_at(end.patch, end.u, end.v, lit)
            glows = dr.select(hit.traced, emission, 0)
            shown = replace(hit, patch=end.patch, u=end.u, v=end.v)
            look = Look(ray, shown, end.leaf, emission - glows, reflectance, lit, sampler, end.straight)
            radiance = dr.select(lit, shader.at_end(look, end, number, seed), 0)
            valid = follows & (~hit.traced | lit | end.passed)
            if not shader.colors:
                radiance += dr.select(follows, (end.light + glows) * dr.inv_pi, 0)
            if model.lights.sky_light and not self.hidden:
                radiance += model.lights.sky(ray.d, active & ~hit.valid) * dr.inv_pi
                valid |= active
            return radiance, valid, []

        def traverse(self, callback):
            pass

        def parameters_changed(self, keys):
            self._forget()

        def to_string(self):
            options = "".join(f",\n  {name} = {value}" for name, value in self.options.items())
            return f"RadiosityIntegrator[\n  shading = {self.shading}{options}\n]"

    return RadiosityIntegrator


def register(*_: object) -> None:
    """Make `radiosity` known to the active variant, and to those chosen later."""
    if mi.variant():
        mi.register_integrator("radiosity", lambda props: _integrator_class()(props))
