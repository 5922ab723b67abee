"""Distribution of power over the hierarchy: stochastic Jacobi radiosity with an exact ray budget."""

from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi

from ..scene.model import NONE
from ..core.points import ROUNDS, hash_pair, kronecker, triangle
from ..core.arrays import ColorSums, lower_bound, opaque_index, power_of_two, totals
from ..mesh.exposure import note_light

TAIL = 0.01  # share of the power below which the rest is summed in closed form
ITERATIONS = 64  # after so many the rest is summed in closed form, too
SEATS = 8  # points of a divided leaf that it sends light from
AT_ONCE = 1 << 23  # rays cast in one launch: bounds memory, and the time until an interrupt is heard
WEIGHTS = 2.0**46  # resolution of the ray distribution over elements


@dataclass
class Flow:
    """What one power distribution did. Power in W per channel, irradiance in W/m² per element.

    ``direct`` and ``indirect`` are Color3f [elements], right at the leaves and pulled to their
    ancestors.
    """

    direct: "mi.Color3f" = None
    indirect: "mi.Color3f" = None
    rays: int = 0
    iterations: int = 0
    first_share: float = 1.0  # of the power shot in all, the lamps' part
    emitted: list = field(default_factory=lambda: [0.0] * 3)
    escaped: list = field(default_factory=lambda: [0.0] * 3)
    blocked: list = field(default_factory=lambda: [0.0] * 3)  # absorbed by sides that reflect nothing
    unshot: list = field(default_factory=lambda: [0.0] * 3)


@dataclass
class RayRecord:
    """The rays of a pilot, to discover pairs with: source (j, uj, vj) to receiver (i, ui, vi)."""

    i: "mi.UInt32"
    ui: "mi.Float"
    vi: "mi.Float"
    j: "mi.UInt32"
    uj: "mi.Float"
    vj: "mi.Float"
    pair: "mi.UInt32"  # where each ray stands in the pair tree, NONE before its root exists


def distribute(pairs, rays, seed, *, first_share=0.5, tail=TAIL, record=None, progress=lambda done: None):
    """Shoot all power of the scene over elements and pairs with ``rays`` rays. Returns a Flow.

    B = E + ρ H is summed as the Neumann series Σ_k H_k of irradiances (eq. 1). Iteration k shoots
    the power ρ H_(k−1) A that is unshot, with rays in proportion to it: systematic over the
    elements, cosine-distributed, low-discrepancy in position and direction. A ray leaves its power
    at the receiver of the first pair without children on its way down; where nobody has evaluated
    that pair, something stands between the two, or a wall stands on the receiver, at the leaf it
    meets. Leaves that a wall divides send light from where it came down: no light behind walls.

    The lamps get ``first_share`` of the rays. With λ the share of power that survives an iteration,
    every later one takes 1 − λ of the rays left, so that all rays carry about the same power. Once
    less than ``tail`` of the power is left, the last iteration stands for all that would follow,
    H_k (1 + λ + λ² + …) (Lyusternik's closure): no power is lost however large ρ is.

    record: a list that receives the RayRecord of every iteration; then power stays at unevaluated
    pairs, which spreads it smoothly. progress is told the rays done so far.
    Source: Bekaert, "Hierarchical and stochastic algorithms for radiosity", 1999.
    """
    elements, model = pairs.elements, pairs.elements.model
    leaves = elements.leaf_indices()
    area = mi.Float64(dr.gather(mi.Float, elements.open_area, leaves))
    divided = (
        dr.gather(mi.UInt32, leaves, dr.compress(dr.gather(mi.Bool, elements.divided, leaves)))
        if record is None
        else None
    )
    reflectance = dr.gather(mi.Color3f, elements.reflectance, leaves)
    emission = dr.gather(mi.Color3f, model.emission, dr.gather(mi.UInt32, elements.patch, leaves))
    power = [mi.Float64(e) * area for e in emission]  # unshot, per channel [leaves]
    direct, indirect = ([dr.zeros(mi.Float64, dr.width(leaves)) for _ in range(3)] for _ in range(2))

    flow = Flow()
    unshot = flow.emitted = totals(power)
    share, left, shot, seats = first_share, rays, 0.0, None
    while left > 0 and sum(unshot) > 0:
        last = flow.iterations > 0 and (
            flow.iterations == ITERATIONS - 1 or sum(unshot) <= tail * share * sum(flow.emitted)
        )
        count = left if last else min(left, max(64, round(left * share)))
        if record is None:
            sums, seats = _shoot(
                pairs,
                leaves,
                power,
                unshot,
                count,
                flow.iterations,
                seed,
                lambda cast: progress(rays - left + cast),
                seats,
            )
            if dr.width(divided):
                leaf = dr.repeat(divided, SEATS)
                note_light(elements, leaf, *seats.points(leaf, dr.arange(mi.UInt32, dr.width(leaf))))
        else:
            sums, rays_seen = _shoot(
                pairs, leaves, power, unshot, count, flow.iterations, seed, lambda cast: None, pilot=True
            )
            record.append(rays_seen)
        left -= count
        # Systematic sampling keeps the total only to a few rays: restore it exactly.
        scale = [u / s if s > 0 else 0.0 for u, s in zip(unshot, sums.totals())]
        received = _push(elements, sums, leaves, scale)
        power = [h * mi.Float64(r) * area for h, r in zip(received, reflectance)]
        after = totals(power)
        closure = [1 / max(1 - a / u, 1e-6) if left == 0 and u > 0 else 1.0 for a, u in zip(after, unshot)]
        first = flow.iterations == 0
        for c in range(3):
            once, more = received[c], received[c] * dr.opaque(mi.Float64, closure[c] - first)
            direct[c], indirect[c] = (
                (direct[c] + once, indirect[c] + more) if first else (direct[c], indirect[c] + more)
            )
            lost = [sums.gather(opaque_index(len(elements) + k))[c][0] * scale[c] * closure[c] for k in range(2)]
            flow.escaped[c] += lost[0]
            flow.blocked[c] += lost[1]
        dr.eval(direct, indirect, power)
        shot += sum(u * c for u, c in zip(unshot, closure))
        share = 1 - min(sum(after) / sum(unshot), 0.999)
        unshot = after if left else [0.0] * 3
        flow.iterations += 1
    flow.rays, flow.unshot = rays - left, unshot
    flow.first_share = sum(flow.emitted) / shot
    flow.direct, flow.indirect = (pull(elements, leaves, area, irradiance) for irradiance in (direct, indirect))
    return flow


