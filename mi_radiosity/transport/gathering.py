"""The usual transport: power is shot first, then every leaf gathers the light that is shown, saved and exported."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, ColorSums, lower_bound, opaque_index, owned, totals
from ..core.points import Stream, cosine_direction, kronecker, lamp_lot, stream_seed, triangle
from ..mesh.hierarchy import pull
from ..scene.materials import WHITEST
from .emit import launches
from .gather import Gatherer, Places
from .landings import Landings
from .links import Links
from .problem import Flow, Known, Problem
from .series import GLANCE, Shooting, Transport

SHOOTING = Shooting()
RAYS_PER_LINE = 2  # rays into the room per line to the lamps
LEAST = 16  # lines per leaf, or half of the mean
BOUNCES = 4  # that rays follow from leaf to leaf


@dataclass(frozen=True)
class Gathering(Transport):
    """Leaves look for light: along lines to the lamps; then, when another transport has found the radiosity roughly,
    starting from what lines have found, along cosine-distributed rays into the room, which light is followed along
    from leaf to leaf (`Links`).

    A gathered ray serves the leaf it is meant for, and where its power is seen; a ray that is shot lands where chance
    has it. Large leaves get more, by the fourth root of their area, which was found best. Where the budget has no
    rays to spare, what was shot is shown.

    What is shot keeps all power to the letter: what is gathered is scaled to its total, as far as that is known better.

    first: what carries the power. share: of the rays are gathered with.
    """

    first: Transport = SHOOTING
    share: float = 0.9

    def __call__(
        self,
        problem: Problem,
        rays: int,
        seed: int,
        first_share: float = 0.5,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Flow:
        gathered = _Pass(problem, int(self.share * rays), stream_seed(seed, Stream.GATHER), progress)
        if gathered.rays == 0:
            return self.first(problem, rays, seed, first_share, progress)
        known = gathered.look_at_lamps()
        done = gathered.done
        problem = dataclasses.replace(problem, known=known)
        shot = self.first(problem, rays - gathered.rays, seed, first_share, lambda more: progress(done + more))
        return gathered.look_around(shot, known)


class _Pass:
    """One run of Gathering; ``rays`` is what it costs, ``budget`` at most, and ``done`` how many of them are cast."""

    def __init__(self, problem: Problem, budget: int, seed: int, progress: Callable[[int], None]) -> None:
        self._problem, self._seed, self._progress = problem, seed, progress
        self.done = self._before = 0
        lights, leaves = problem.model.lights, problem.elements.leaves
        area = mi.Float64(dr.gather(mi.Float, problem.exposure.open_area, leaves))
        whole, first = mi.Float64(dr.gather(mi.Float, problem.elements.area, leaves)), leaves
        if clusters := problem.clusters:
            area, whole = clusters.sums([area, area, area])[0], clusters.sums([whole, whole, whole])[0]
            first = dr.gather(
                mi.UInt32, clusters.member, dr.gather(mi.UInt32, clusters.start, dr.arange(mi.UInt32, clusters.count))
            )
            first = dr.gather(mi.UInt32, leaves, first)
        self._open, self._keys = area / whole, problem.elements.key(first)
        dr.eval(self._open, self._keys)
        area = np.array(area)
        # A line looks at one of the lamps that are surfaces, and at each of the others; a ray, where it ends, at those
        # of sharp light.
        self._sharp_lamps = sum(light.may_be_sharp for light in lights.free)
        self._line_cost, self._ray_cost = len(lights.free) + bool(lights.exitance.any()), 1 + self._sharp_lamps
        cost = self._line_cost + RAYS_PER_LINE * self._ray_cost
        self._lines = _share_out(area**0.25, budget // cost)
        self._count = int(self._lines.sum())
        self.rays = cost * self._count

    def look_at_lamps(self) -> Known:
        """Irradiance straight from the lamps, by lines to them."""
        e, exposure, model = self._problem.elements, self._problem.exposure, self._problem.model
        bound = [1e5 * self._most_from_lamps() * int(self._lines.max())] * 3
        self._direct, self._sharp, self._alone = (ColorSums(len(self._lines), bound) for _ in range(3))
        self._landings = Landings(exposure.slots)
        nothing = dr.zeros(mi.Color3f, len(e))
        self._gatherer = Gatherer(model, e, exposure, Landings(0), nothing, self._sharp_lamps > 0)
        self._sample_all(self._alone)
        return Known(self._seen(), self._landings.settled())

    def look_around(self, flow: Flow, known: Known) -> Flow:
        """``flow`` with its irradiance replaced by what the leaves gather in the room, and have found of the lamps."""
        e, exposure = self._problem.elements, self._problem.exposure
        scattering = self._problem.scattering
        reflected = scattering.of_elements(pull(e, known.direct, exposure.open_area) + flow.indirect)
        self._gatherer = self._gatherer.seeing(reflected, known.landings.filled_by(flow.landings))
        most = self._most_from_lamps() + dr.max(flow.direct + flow.indirect, axis=None)[0]
        glow = ColorSums(len(self._lines), [1e5 * most * int(self._lines.max())] * 3)
        self._before = flow.rays
        lobes = self._problem.model.rays.lobes is not None
        links = Links(self._starts(RAYS_PER_LINE), RAYS_PER_LINE * self._count, exposure, lobes)
        self._sample_all(glow, links)
        landings = self._landings.settled().filled_by(flow.landings)
        links.look(self._gatherer.seeing(reflected, landings))
        direct, sharp = (self._means(sums) for sums in (self._direct, self._sharp))
        indirect = self._bounced(links, glow, direct, sharp, flow)
        light = dict(zip(("direct", "indirect"), self._scaled(flow, direct, indirect)))
        if self._sharp_lamps:
            light["sharp"] = pull(e, sharp, exposure.open_area)
        return dataclasses.replace(flow, **light, landings=landings, rays=flow.rays + self.rays, shot=flow)

    def _bounced(self, links, glow, direct, sharp, flow):
        """Indirect light as rays have found it, from leaf to leaf, beginning with what was shot (3 Float64 [leaves]).
        Sharp light is what they look for where they end."""
        e = self._problem.elements
        leaves, rows = e.leaves, dr.arange(mi.UInt32, len(self._lines))
        shone, scattering = glow.gather(rows), self._problem.scattering
        direct, sharp = (mi.Color3f(*map(mi.Float, light)) for light in (direct, sharp))
        seen = direct - sharp + (0 if flow.caustic is None else _of(flow.caustic, leaves))

        def bounce(light):
            """Indirect light that comes of light on the leaves (Color3f [leaves] ─► 3 Float64 [leaves]). Shadow rays
            find the sharp light that is reflected, but not the sharp light that is transmitted."""
            reflected = dr.zeros(mi.Color3f, len(e))
            dr.scatter(reflected, scattering.of_leaves(light, light + sharp), leaves)
            dr.eval(reflected)
            indirect = self._averaged([g + s / RAYS_PER_LINE for g, s in zip(shone, links.sums(reflected))])
            dr.eval(indirect)
            return indirect

        # A ray that was shot into a white hollow stays there. What nobody who looks around has seen any light of is no
        # brighter than all the rest, by all its bounces.
        found = direct + mi.Color3f(*map(mi.Float, bounce(seen)))
        others = dr.opaque(mi.Float, dr.max(found, axis=None)[0] / flow.first_share)
        light = direct - sharp + dr.minimum(_of(flow.indirect, leaves), others + found / (1 - WHITEST))
        for _ in range(BOUNCES):
            indirect = bounce(light)
            light = seen + mi.Color3f(*map(mi.Float, indirect))
        return indirect

    def _starts(self, each):
        """Where the samples of rows begin, so many per line (UInt32 [rows + 1])."""
        return owned(mi.UInt32, np.concatenate([[0], np.cumsum(self._lines) * each]))

    def _sample_all(self, other, links=None):
        """Samples of all leaves: their lines, or rays if there are ``links`` to keep (see `_sample`)."""
        each, cost = (RAYS_PER_LINE, self._ray_cost) if links else (1, self._line_cost)
        start = links.start if links else self._starts(each)
        for sample in launches(self._count * each):
            self._sample(sample, start, links, other)
            self.done += dr.width(sample) * cost
            self._progress(self._before + self.done)

    def _means(self, sums):
        """Irradiance of the open part of the leaves from sums of samples (3 Float64 [leaves])."""
        return self._averaged(sums.gather(dr.arange(mi.UInt32, len(self._lines))))

    def _averaged(self, sums):
        """Irradiance from sums over the lines of leaves (3 Float64 [rows] ─► [leaves])."""
        lines = mi.Float64(owned(mi.Float, self._lines))
        means = [c / lines / self._open for c in sums]
        return self._problem.clusters.spread(means) if self._problem.clusters else means

    def _seen(self):
        """Light of the lamps as lines have found it. Next to a lamp a line may find any multiple of what there is; as
        no place has more light from surfaces than the brightest of them sends out, more than twice that is noise."""
        means = self._means(self._alone)
        if self._problem.model.lights.free or self._problem.model.lights.textured:
            return means
        most = dr.max(self._problem.model.patches.emission, axis=1)
        return [dr.minimum(h, mi.Float64(2 * c)) for h, c in zip(means, most)]

    def _scaled(self, flow, direct, indirect):
        """Gathered irradiance (two times 3 Float64 [leaves]) that is absorbed in all as what was shot is, as far as
        that can be trusted: in closed rooms, where no ray is lost, its total is exact (two Color3f [elements]). What
        only shooting finds is added."""
        e, exposure = self._problem.elements, self._problem.exposure
        area = mi.Float64(dr.gather(mi.Float, exposure.open_area, e.leaves))
        kept = [area * (1 - mi.Float64(r)) for r in dr.gather(mi.Color3f, e.reflectance, e.leaves)]

        def absorbed(light):
            """Power that the leaves keep, W: (1 − ρ) H A less what the other side transmits to them."""
            passed = self._problem.scattering.transmitted_to_leaves(light)
            return totals([h * k - mi.Float64(t) * area for h, k, t in zip(light, kept, passed)])

        nothing = dr.zeros(mi.Color3f, len(e))
        added = nothing, nothing if flow.caustic is None else flow.caustic
        have = [absorbed(light) for light in (direct, indirect)]
        want = [
            absorbed([mi.Float64(h) for h in dr.gather(mi.Color3f, light - more, e.leaves)])
            for light, more in zip((flow.direct, flow.indirect), added)
        ]
        if self._problem.model.rays.lobes is not None:  # how much of the light goes straight is known to chance only
            have, want = (2 * [[a + b for a, b in zip(*both)]] for both in (have, want))
        emitted = sum(flow.emitted)
        lost = min((sum(flow.escaped) + sum(flow.blocked)) / emitted, 1 - 1e-6) if emitted else 0.0
        # Relative variances of both totals, as if samples were independent: those that are lost are the shot's noise.
        first = flow.rays * flow.first_share * (GLANCE if self._problem.model.rays.lobes is None else 1)
        noise = lost / (1 - lost) / max(first, 1)
        # Power rays take every diffuse lobe as Lambertian, so that their totals are off by some per cent where there
        # are others beside it.
        trust = 0 if self._problem.model.materials.mixed else 1 / (1 + noise * self._count)
        for light, more, shown, total in zip((direct, indirect), added, have, want):
            factors = [1 + trust * (w / h - 1) if h > 0 else 1.0 for w, h in zip(total, shown)]
            light = [h * dr.opaque(mi.Float64, f) for h, f in zip(light, factors)]
            light = [h + mi.Float64(c) for h, c in zip(light, dr.gather(mi.Color3f, more, e.leaves))]
            yield pull(e, light, exposure.open_area)

    def _most_from_lamps(self):
        """E of the brightest lamp; of lamps that are no surfaces, what they would give all of the scene's area."""
        model = self._problem.model
        free = sum(sum(light.power()) for light in model.lights.free) / model.patches.total_area
        return dr.max(model.patches.emission, axis=None)[0] + 1e3 * free

    def _sample(self, sample, start, links, other):
        """Add up samples (UInt32 [n]): lines to lamps without ``links``, else rays into the room. ``other`` sums what
        lines find by themselves, and what lobes shine that rays find."""
        line = links is None
        problem = self._problem
        e, rays, patches = problem.elements, problem.model.rays, problem.model.patches
        row = lower_bound(start, sample + 1) - 1
        number = sample - dr.gather(mi.UInt32, start, row)
        seed, keys = opaque_index(self._seed + (not line)), self._keys
        x0, x1, s, t = kronecker(number, keys, seed, row)
        of = row
        if problem.clusters:
            of, x0 = problem.clusters.pick(row, x0)
        leaf = dr.gather(mi.UInt32, e.leaves, of)
        patch = dr.gather(mi.UInt32, e.patch, leaf)
        u, v = e.patch_point(leaf, *triangle(x0, x1))
        on_top = rays.on_top(patch, u, v)
        places = Places(patches.point(patch, u, v), dr.gather(mi.Vector3f, patches.normal, patch), leaf)
        if line:
            lot = lamp_lot(number, keys, seed, row)
            lamps, found = self._gatherer.lines_to_surfaces(places, lot, s, t, RAYS_PER_LINE, on_top)
            free, of_free, sharp = self._gatherer.lines_to_free(places, s, t, RAYS_PER_LINE, on_top)
            lamps, found = lamps + free, found + of_free
        else:
            direction = cosine_direction(places.normal, s, t)
            met = self._gatherer.follow(places, direction, sample, seed, RAYS_PER_LINE, on_top)
            lamps, shone = (met.lamps + met.sky) / RAYS_PER_LINE, met.glow / RAYS_PER_LINE
            sharp = dr.select(self._gatherer.is_sharp_sky(direction), met.sky / RAYS_PER_LINE, 0)
            found = shone + self._gatherer.reflected_by(met.end)
        if line or self._gatherer.glows:
            other.add(found if line else shone, row, on_top, runs=True)
        self._direct.add(lamps, row, on_top, runs=True)
        if self._sharp_lamps:
            self._sharp.add(sharp, row, on_top, runs=True)
        light = dr.sum(lamps + found)
        slot = dr.gather(mi.UInt32, problem.exposure.slot, leaf)
        if problem.exposure.slots:
            dr.eval(slot, u, v, on_top, light, [] if line else met.end)  # lest the rays be traced again
        if not line:
            links.keep(sample, met.end, on_top)
        self._landings.offer(
            slot, u, v, sample ^ (0 if line else 0x80000000), on_top & (light > 0) & (slot != NONE), light
        )


def _of(color, leaves):
    return dr.gather(mi.Color3f, color, leaves)


def _share_out(weight, total):
    """Whole numbers, none much smaller than the others, in proportion to weights, which add up to ``total`` at most
    (int [n]); all 0 if there are too few."""
    n = len(weight)
    if total < n:
        return np.zeros(n, dtype=np.int64)
    least = max(1, min(LEAST, total // (2 * n)))
    low, high = 0.0, total / max(weight.min(), 1e-300)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if np.maximum(least, np.floor(middle * weight)).sum() <= total else (low, middle)
    return np.maximum(least, np.floor(low * weight)).astype(np.int64)
