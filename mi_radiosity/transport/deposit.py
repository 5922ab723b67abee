"""Who receives the power of a ray: the pair tree, or the leaf the ray meets."""

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE
from ..scene.hit import Hit
from .emit import Batch
from .problem import Problem


def pair_of(problem: Problem, batch: Batch, hit: Hit) -> "mi.UInt32":
    """The pair without children that each ray belongs to (UInt32 [rays]).

    NONE before its root exists, and for rays that belong to no pair: those of lamps that are no surface, and those
    that went on through a lobe.
    """
    on_patch = straight(batch, hit)
    pair = problem.pairs.find_roots(hit.patch, batch.patch, on_patch)
    return problem.pairs.descend(pair, hit.patch, hit.u, hit.v, batch.patch, batch.u, batch.v, pair != NONE)


def straight(batch: Batch, hit: Hit) -> "mi.Bool":
    """Did rays go straight from a patch to a patch (Bool [rays])?"""
    on_patch = (hit.patch != NONE) & (batch.patch != NONE)
    return on_patch & ~hit.bounced


def spread(problem: Problem, hit: Hit, pair: "mi.UInt32") -> "mi.UInt32":
    """Over the receiver of the pair, or all of the patch, which shares with its cluster: smooth, for pilots
    (UInt32 [rays])."""
    known, crown = pair != NONE, problem.elements.crown
    receiver = dr.gather(mi.UInt32, problem.pairs.receiver, pair, known)
    if crown:
        known &= ~crown.holds(receiver)
    return dr.select(known, receiver, hit.patch)


def trusted(problem: Problem, hit: Hit, pair: "mi.UInt32") -> "mi.UInt32":
    """Over the receiver of a pair the oracle has seen in full view, else to the leaf the ray meets (UInt32 [rays]).

    Spreading it over a receiver that something hides a part of, or that a wall crosses, would let light through.
    """
    pairs, known = problem.pairs, pair != NONE
    receiver = spread(problem, hit, pair)
    in_view = dr.gather(mi.Bool, pairs.asked, pair, known) & ~dr.gather(mi.Bool, pairs.occluded, pair, known)
    spreads = known & in_view & ~dr.gather(mi.Bool, problem.exposure.crossed, receiver, known)
    return problem.elements.leaf_below(receiver, hit.u, hit.v, (hit.patch != NONE) & ~spreads)