def _shoot(pairs, leaves, power, unshot, count, iteration, seed, progress, seats=None, pilot=False):
    """Cast ``count`` rays from leaves in proportion to ``power``; sum what arrives where.

    Returns the sums per element, followed by two bins for power that escapes and that is blocked,
    and the RayRecord if ``pilot``, else the Seats for the next iteration. progress is told how many
    of the rays are cast.
    """
    elements, model = pairs.elements, pairs.elements.model
    # Integer weights: the distribution is the same on any number of threads.
    scale = dr.opaque(mi.Float64, WEIGHTS / power_of_two(sum(unshot)))
    weight = mi.UInt64(dr.ceil((power[0] + power[1] + power[2]) * scale))
    cumulative = dr.cumsum(weight)
    dr.eval(cumulative, weight)
    whole = dr.gather(mi.UInt64, cumulative, dr.width(cumulative) - 1)[0]

    key = opaque_index(seed)
    jitter = mi.sample_tea_float32(opaque_index(iteration), key ^ 0x5EED, ROUNDS)
    dr.eval(jitter)
    spacing, n = dr.opaque(mi.Float64, whole / count), len(elements)
    sums, taken = ColorSums(n + 2, [4 * u for u in unshot]), None if pilot else Seats(n)
    for first in range(0, count, AT_ONCE):
        ray = opaque_index(first) + dr.arange(mi.UInt32, min(AT_ONCE, count - first))
        k = lower_bound(cumulative, mi.UInt64((mi.Float64(ray) + jitter) * spacing) + 1)
        source = dr.gather(mi.UInt32, leaves, k)
        if pilot:
            # Numbered within their leaf, so that what happens elsewhere leaves the mesh here alone.
            start = mi.Float64(dr.gather(mi.UInt64, cumulative, k) - dr.gather(mi.UInt64, weight, k)) / spacing - jitter
            number, owner = ray - mi.UInt32(dr.maximum(dr.ceil(start), 0)), elements.key(leaves)
            x0, x1, d0, d1 = kronecker(number, owner, key ^ hash_pair(opaque_index(iteration), key), k)
        else:
            # Numbered through: rays of neighbouring leaves are well spread among each other.
            x0, x1, d0, d1 = kronecker(ray, opaque_index(iteration), key)
        j = dr.gather(mi.UInt32, elements.patch, source)
        uj, vj = elements.patch_point(source, *triangle(x0, x1))
        seated = dr.gather(mi.Bool, elements.divided, source) if seats else dr.full(mi.Bool, False, dr.width(ray))
        if seats:
            uj, vj = (dr.select(seated, at, x) for at, x in zip(seats.points(source, ray, seated), (uj, vj)))
        hit = model.trace(*model.leave(j, uj, vj, d0, d1))

        on_patch = hit.patch != NONE
        pair = pairs.find_roots(hit.patch, j, on_patch)
        known = pair != NONE
        pair = pairs.descend(pair, hit.u, hit.v, uj, vj, known)
        receiver = dr.select(known, dr.gather(mi.UInt32, pairs.receiver, pair, known), hit.patch)
        if not pilot:
            vetted = (
                known
                & (dr.gather(mi.Float, pairs.sigma, pair, known) >= 0)
                & ~dr.gather(mi.Bool, pairs.partial, pair, known)
            )
            vetted &= ~dr.gather(mi.Bool, elements.divided, receiver, known)
            receiver = elements.leaf_at(receiver, hit.u, hit.v, on_patch & ~vetted)
        bin = dr.select(on_patch, receiver, dr.select(hit.valid, opaque_index(n + 1), opaque_index(n)))
        # Rays that start inside a solid or under a face go nowhere; the others of their element carry their power.
        share = dr.gather(mi.Float, elements.open_area, source) / dr.gather(mi.Float, elements.area, source)
        share = dr.select(seated, 1, share)
        starts = ((share >= 1) | on_patch | ~hit.valid) & model.owns(j, uj, vj)
        each = spacing / (mi.Float64(dr.gather(mi.UInt64, weight, k)) * mi.Float64(share))
        sums.add([dr.gather(mi.Float64, p, k) * each for p in power], bin, starts)
        if pilot:
            taken = RayRecord(hit.patch, hit.u, hit.v, j, uj, vj, dr.select(known, pair, NONE))
            dr.eval(taken.i, taken.ui, taken.vi, taken.j, taken.uj, taken.vj, taken.pair)
        else:
            taken.take(receiver, hit.u, hit.v, ray, on_patch & dr.gather(mi.Bool, elements.divided, receiver, on_patch))
        progress(first + dr.width(ray))
    if not pilot:
        taken.settle()
    return sums, taken


