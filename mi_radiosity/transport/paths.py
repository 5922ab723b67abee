"""Paths past surfaces that are not plainly diffuse, to where the cache of radiosity ends them.

Every vertex evaluates Mitsuba's own BSDF f in Mitsuba's own shading frame: one shadow ray to an area emitter, one to
each other emitter, and one continuation by `bsdf.sample`, weighted by the power heuristic (Veach 1997, eq. 9.13). The
cache holds, for every element, the exitance ρ H of its diffuse lobe, and τ H of the other side where a face transmits
diffusely. As f = ρ/π + (f − ρ/π) for any ρ, a path that reads the cache at a vertex goes on from there with f − ρ/π in
the place of f (f − τ/π to the other side), and nothing is lost or counted twice.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, replaced
from ..core.points import ROUNDS, triangle
from ..mesh import Elements
from ..scene import Model
from ..scene.hit import Hit
from .lamps import LampChoice

ROULETTE = 5  # vertices after which a path may end by chance, as in `path`
MAX_DEPTH = 64  # vertices after which it ends
WIDE = 10.0  # density of a sampled direction, 1/sr, below which the cache is read from then on
RESIDUAL = 4.0  # times its throughput: the probability that a path goes on after it has read the cache
CANDIDATES = 4  # points of emitters that a shadow ray is chosen from

Reflectance = Callable[..., "mi.Color3f"]


@dataclass
class PathEnd:
    """What paths have found, and where they read the cache; one entry per path.

    A path may read the cache at several vertices. One of them is kept, with a probability in proportion to its
    throughput, and its ``weight`` stands for the others as well (Chao 1982: weighted reservoir sampling).
    """

    light: "mi.Color3f"  # π L of the emitters that were found, times the throughput, W/m²
    weight: "mi.Color3f"  # of π L in the cache
    leaf: "mi.UInt32"  # NONE where the cache is not read
    patch: "mi.UInt32"
    u: "mi.Float"
    v: "mi.Float"
    straight: "mi.Bool"  # only null lobes came before the vertex that is kept
    passed: "mi.Bool"  # a surface scattered the path, other than by a null lobe

    @staticmethod
    def at(leaf: "mi.UInt32", hit: Hit) -> "PathEnd":
        """Paths that read the cache at their first hit, where ``leaf`` is not NONE."""
        yes = mi.Bool(True)
        return PathEnd(mi.Color3f(0), mi.Color3f(1), leaf, hit.patch, hit.u, hit.v, yes, ~yes)


@dataclass
class _Vertex:
    """A vertex of paths: the intersection and its name, and what led there."""

    met: "mi.PreliminaryIntersection3f"
    ray: "mi.Ray3f"
    hit: Hit
    leaf: "mi.UInt32"  # NONE off patches
    throughput: "mi.Color3f"
    reads: "mi.Bool"  # the path may read the cache from here on
    cached: "mi.Bool"  # ... and the cache stands for the diffuse lobe here
    scattered: "mi.Bool"  # a lobe that is no delta lobe came before


class Paths:
    """Follows paths through a Model whose leaves (of ``elements``) hold a cache.

    reflectance(leaf, patch, u, v, active): the ρ that the cache has at points (Color3f [n]). caustic: irradiance that
    no path can find (Color3f [elements]), added at vertices where the cache is not read; None if there is none.
    left_out(direction): is light from there found by power rays alone, after a delta lobe (Bool [n])?
    """

    def __init__(
        self,
        model: Model,
        elements: Elements,
        reflectance: Reflectance,
        left_out: "Callable[[mi.Vector3f], mi.Bool]",
        caustic: "mi.Color3f | None" = None,
    ) -> None:
        self._model, self._elements = model, elements
        self._reflectance, self._left_out, self._caustic = reflectance, left_out, caustic

    def follow(
        self,
        met: "mi.PreliminaryIntersection3f",
        hit: Hit,
        ray: "mi.Ray3f",
        number: "mi.UInt32",
        seed: "mi.UInt32",
        active: "mi.Bool",
        reads: bool,
        scattered: bool,
        first: "Sequence[mi.Float]" = (),
    ) -> PathEnd:
        """Where paths end whose first hits are known; what these emit is the caller's to count.

        met, hit: the first hits. number (UInt32 [n]), seed (UInt32): what random numbers are made from. reads: the
        cache is read from the first hit on, else once a wide lobe has scattered the path. scattered: a diffuse lobe
        came before. first: six uniform numbers (Float [n]) for the first vertex, three for a shadow ray and three for
        `bsdf.sample`.
        """
        leaf = self._leaf(hit, active)
        end = PathEnd.at(leaf, hit)
        if self._model.materials.all_plain:
            return end
        # Paths that go on do so side by side, and do not keep the others waiting.
        every = dr.zeros(mi.UInt32, dr.width(leaf))
        states = [met, hit, leaf, mi.Point3f(ray.o + every), mi.Vector3f(ray.d), number + every, seed + every, *first]
        dr.eval(states)
        on = dr.compress(active & hit.traced)
        if dr.width(on) == 0:
            return end
        met, hit, leaf, origin, direction, number, seed, *first = (dr.gather(type(x), x, on) for x in states)
        n = dr.width(on)
        read, before = (dr.full(mi.Bool, flag, n) for flag in (reads, scattered))
        vertex = _Vertex(
            met=met,
            ray=mi.Ray3f(origin, direction),
            hit=hit,
            leaf=leaf,
            throughput=dr.full(mi.Color3f, 1, n),
            reads=read,
            cached=self._has_cache(hit, leaf) & read,
            scattered=before,
        )
        random = mi.PCG32(initstate=mi.sample_tea_64(number, seed, ROUNDS), initseq=mi.UInt64(number))
        return replaced(end, on, self._past(vertex, random, first))

    def _past(self, vertex, random, first):
        """Where paths end that go on from a first vertex."""
        n = dr.width(vertex.leaf)
        yes, no, black = dr.full(mi.Bool, True, n), dr.full(mi.Bool, False, n), dr.zeros(mi.Color3f, n)
        none, hit = dr.full(mi.UInt32, NONE, n), vertex.hit
        end = PathEnd(black, black + 1, none, hit.patch, hit.u, hit.v, yes, no)
        state = yes, vertex, dr.zeros(mi.Float, n), dr.zeros(mi.UInt32, n), random, end
        # Most paths are done after one vertex: the others go on side by side.
        alive, *state = self._step(*state, first)
        dr.eval(alive, state)
        end, on = state[-1], dr.compress(alive)
        if dr.width(on):
            some = [dr.gather(type(x), x, on) for x in state]
            some = dr.while_loop((dr.full(mi.Bool, True, dr.width(on)), *some), lambda alive, *_: alive, self._step)
            end = replaced(end, on, some[-1])
        return end

    def _step(self, alive, vertex, whole, depth, random, end, first=()):
        """Past one more vertex. ``whole``: throughputs of all vertices where the path has read the cache."""
        model, chance = self._model, _Chance(random, first)
        si = vertex.met.compute_surface_interaction(vertex.ray, mi.RayFlags.All, alive)
        bsdf = si.bsdf(vertex.ray)
        lot, s, t = (chance.next() for _ in range(3))
        s1, s2 = chance.next(), mi.Point2f(chance.next(), chance.next())

        # Read the cache, if there is one here; what it has of the BSDF is taken from that.
        hit, leaf, cached = vertex.hit, vertex.leaf, alive & vertex.cached
        face = dr.gather(mi.UInt32, model.patches.face, hit.patch, cached)
        opacity = model.materials.relative_opacity(si, face, cached)
        end, whole = _kept(end, whole, cached, vertex.throughput * opacity, leaf, hit, random)
        rho = self._reflectance(leaf, hit.patch, hit.u, hit.v, cached) * opacity
        behind, tau = model.patches.behind(hit.patch, cached), mi.Color3f(0)
        if behind is not None:
            tau = behind[1] * opacity
        lobe = _Residual(bsdf, si, dr.select(cached, rho, 0), tau)

        # Next-event estimation, and what no path can find.
        light = self._from_area(lobe, si, leaf, lot, s, t, random, alive) + self._from_others(lobe, si, s, t, alive)
        if self._caustic is not None:
            full = alive & ~vertex.cached & (leaf != NONE)
            e = self._elements
            light += dr.gather(mi.Color3f, self._caustic, leaf, full) * dr.gather(mi.Color3f, e.reflectance, leaf, full)
        light = dr.select(alive, vertex.throughput * light, 0)

        # Sample a direction; Russian roulette.
        wo, value, pdf, kind = lobe.sample(s1, s2, alive)
        delta = mi.has_flag(kind, mi.BSDFFlags.Delta)
        throughput = vertex.throughput * value
        most, late = dr.max(dr.abs(throughput)), depth + 1 > ROULETTE
        lives = dr.select(vertex.cached & ~delta, dr.minimum(RESIDUAL * most, 1), 1)
        lives = dr.minimum(lives, dr.select(late, dr.minimum(most, 0.95), 1))
        goes_on = alive & (most > 0) & (random.next_float32() < lives) & (depth + 1 < MAX_DEPTH)
        throughput = dr.select(goes_on, throughput / dr.maximum(lives, 1e-6), 0)

        # Trace. Emitters that are hit are weighed against the shadow rays that find them as well.
        ray = dr.select(goes_on, si.spawn_ray(si.to_world(wo)), vertex.ray)
        met = model.rays.scene.ray_intersect_preliminary(ray, active=goes_on)
        hit = model.rays.locate(met, ray.d)
        on_patch, escaped = goes_on & (hit.patch != NONE), goes_on & ~hit.valid
        density = self._density(si.p, leaf, ray.d, hit, on_patch, escaped)
        share = dr.select(delta, 1, _heuristic(pdf, density))
        left_out = delta & vertex.scattered & self._left_out(ray.d)
        emitted = model.lights.at(model.patches, hit.patch, hit.u, hit.v, on_patch)
        emitted += model.lights.sky(ray.d, escaped & ~left_out)
        light += dr.select(goes_on, throughput * emitted * share, 0)

        # A plainly diffuse surface ends the path if the cache may be read there.
        leaf, reads = self._leaf(hit, goes_on), vertex.reads | (~delta & (pdf < WIDE))
        cached = reads & self._has_cache(hit, leaf)
        passed = end.passed | (alive & ~mi.has_flag(kind, mi.BSDFFlags.Null))
        end = replace(end, light=end.light + light, passed=passed)
        end, whole = _kept(end, whole, cached & ~hit.traced, throughput, leaf, hit, random)
        vertex = _Vertex(met, ray, hit, leaf, throughput, reads, cached, vertex.scattered | ~delta)
        return goes_on & hit.valid & (hit.traced | ~cached), vertex, whole, depth + 1, random, end

    def _leaf(self, hit, active):
        """The leaves of hits, NONE off patches (UInt32 [n])."""
        on_patch = active & (hit.patch != NONE)
        return dr.select(on_patch, self._elements.leaf_at(hit.patch, hit.u, hit.v, on_patch), NONE)

    def _has_cache(self, hit, leaf):
        """Does the cache stand for the diffuse lobe at hits (Bool [n])? It knows geometric normals only."""
        model, on_patch = self._model, leaf != NONE
        face = dr.gather(mi.UInt32, model.patches.face, hit.patch, on_patch)
        return on_patch & ~model.materials.is_bent(face, on_patch)

    # ---- Emitters ------------------------------------------------------------------------------

    @property
    def _emitters(self):
        return LampChoice.of(self._elements)

    def _from_area(self, lobe, si, leaf, lot, s, t, random, active):
        """π L that a lobe sends on of area emitters: one shadow ray (Color3f [n], W/m²).

        Its end is chosen from CANDIDATES in proportion to what each would bring if nothing were between (Talbot, Cline,
        Egbert 2005: resampled importance).
        """
        patches, emitters = self._model.patches, self._emitters
        if emitters.count == 0:
            return mi.Color3f(0)
        n, count = dr.width(si.p), min(CANDIDATES, emitters.count)
        kept = [dr.zeros(mi.UInt32, n), *(dr.zeros(mi.Float, n) for _ in range(2)), dr.full(mi.Float, 1, n)]
        whole, own = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
        for k in range(count):
            part = (lot + k) / count  # stratified over the emitters
            lamp, density = emitters.draw(part, leaf)
            u, v = triangle(*(_fraction(x + k * step) for x, step in ((s, 0.75487767), (t, 0.56984029))))
            d = patches.point(lamp, u, v) + patches.origin - si.p
            r2 = dr.squared_norm(d)
            cosine = dr.maximum(-dr.dot(dr.gather(mi.Vector3f, patches.normal, lamp, active), d), 0)
            power = dr.max(dr.gather(mi.Color3f, patches.emission, lamp, active))
            weight = dr.select(r2 > 0, power * cosine / (density * r2 * dr.sqrt(r2)), 0)
            whole += weight
            takes = weight > 0 if k == 0 else random.next_float32() * whole < weight
            kept = [dr.select(takes, new, old) for new, old in zip((lamp, u, v, density), kept)]
            own = dr.select(takes, weight, own)
        lamp, u, v, density = kept
        d = patches.point(lamp, u, v) + patches.origin - si.p
        distance = dr.norm(d)
        cosine = -dr.dot(dr.gather(mi.Vector3f, patches.normal, lamp), d) / distance
        on = active & (whole > 0) & (cosine > 0) & self._model.rays.on_top(lamp, u, v)
        density = dr.select(on, density * dr.square(distance) / cosine, 1)  # over directions
        light = self._model.lights.at(patches, lamp, u, v, on) * (whole / (count * own))
        return self._along(lobe, si, d / distance, distance, light / density, density, on)

    def _from_others(self, lobe, si, s, t, active):
        """The same of emitters that are no surfaces: a shadow ray to each (Color3f [n])."""
        total = mi.Color3f(0)
        for emitter in self._model.lights.free:
            direction, distance, irradiance = emitter.sample(si.p, s, t)
            on = active & (dr.max(irradiance) > 0)
            total += self._along(lobe, si, direction, distance, dr.pi * irradiance, emitter.density(direction), on)
        return total

    def _along(self, lobe, si, direction, distance, light, density, on):
        """What becomes of light π L, over its density, from so far along a direction."""
        value, pdf = lobe.eval_pdf(si.to_local(direction), on)
        on = on & (dr.max(dr.abs(value)) > 0)
        near, far = si.spawn_ray_to(si.p + direction * distance), si.spawn_ray(direction)
        on &= ~self._model.rays.scene.ray_test(dr.select(dr.isfinite(distance), near, far), active=on)
        return dr.select(on, value * light * dr.select(density > 0, _heuristic(density, pdf), 1), 0)

    def _density(self, x, leaf, direction, hit, on_patch, escaped):
        """Density over directions, 1/sr, of the shadow rays that find what rays from x have hit: area emitters, or what
        is around the scene (Float [n])."""
        patches, sky = self._model.patches, self._model.lights.sky_light
        density = mi.Float(0)
        if self._emitters.count:
            patch = dr.select(on_patch, hit.patch, 0)
            d = patches.point(patch, hit.u, hit.v) + patches.origin - x
            cosine = -dr.dot(dr.gather(mi.Vector3f, patches.normal, patch), direction)
            found = on_patch & (cosine > 0)
            of_area = self._emitters.density(patch, leaf, found)
            density = dr.select(found, of_area * dr.squared_norm(d) / cosine, 0)
        if sky is not None:
            density = dr.select(escaped, sky.density(direction), density)
        return density


class _Residual:
    """A BSDF without the Lambertian lobes that are in the cache, in the shading frame: (f − ρ/π) |cos θ| on the side
    of the path, (f − τ/π) |cos θ| on the other side."""

    def __init__(self, bsdf: "mi.BSDFPtr", si: "mi.SurfaceInteraction3f", rho: "mi.Color3f", tau: "mi.Color3f") -> None:
        self._bsdf, self._si, self._context = bsdf, si, mi.BSDFContext()
        self._rho, self._tau = rho, tau

    def _lambert(self, wo):
        return dr.select(self._si.wi.z * wo.z > 0, self._rho, self._tau) * dr.abs(wo.z) * dr.inv_pi

    def eval_pdf(self, wo: "mi.Vector3f", active: "mi.Bool") -> "tuple[mi.Color3f, mi.Float]":
        """Its value times cos θ, and the density of `sample`, 1/sr (Color3f, Float [n])."""
        value, pdf = self._bsdf.eval_pdf(self._context, self._si, wo, active)
        value, sound = _sound(value), dr.isfinite(pdf) & (pdf > 0)
        return dr.select(active, value - self._lambert(wo), 0), dr.select(active & sound, pdf, 0)

    def sample(self, s1: "mi.Float", s2: "mi.Point2f", active: "mi.Bool") -> tuple:
        """Direction, value over density, density (0 for delta lobes), and the kind of lobe (Vector3f, Color3f, Float,
        UInt32 [n])."""
        sample, value = self._bsdf.sample(self._context, self._si, s1, s2, active)
        delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
        pdf = dr.select(active & ~delta & dr.isfinite(sample.pdf), sample.pdf, 0)
        value = _sound(value) - dr.select(pdf > 0, self._lambert(sample.wo) / dr.maximum(pdf, 1e-30), 0)
        return sample.wo, dr.select(active & (delta | (pdf > 0)), value, 0), pdf, sample.sampled_type


def _kept(end, whole, reads, throughput, leaf, hit, random):
    """Ends and sums of throughputs, paths that read the cache once more keeping one of the vertices."""
    own = dr.select(reads, dr.max(dr.abs(throughput)), 0)
    whole = whole + own
    takes = reads & (random.next_float32() * whole < own)
    columns = dict(leaf=leaf, patch=hit.patch, u=hit.u, v=hit.v, straight=~end.passed)
    kept = {name: dr.select(takes, value, getattr(end, name)) for name, value in columns.items()}
    # Of the vertex that is kept: throughput / |throughput| times the sum.
    scale = whole / dr.select(own > 0, own, 1)
    before = end.weight * dr.select(reads & (whole > own), whole / dr.maximum(whole - own, 1e-30), 1)
    return replace(end, weight=dr.select(takes, throughput * scale, before), **kept), whole


def _heuristic(own, other):
    """Veach's power heuristic, own² / (own² + other²)."""
    return 1 / (1 + dr.square(other / dr.maximum(own, 1e-30)))


def _sound(value):
    """Values of BSDFs, 0 in the place of what is no number."""
    return dr.select(dr.all(dr.isfinite(value)), value, 0)


def _fraction(x):
    return x - dr.floor(x)


class _Chance:
    """Uniform numbers: those that are given, then those of a generator."""

    def __init__(self, random: "mi.PCG32", given: "Sequence[mi.Float]") -> None:
        self._random, self._given = random, list(given)

    def next(self) -> "mi.Float":
        return self._given.pop(0) if self._given else self._random.next_float32()
