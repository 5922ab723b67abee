"""The `radiosity` integrator: any sensor looks at a solution through Mitsuba's own film."""

import drjit as dr
import mitsuba as mi

from ..core.errors import RadiosityError
from ..oracles import make_oracle
from ..scene.model import NONE
from ..solver import solve
from .field import Field

SHADINGS = ("gouraud", "flat", "mesh")
LINE_WIDTH = 1.0  # pixels
LINE_SHADE = 0.25  # of the picture under an element outline


def _checked_shading(name):
    if name not in SHADINGS:
        raise RadiosityError(f"unknown shading '{name}': choose one of {', '.join(SHADINGS)}")
    return name


def _integrator_class():
    """The class for the active variant: Mitsuba's base class is another one in each."""

    class RadiosityIntegrator(mi.SamplingIntegrator):
        """
        Displays a radiosity solution: L = (E + ρ H) / π, with ρ looked up at the pixel.

        Parameters: ``oracle``, ``alpha``, ``elements``, ``epsilon``, ``rays``, ``lines``, ``seed`` as in
        `solve`; ``shading``: ``gouraud`` (default), ``flat`` or ``mesh`` (element outlines).

        The scene is solved at its first picture and not again until it, or a parameter, changes.
        """

        def __init__(self, props):
            super().__init__(props)
            self.shading = _checked_shading(props.get("shading", "gouraud"))
            alpha = props.get("alpha") if "alpha" in props else None
            self.options = {"oracle": make_oracle(props.get("oracle", "gmi"), alpha)}
            for name, kind in (("elements", int), ("epsilon", float), ("rays", int), ("lines", int), ("seed", int)):
                if name in props:
                    self.options[name] = kind(props.get(name))
            self.progress = None
            self.pixel = 1.0  # width of a pixel in units of the ray differentials
            self.show(None)

        def show(self, solution):
            """Display ``solution`` from now on (None: solve the scene of the next picture)."""
            self.solution, self.field = solution, Field(solution) if solution else None

        def prepare(self, scene):
            """The solution of ``scene``, solved now if need be."""
            if self.solution is None or self.solution.model.scene.ptr != scene.ptr:
                self.show(solve(scene, **self.options, progress=self.progress))
            return self.solution

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            self.prepare(scene)
            chosen = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            # Mitsuba shrinks ray differentials to the spacing of samples.
            self.pixel = (spp or chosen.sampler().sample_count()) ** 0.5
            return super().render(scene, chosen, seed, spp, develop, evaluate)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            solution = self.prepare(scene)
            model, elements = solution.model, solution.elements
            prelim = model.tracing.ray_intersect_preliminary(ray, coherent=True, active=active)
            hit = model.locate(prelim, ray.d)
            valid = hit.valid & active
            lit = valid & (hit.patch != NONE)
            leaf = elements.leaf_at(hit.patch, hit.u, hit.v, lit)
            if self.shading == "flat":
                irradiance = dr.gather(mi.Color3f, self.field.flat, leaf, lit)
            else:
                irradiance = self.field.at(leaf, hit.u, hit.v, lit)
            if model.textured and model.overlaps:
                # The face shown need not be the one the ray met.
                patch = dr.select(lit, hit.patch, 0)
                reflectance = model.faces.reflectance_at(
                    dr.gather(mi.UInt32, model.face, patch), hit.u, hit.v, dr.gather(mi.Bool, model.back, patch)
                )
            elif model.textured:
                si = prelim.compute_surface_interaction(ray, mi.RayFlags.All, lit)
                reflectance = si.bsdf().eval_diffuse_reflectance(si, lit)
            else:
                reflectance = dr.gather(mi.Color3f, model.reflectance, hit.patch, lit)
            radiance = (dr.gather(mi.Color3f, model.emission, hit.patch, lit) + reflectance * irradiance) * dr.inv_pi
            if self.shading == "mesh":
                radiance *= dr.select(self._on_outline(ray, hit, leaf, lit), LINE_SHADE, 1)
            return dr.select(lit, radiance, 0), valid, []

        def _on_outline(self, ray, hit, leaf, active):
            """Is a pixel within half a line of the border of its leaf?"""
            model, e = self.solution.model, self.solution.elements
            patch = dr.select(active, hit.patch, 0)
            p0 = dr.gather(mi.Point3f, model.p0, patch) + model.origin
            e1, e2 = dr.gather(mi.Vector3f, model.e1, patch), dr.gather(mi.Vector3f, model.e2, patch)
            normal = dr.cross(e1, e2)
            scale = dr.select(active, dr.gather(mi.Float, e.scale, dr.select(active, leaf, 0)), 1)

            def local(origin, direction):
                """Barycentric coordinates on the leaf where a ray meets the plane of its patch."""
                x = origin + direction * (dr.dot(p0 - origin, normal) / dr.dot(direction, normal)) - p0
                n2 = dr.squared_norm(normal)
                a = (dr.dot(dr.cross(x, e2), normal) / n2 - dr.gather(mi.Float, e.u0, leaf, active)) / scale
                b = (dr.dot(dr.cross(e1, x), normal) / n2 - dr.gather(mi.Float, e.v0, leaf, active)) / scale
                return mi.Vector3f(1 - a - b, a, b)

            here = local(ray.o, ray.d)
            dx, dy = local(ray.o_x, ray.d_x) - here, local(ray.o_y, ray.d_y) - here
            per_pixel = dr.sqrt(dx * dx + dy * dy) * dr.opaque(mi.Float, self.pixel)
            return active & dr.any(here < 0.5 * LINE_WIDTH * per_pixel)

        def traverse(self, callback):
            pass

        def parameters_changed(self, keys):
            self.show(None)

        def to_string(self):
            options = "".join(f",\n  {name} = {value}" for name, value in self.options.items())
            return f"RadiosityIntegrator[\n  shading = {self.shading}{options}\n]"

    return RadiosityIntegrator


def register(*_):
    """Make `radiosity` known to the active variant, and to those chosen later."""
    if mi.variant():
        mi.register_integrator("radiosity", lambda props: _integrator_class()(props))


def render(solution, sensor=0, spp=16, shading="gouraud", seed=0):
    """Picture of ``solution`` from a sensor (or its number) as mi.TensorXf [height, width, channels]."""
    scene = solution.model.scene
    if isinstance(sensor, int):
        if not 0 <= sensor < len(scene.sensors()):
            raise RadiosityError(f"there is no sensor {sensor}: the scene has {len(scene.sensors())}, counted from 0")
        sensor = scene.sensors()[sensor]
    integrator = mi.load_dict({"type": "radiosity", "shading": _checked_shading(shading)})
    integrator.show(solution)
    return integrator.render(scene, sensor, seed=seed, spp=spp)
