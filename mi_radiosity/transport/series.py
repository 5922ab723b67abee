"""Transport of power over a mesh: the Neumann series of radiosity by stochastic Jacobi iterations."""

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, apportion, opaque_index, totals
from ..core.points import Stream, hash_pair, stream_seed
from ..mesh.hierarchy import pull, push
from .deposit import pair_of, spread, straight, trusted
from .emit import LampEmitter, LeafEmitter, numbered_by_leaf, numbered_through
from .landings import Landings
from .problem import Flow, Problem, Record
from .tally import Tally

ITERATIONS = 64  # after so many the rest is summed in closed form
LEAST_RAYS = 64  # of an iteration
GLANCE = 0.25  # of the lamps' rays, where only their total is asked for


class Transport:
    """A way to carry the power of a scene over its mesh: called with a Problem, an exact number of rays and a seed, it
    returns a Flow. progress is told the rays done so far; first_share, where it is known, is the lamps' part of all
    power shot."""

    def __call__(
        self,
        problem: Problem,
        rays: int,
        seed: int,
        first_share: float = 0.5,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Flow:
        raise NotImplementedError


@dataclass(frozen=True)
class Shooting(Transport):
    """Shoots all power with rays that leave it at pairs (`deposit`), iteration after iteration.

    B = E + ρ H is summed as the Neumann series Σ_k H_k of irradiances (eq. 1). Iteration k shoots the power
    ρ H_(k−1) A that is unshot, with rays in proportion to it (`LeafEmitter`). Where faces transmit diffusely, ρ H is
    ρ_a H_a + τ_b H_b of their sides (`Scattering`).

    The lamps get ``first_share`` of the rays. With λ the share of power that survives an iteration, every later one
    takes 1 − λ of the rays left, so that all rays carry about the same power. Once less than ``tail`` of the power is
    left, the last iteration stands for all that would follow, H_k (1 + λ + λ² + …) (Lyusternik's closure): no power
    is lost however large ρ is. Where the light straight from the lamps is `Known`, their rays only find how much of it
    there is in all, and what comes through lobes; a few do.

    tail: share of the power below which the rest is summed in closed form. numbering: which points rays have. deposit:
    who receives their power. records: keep the rays, to discover pairs with.
    Source: Bekaert, "Hierarchical and stochastic algorithms for radiosity", 1999.
    """

    tail: float = 0.0001
    numbering: Callable = numbered_through
    deposit: Callable = trusted
    records: bool = False

    def __call__(
        self,
        problem: Problem,
        rays: int,
        seed: int,
        first_share: float = 0.5,
        progress: Callable[[int], None] = lambda done: None,
    ) -> Flow:
        series = _Series(self, problem, rays, seed, first_share)
        while series.left > 0 and sum(series.unshot) > 0:
            series.iterate(progress)
        return series.flow()


PILOT = Shooting(tail=0.1, numbering=numbered_by_leaf, deposit=spread, records=True)


class _Series:
    """One run of Shooting."""

    def __init__(self, how: Shooting, problem: Problem, rays: int, seed: int, first_share: float) -> None:
        self.how, self.problem, self.seed, self.rays = how, problem, seed, rays
        elements, area = problem.elements, problem.exposure.open_area
        self.area = mi.Float64(dr.gather(mi.Float, area, elements.leaves))
        self.power = [mi.Float64(e) * self.area for e in elements.emission(elements.leaves)]
        self.lamps = [(LampEmitter(light), list(light.power())) for light in problem.model.lights.free]
        self.on_surfaces = totals(self.power)
        self.unshot = [sum(p) for p in zip(self.on_surfaces, *(power for _, power in self.lamps))]
        self.emitted, self.escaped, self.blocked = self.unshot, [0.0] * 3, [0.0] * 3
        n = dr.width(elements.leaves)
        self.direct, self.indirect, self.caustic = ([dr.zeros(mi.Float64, n) for _ in range(3)] for _ in range(3))
        self.traces = problem.model.rays.lobes is not None
        self.focuses = self.traces and problem.model.lights.may_be_sharp
        self.share, self.left, self.shot, self.iteration = first_share, rays, 0.0, 0
        self.landings, self.all_landings = None, Landings(problem.exposure.slots)
        self.records: list[Record] = []

    def iterate(self, progress):
        """Shoot what is unshot; what is reflected of it becomes the unshot power of the next iteration."""
        little = sum(self.unshot) <= self.how.tail * self.share * sum(self.emitted)
        last = self.iteration > 0 and (self.iteration == ITERATIONS - 1 or little)
        share = self.share * (GLANCE if self.iteration == 0 and self.problem.known and not self.traces else 1)
        count = self.left if last else min(self.left, max(LEAST_RAYS, round(self.left * share)))
        tally, direct, focused = self._shoot(count, progress)
        self.left -= count
        # Systematic sampling keeps the total only to a few rays: restore it exactly.
        scale = [u / s if s > 0 else 0.0 for u, s in zip(self.unshot, tally.sent())]
        received = self._received(tally, scale)
        if self.iteration == 0:
            straight = received if direct is None else self._received(direct, scale)
            self.direct = self._better(straight)
            received = [h - a + b for h, a, b in zip(received, straight, self.direct)]
        self.power = [b * self.area for b in self.problem.scattering.of_leaves(received)]
        after = totals(self.power)
        closes = self.left == 0
        closure = [1 / max(1 - a / u, 1e-6) if closes and u > 0 else 1.0 for a, u in zip(after, self.unshot)]
        self.indirect = [i + h * dr.opaque(mi.Float64, c) for i, h, c in zip(self.indirect, received, closure)]
        if self.iteration == 0:
            self.indirect = [i - h for i, h in zip(self.indirect, self.direct)]
            self.caustic = self.caustic if focused is None else self._received(focused, scale)
        dr.eval(self.direct, self.indirect, self.power)
        bins = (self.escaped, Tally.ESCAPED), (self.blocked, Tally.BLOCKED), (self.blocked, Tally.TAKEN)
        for lost, which in bins:
            lost[:] = [x + y * s * c for x, y, s, c in zip(lost, tally.lost(which), scale, closure)]
        self.shot += sum(u * c for u, c in zip(self.unshot, closure))
        self.share = 1 - min(sum(after) / sum(self.unshot), 0.999)
        self.unshot = after if self.left else [0.0] * 3
        self.iteration += 1

    def _better(self, shot):
        """Irradiance straight from the lamps: what is known of it, as much in all as was shot (3 Float64 [leaves])."""
        known = self.problem.known
        if known is None:
            return shot
        self.landings = known.landings.filled_by(self.landings)
        have, want = (totals([h * self.area for h in light]) for light in (known.direct, shot))
        return [k * dr.opaque(mi.Float64, w / h) if h > 0 else s for k, s, h, w in zip(known.direct, shot, have, want)]

    def _received(self, tally, scale):
        """Irradiance of the leaves from a Tally (3 Float64 [leaves])."""
        received = push(self.problem.elements, tally, self.problem.elements.leaves, self.problem.exposure.open_area)
        received = [h * dr.opaque(mi.Float64, s) for h, s in zip(received, scale)]
        if self.problem.clusters:
            received = self.problem.clusters.means(received, self.area)
        dr.eval(received)
        return received

    def _emitters(self, count):
        """Who shoots in this iteration, and how many rays."""
        if self.iteration or not self.lamps:
            reflected = LeafEmitter(self.problem, self.power, sum(self.unshot), self.how.numbering, self.landings)
            return [(reflected, count)]
        powers, emitters = [sum(power) for _, power in self.lamps], [emitter for emitter, _ in self.lamps]
        if sum(self.on_surfaces) > 0:
            powers.append(sum(self.on_surfaces))
            emitters.append(LeafEmitter(self.problem, self.power, powers[-1], self.how.numbering))
        return [(emitter, n) for emitter, n in zip(emitters, apportion(count, powers, 1)) if n]

    def _shoot(self, count, progress):
        """Cast ``count`` rays and tally what arrives where: in all; straight, and focused (see `Flow`), if the first
        rays may come otherwise."""
        first, n = self.iteration == 0, len(self.problem.elements)
        tally = Tally(n, self.unshot, self.traces)
        direct, focused = (
            Tally(n, self.unshot, self.traces) if first and x else None for x in (self.traces, self.focuses)
        )
        landings = Landings(self.problem.exposure.slots)
        cast = self.rays - self.left
        for emitter, share in self._emitters(count):
            for batch in emitter.batches(share, self.iteration, self.seed):
                self._cast(batch, tally, landings, direct, focused)
                cast += dr.width(batch.number)
                progress(cast)
        self.landings = landings.settled()
        return tally, direct, focused

    def _cast(self, batch, tally, landings, direct, focused):
        problem = self.problem
        seed = opaque_index(stream_seed(self.seed, Stream.LOBES, self.iteration))
        hit = problem.model.rays.follow(batch.origin, batch.direction, batch.number, seed)
        pair = pair_of(problem, batch, hit)
        receiver = self.how.deposit(problem, hit, pair)
        on_patch = hit.patch != NONE
        # Rays that start inside a solid go nowhere; the others of their element carry their power.
        goes = ~batch.doubtful | on_patch | ~hit.valid | hit.traced
        rays = problem.model.rays
        if rays.has_rooms_behind_backs:
            start = dr.gather(mi.Vector3f, rays.patches.normal, batch.patch, ~goes)
            goes |= ~rays.meets_solid(batch.origin, batch.direction, ~goes, start)
        tally.add(batch, hit, receiver, batch.starts & goes)
        if direct is not None:
            direct.add(batch, hit, receiver, batch.starts & goes & ~hit.bounced)
        if focused is not None:
            focused.add(batch, hit, receiver, batch.starts & goes & batch.sharp & hit.bounced & ~hit.rough)
        if self.how.records:
            met = dr.select(straight(batch, hit), hit.patch, NONE)
            record = Record(met, hit.u, hit.v, batch.patch, batch.u, batch.v, pair)
            dr.eval(record.i, record.ui, record.vi, record.j, record.uj, record.vj, record.pair)
            self.records.append(record)
        if landings.slots:
            slot = dr.gather(mi.UInt32, problem.exposure.slot, receiver, on_patch)
            number = hash_pair(batch.number, mi.UInt32(self.iteration))
            for seats in (landings, self.all_landings):
                seats.offer(slot, hit.u, hit.v, number, on_patch & (slot != NONE))

    def flow(self):
        elements, area = self.problem.elements, self.problem.exposure.open_area
        return Flow(
            direct=pull(elements, self.direct, area),
            indirect=pull(elements, self.indirect, area),
            caustic=pull(elements, self.caustic, area) if self.focuses else None,
            landings=self.all_landings.settled(),
            rays=self.rays - self.left,
            iterations=self.iteration,
            first_share=sum(self.emitted) / self.shot if self.shot else 1.0,
            emitted=self.emitted,
            escaped=self.escaped,
            blocked=self.blocked,
            unshot=self.unshot,
            records=tuple(self.records),
        )
