"""Lobes that are not diffuse are traced: a ray goes on through mirrors, glass, gloss and masks until a diffuse lobe."""

import gc
from collections.abc import Sequence
from contextlib import contextmanager
from typing import Any
from weakref import ref

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE
from ..core.points import ROUNDS
from .gloss import Gloss
from .hit import Hit, Trail

ROULETTE = 5  # lobes after which a ray may end by chance
MOST = 64  # lobes after which it ends
ANY = 1 << 30  # recordings for a scene: one for every pattern of widths


class Lobes:
    """Follows rays in a scene some of whose shapes have lobes that are not diffuse."""

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
        mode: "mi.TransportMode",
        camera: bool,
        highlights: Any = None,
        first: "Sequence[mi.Float]" = (),
    ) -> Trail:
        """Follow rays of a ``number`` each (UInt32 [n]), which have ``met`` a lobe, to the first diffuse one that they
        draw; returns a Trail.

        hit: the name of what they have met. mode: mi.TransportMode.Importance for rays that carry power, Radiance for
        those that look for light. camera: the first surface's own light counts, too. highlights: how rough lobes see
        lamps; without, only by their own rays. first: uniform numbers that the first lobe is drawn with, three, and
        then its lines (Float [n]); those of well spread rays are well spread, too.
        """
        n = dr.width(ray.d)
        random = mi.PCG32(initstate=mi.sample_tea_64(number, seed, ROUNDS), initseq=mi.UInt64(number))
        state = (dr.full(mi.Bool, True, n), met, ray, dr.zeros(mi.UInt32, n), random, Trail.straight(hit, ray.d))
        if highlights is None and not first:
            with _garbage_kept():
                return self._frozen(ref(rays), state, mode, camera)[-1]
        # Most rays are done after one lobe: the others go on side by side, and do not keep these waiting.
        alive, *state = self._past(rays, state, mode, camera, highlights, first, only_one=True)
        dr.eval(alive, state)
        trail, on = state[-1], dr.compress(alive)
        if dr.width(on):
            state = dr.full(mi.Bool, True, dr.width(on)), *(dr.gather(type(x), x, on) for x in state)
            dr.scatter(trail, self._past(rays, state, mode, False, highlights)[-1], on)
        return trail

    def _past(self, rays, state, mode, camera, highlights=None, first=(), only_one=False):
        """The state of rays past all lobes, or past one."""
        ctx, gloss = mi.BSDFContext(mode), Gloss(mode)

        def step(alive, met, ray, depth, random, trail):
            chance = _Chance(random, depth == 0, first)
            return self._step(rays, ctx, gloss, camera, highlights, alive, met, ray, depth, chance, trail)

        return step(*state) if only_one else dr.while_loop(state, lambda alive, *_: alive, step)

    def _step(self, rays, ctx, gloss, camera, highlights, alive, met, ray, depth, chance, trail):
        """Past one more surface that has other lobes than a diffuse one."""
        before, on_patch = trail.weight, trail.patch != NONE
        si = met.compute_surface_interaction(ray, mi.RayFlags.All, alive)
        s, st = chance.next_float32(), mi.Point2f(chance.next_float32(), chance.next_float32())
        bsdf = si.bsdf(ray)
        sample, value = bsdf.sample(ctx, si, s, st, alive)
        parts = mi.Float(0), mi.Float(0)
        if rays.glossy:
            parts = gloss.shares(bsdf, si, alive)
            value = gloss.weigh(bsdf, si, sample, value, parts)
        value = dr.select(alive & is_sound(si, sample, value), value, 0)
        drawn = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Diffuse)
        coated = alive & drawn & on_patch & (dr.max(value) > 0)
        on = alive & ~coated
        rough = on & (parts[0] > 0) & ~mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta | mi.BSDFFlags.Null)

        shines = alive & on_patch & (trail.bounced | camera)
        glow = before * dr.gather(mi.Color3f, rays.patches.emission, trail.patch, shines) * trail.share
        if highlights is not None:
            glow += before * highlights.light(gloss, parts[0], bsdf, si, chance, alive & (parts[0] > 0))
        # Light that a side reflects or transmits diffusely counts as received by that side, which sends it on.
        albedo = dr.gather(mi.Color3f, rays.albedo, trail.patch, coated)
        factor = dr.select(coated, dr.select(albedo > 0, value / albedo, 0), dr.select(on, value, 1))
        if rays.patches.transmittance is None:
            # Sides with a diffuse lobe count all that meets them as received, the others nothing.
            taken = dr.select(on, before * (dr.select(on_patch, 0, 1) - value), 0)
        else:
            # The same on average, but exact for each ray: albedo varies with direction, and so does what is received.
            taken = dr.select(alive, before * (1 - factor), 0)

        depth += 1
        lives = dr.select(on & (depth > ROULETTE), dr.minimum(dr.max(before * factor), 0.95), 1)
        goes_on = on & (dr.max(before * factor) > 0) & (chance.random.next_float32() < lives) & (depth < MOST)
        ray = dr.select(goes_on, si.spawn_ray(si.to_world(sample.wo)), ray)
        met = rays.scene.ray_intersect_preliminary(ray, active=goes_on)
        hit, share = rays.locate(met, ray.d), mi.Float(1)
        if highlights is not None:  # lines look for lamps as well
            pdf = gloss.light(bsdf, si, sample.wo, parts[0], rough)[1]
            share = dr.select(pdf > 0, pdf / (pdf + highlights.density(ray.o, ray.d, hit)), 1)
        trail = Trail(
            valid=hit.valid | ~goes_on,
            patch=dr.select(goes_on, hit.patch, dr.select(on, NONE, trail.patch)),
            u=dr.select(goes_on, hit.u, trail.u),
            v=dr.select(goes_on, hit.v, trail.v),
            direction=ray.d,
            weight=dr.select(on & ~goes_on, 0, before * factor / dr.maximum(lives, 1e-6)),
            bounced=trail.bounced | on,
            traced=trail.traced | alive,
            coated=coated,
            taken=trail.taken + taken,
            glow=trail.glow + glow,
            share=dr.select(goes_on, share, trail.share),
            rough=dr.select(trail.bounced, trail.rough, rough),
        )
        return goes_on & hit.traced, met, ray, depth, chance.random, trail


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


class _Chance:
    """Uniform numbers: of a generator, but for the first few of those who have some ``given``."""

    def __init__(self, random: "mi.PCG32", has: "mi.Bool", given: "Sequence[mi.Float]") -> None:
        self.random, self._has, self._given = random, has, list(given)

    def next_float32(self) -> "mi.Float":
        number = self.random.next_float32()
        return dr.select(self._has, self._given.pop(0), number) if self._given else number