class Seats:
    """Points where light came down on divided leaves, which send it on from there: SEATS per leaf, drawn at random."""

    def __init__(self, elements):
        self._least = dr.full(mi.UInt64, 0xFFFFFFFFFFFFFFFF, SEATS * elements)
        self._uv = [dr.full(mi.Float, dr.nan, SEATS * elements) for _ in range(2)]

    def take(self, leaf, u, v, ray, active):
        """Offer the patch points (u, v) where rays (UInt32 [n]) meet leaves."""
        dr.eval(leaf, u, v, active)  # lest the rays be traced again
        offer = dr.compress(active)
        if dr.width(offer) == 0:
            return
        # The least of well mixed numbers: any of them, but the same on any number of threads.
        ray = dr.gather(mi.UInt32, ray, offer)
        number = hash_pair(ray, 0)
        seat, lot = (
            SEATS * dr.gather(mi.UInt32, leaf, offer) + number % SEATS,
            (mi.UInt64(number) << 32) | mi.UInt64(ray),
        )
        dr.scatter_reduce(dr.ReduceOp.Min, self._least, lot, seat, mode=dr.ReduceMode.Direct)
        drawn = dr.gather(mi.UInt64, self._least, seat) == lot
        for points, x in zip(self._uv, (u, v)):
            dr.scatter(points, dr.gather(mi.Float, x, offer), seat, drawn)
        dr.eval(self._uv)

    def settle(self):
        """Share seats with those that were left empty, once all rays are cast."""
        k = dr.arange(mi.UInt32, dr.width(self._least))
        for step in (1, 2, 4):
            other = (k & ~mi.UInt32(SEATS - 1)) | ((k + step) & (SEATS - 1))
            self._uv = [dr.select(dr.isnan(x), dr.gather(mi.Float, x, other), x) for x in self._uv]
            dr.eval(self._uv)

    def points(self, leaf, number, active=True):
        """Patch points of leaves, another for every ``number`` (UInt32 [n]) below SEATS; NaN where no light came down."""
        return [dr.gather(mi.Float, x, SEATS * leaf + number % SEATS, active) for x in self._uv]


def _push(elements, sums, leaves, scale):
    """Irradiance of leaves: what they and their ancestors received per area (3 Float64 [leaves])."""
    received = _sum_ancestors(elements, sums, leaves)
    result = [h * dr.opaque(mi.Float64, s) for h, s in zip(received, scale)]
    dr.eval(result)
    return result


@dr.syntax
def _sum_ancestors(elements, sums, leaves):
    """Power over area, added up from the leaves to their roots (3 Float64 [leaves])."""
    element, n = mi.UInt32(leaves), dr.width(leaves)
    r, g, b = dr.zeros(mi.Float64, n), dr.zeros(mi.Float64, n), dr.zeros(mi.Float64, n)
    climbing = dr.full(mi.Bool, True, n)
    while climbing:
        area = mi.Float64(dr.gather(mi.Float, elements.open_area, element))
        x, y, z = sums.gather(element)
        r, g, b = r + x / area, g + y / area, b + z / area
        parent = dr.gather(mi.UInt32, elements.parent, element)
        climbing = parent != element
        element = parent
    return [r, g, b]


def pull(elements, leaves, area, irradiance):
    """Area averages of leaf irradiance for all elements (Color3f [elements])."""
    power = [h * area for h in irradiance]
    sums = ColorSums(len(elements), [2 * t for t in totals(power)])
    elements.add_to_ancestors(sums, leaves, power)
    every = dr.arange(mi.UInt32, len(elements))
    result = mi.Color3f(*(mi.Float(p / mi.Float64(elements.open_area)) for p in sums.gather(every)))
    dr.eval(result)
    return result
