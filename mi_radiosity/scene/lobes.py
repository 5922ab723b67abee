"""Power rays past surfaces that are not plainly diffuse: through mirrors, glass, gloss and masks to a diffuse lobe."""

import gc
from contextlib import contextmanager
from typing import Any
from weakref import ref

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE
from ..core.points import ROUNDS
from .hit import Hit

ROULETTE = 5  # lobes after which a ray may end by chance
MAX_DEPTH = 64  # lobes after which it ends
ANY = 1 << 30  # recordings for a scene: one for every pattern of widths


class Lobes:
    """Follows power rays in a scene some of whose shapes are not plainly diffuse.

    At every such surface one lobe is sampled by Mitsuba's `bsdf.sample`, for the transport of importance. A diffuse
    lobe ends the ray, whether it reflects or transmits. Its weight over the mean albedo ρ + τ of the patch multiplies
    the power that arrives, so that the mean of what the patch receives is what arrives there. Any other lobe sends the
    ray on.
    """

    def __init__(self) -> None:
        # A solve follows many short waves of rays: they are traced in less time than the loop is told to Dr.Jit in.
        # Rays are referred to weakly, as Dr.Jit keeps its arguments, and rays these.
        self._frozen = dr.freeze(
            lambda rays, *others: rays().lobes._past(rays(), *others),
            state_fn=lambda rays, *_: rays().arrays(),
            auto_opaque=False,
            warn_after=ANY,
        )

    def follow(
        self,
        rays: Any,
        met: "mi.PreliminaryIntersection3f",
        hit: Hit,
        ray: "mi.Ray3f",
        number: "mi.UInt32",
        seed: "mi.UInt32",
    ) -> Hit:
        """Where rays end whose first hits are not plainly diffuse.

        met, hit: those first hits; number (UInt32 [n]), seed: what random numbers are made from.
        """
        n = dr.width(ray.d)
        random = mi.PCG32(initstate=mi.sample_tea_64(number, seed, ROUNDS), initseq=mi.UInt64(number))
        no, black = dr.zeros(mi.Bool, n), dr.zeros(mi.Color3f, n)
        end = Hit(hit.valid, hit.patch, hit.u, hit.v, hit.back, hit.traced, no, no, black + 1, black)
        state = (dr.full(mi.Bool, True, n), met, ray, dr.zeros(mi.UInt32, n), random, end)
        with _garbage_kept():
            return self._frozen(ref(rays), state)[-1]

    def _past(self, rays, state):
        """The state of rays past all lobes."""
        ctx = mi.BSDFContext(mi.TransportMode.Importance)

        def step(alive, met, ray, depth, random, end):
            return self._step(rays, ctx, alive, met, ray, depth, random, end)

        return dr.while_loop(state, lambda alive, *_: alive, step)

    def _step(self, rays, ctx, alive, met, ray, depth, random, end):
        """Past one more surface."""
        # Sample one lobe.
        before, on_patch = end.weight, end.patch != NONE
        si = met.compute_surface_interaction(ray, mi.RayFlags.All, alive)
        s, st = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        sample, value = si.bsdf(ray).sample(ctx, si, s, st, alive)
        value = dr.select(alive & is_sound(si, sample, value), value, 0)

        # A diffuse lobe of a patch ends the ray: what it reflects or transmits, this side has received.
        ends = alive & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Diffuse) & on_patch & (dr.max(value) > 0)
        on = alive & ~ends
        albedo = dr.gather(mi.Color3f, rays.albedo, end.patch, ends)
        factor = dr.select(ends, dr.select(albedo > 0, value / albedo, 0), dr.select(on, value, 1))
        # Exact for each ray: the albedo varies with direction, and so does what counts as received.
        taken = dr.select(alive, before * (1 - factor), 0)

        # Any other lobe sends it on, as far as Russian roulette allows.
        depth += 1
        lives = dr.select(on & (depth > ROULETTE), dr.minimum(dr.max(before * factor), 0.95), 1)
        goes_on = on & (dr.max(before * factor) > 0) & (random.next_float32() < lives) & (depth < MAX_DEPTH)
        ray = dr.select(goes_on, si.spawn_ray(si.to_world(sample.wo)), ray)
        met = rays.scene.ray_intersect_preliminary(ray, active=goes_on)
        hit = rays.locate(met, ray.d)
        end = Hit(
            valid=hit.valid | ~goes_on,
            patch=dr.select(goes_on, hit.patch, dr.select(on, NONE, end.patch)),
            u=dr.select(goes_on, hit.u, end.u),
            v=dr.select(goes_on, hit.v, end.v),
            back=end.back,
            traced=end.traced,
            bounced=end.bounced | on,
            rough=dr.select(end.bounced, end.rough, on & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)),
            weight=dr.select(on & ~goes_on, 0, before * factor / dr.maximum(lives, 1e-6)),
            taken=end.taken + taken,
        )
        return goes_on & hit.traced, met, ray, depth, random, end


def is_sound(si: "mi.SurfaceInteraction3f", sample: "mi.BSDFSample3f", value: "mi.Color3f") -> "dr.ArrayBase":
    """Are samples of BSDFs finite and of a possible direction (Bool, or one per channel [n])?

    A BlendBSDF that draws a one-sided `diffuse` from behind gives a direction on the front side the weight of its other
    BSDF, which may transmit. The density of that direction does not include the draw, so the sample is void.
    """
    reflects = mi.has_flag(sample.sampled_type, mi.BSDFFlags.DiffuseReflection)
    return dr.isfinite(value) & ~(reflects & (sample.wo.z * si.wi.z < 0))


@contextmanager
def _garbage_kept():
    """Collects no garbage in the body: scenes must not end while Dr.Jit records, or the process does."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
