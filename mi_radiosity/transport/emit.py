"""Rays that carry power away: from leaves, and from lamps that are no surfaces."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, Distribution, opaque_index
from ..core.points import hash_pair, kronecker, triangle, uniform
from ..scene import Light
from .landings import Landings
from .problem import Problem

AT_ONCE = 1 << 23  # rays cast in one launch: bounds memory, and the time until an interrupt is heard


@dataclass
class Batch:
    """Rays about to be cast."""

    origin: "mi.Point3f"  # [rays]
    direction: "mi.Vector3f"
    power: list  # W, three Float64 [rays]
    number: "mi.UInt32"  # no two rays of an iteration have the same
    patch: "mi.UInt32"  # they leave from (u, v) of it; NONE for lamps that are no surface
    u: "mi.Float"
    v: "mi.Float"
    doubtful: "mi.Bool"  # might start inside a solid, then goes nowhere
    starts: "mi.Bool"  # False for rays that start under another face
    sharp: "mi.Bool"  # what lobes focus of them is found by no ray that looks for light


def launches(count: int, at_once: int = AT_ONCE) -> "Iterator[mi.UInt32]":
    """Numbers of ``count`` rays, so many at a time (UInt32 each)."""
    for first in range(0, count, at_once):
        yield opaque_index(first) + dr.arange(mi.UInt32, min(at_once, count - first))


def numbered_through(ray: "mi.UInt32", at: "_At", leaves: "LeafEmitter") -> "tuple[mi.Float, ...]":
    """Points of rays numbered through: rays of neighbouring leaves are well spread among each other."""
    return kronecker(ray, at.iteration, at.seed)


def numbered_by_leaf(ray: "mi.UInt32", at: "_At", leaves: "LeafEmitter") -> "tuple[mi.Float, ...]":
    """Points of rays numbered within their leaf, so that what happens elsewhere leaves the rays here alone."""
    start = at.distribution.start(at.row) / at.spacing - at.jitter
    number = ray - mi.UInt32(dr.maximum(dr.ceil(start), 0))
    return kronecker(number, leaves.elements.key(leaves.leaves), at.seed ^ hash_pair(at.iteration, at.seed), at.row)


@dataclass
class _At:
    """What numbering needs to know of a launch."""

    iteration: "mi.UInt32"
    seed: "mi.UInt32"
    distribution: Distribution
    spacing: "mi.Float64"
    jitter: "mi.Float"
    row: "mi.UInt32"


class LeafEmitter:
    """Sends power (3 Float64 [leaves], W) from the leaves of a mesh, rays in proportion to it: systematic over the
    leaves, cosine-distributed, low-discrepancy in position and direction.

    numbering: `numbered_through` or `numbered_by_leaf`. landings: where light came down on crossed leaves, which send
    it on from there; None for light of their own.
    """

    def __init__(
        self,
        problem: Problem,
        power: "Sequence[mi.Float64]",
        total: float,
        numbering: Callable,
        landings: Landings | None = None,
    ) -> None:
        self.elements, self.leaves = problem.elements, problem.elements.leaves
        self._rays, self._exposure, self._landings = problem.model.rays, problem.exposure, landings
        self._power, self._numbering = power, numbering
        weight = power[0] + power[1] + power[2]
        self._distribution = Distribution(weight, total)

    def batches(self, count: int, iteration: int, seed: int) -> Iterator[Batch]:
        """``count`` rays as Batches."""
        seed, iteration = opaque_index(seed), opaque_index(iteration)
        jitter = uniform(iteration, seed ^ 0x5EED)
        dr.eval(jitter)
        spacing = dr.opaque(mi.Float64, self._distribution.whole / count)
        for ray in launches(count):
            row = self._distribution.at((mi.Float64(ray) + jitter) * spacing)
            yield self._batch(ray, _At(iteration, seed, self._distribution, spacing, jitter, row))

    def _batch(self, ray, at):
        x0, x1, s, t = self._numbering(ray, at, self)
        leaf = dr.gather(mi.UInt32, self.leaves, at.row)
        patch = dr.gather(mi.UInt32, self.elements.patch, leaf)
        u, v = self.elements.patch_point(leaf, *triangle(x0, x1))
        share = self._exposure.open_share(self.elements, leaf)
        if self._landings is not None and self._landings.slots:
            slot = dr.gather(mi.UInt32, self._exposure.slot, leaf)
            landed = self._landings.any_on(slot, slot != NONE)
            u, v = (dr.select(landed, a, b) for a, b in zip(self._landings.points(slot, ray, landed), (u, v)))
            share = dr.select(landed, 1, share)
        weight = mi.Float64(dr.gather(mi.UInt64, self._distribution.weight, at.row))
        each = at.spacing / (weight * mi.Float64(share))
        power = [dr.gather(mi.Float64, p, at.row) * each for p in self._power]
        origin, direction = self._rays.leave(patch, u, v, s, t)
        on_top = self._rays.on_top(patch, u, v)
        return Batch(origin, direction, power, ray, patch, u, v, share < 1, on_top, mi.Bool(False))


class LampEmitter:
    """Sends the power of a lamp that is no surface."""

    def __init__(self, light: Light) -> None:
        self._light = light

    def batches(self, count: int, iteration: int, seed: int) -> Iterator[Batch]:
        """``count`` rays as Batches."""
        for ray in launches(count):
            origin, direction, power = self._light.shoot(*kronecker(ray, opaque_index(iteration), opaque_index(seed)))
            n = dr.width(ray)
            power = [mi.Float64(p) / dr.opaque(mi.Float64, count) + dr.zeros(mi.Float64, n) for p in power]
            nowhere, at = dr.full(mi.UInt32, NONE, n), dr.zeros(mi.Float, n)
            yes = dr.full(mi.Bool, True, n)
            yield Batch(origin, direction, power, ray, nowhere, at, at, ~yes, yes, self._light.is_sharp(-direction))
