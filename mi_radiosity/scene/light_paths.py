"""Light paths from all emitters: which patches they light, and which sides without a patch they hit."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, concat, opaque_index, owned
from ..core.points import Stream, hash_pair, kronecker, stream_seed, triangle, uniform
from .lights import Lights
from .passing import goes_on, pass_on
from .rays import Rays

PATHS = 1 << 16  # from all area emitters together, and from all others; every emitting patch has one at least
SEGMENTS = 1 << 20  # of all paths together; every path has MIN_SEGMENTS at least
MAX_SEGMENTS, MIN_SEGMENTS = 8, 2  # of a path
GO_ON = 4  # one in so many paths has more than one segment: first segments find patches, later ones rooms
INSET = 2.0**-6  # of the way to the middle of a patch, from where a neighbour hides no point that lies before it
NUDGE = 2.0**-16  # by which the direction of a neighbouring ray differs


@dataclass(frozen=True)
class LightPaths:
    """What light paths have hit. ``lit``: patches (bool [patches]); ``hits``: how often each side 2 · face + (1 for the
    back) was hit that has no patch and is not traced (int [2 · faces])."""

    lit: np.ndarray
    hits: np.ndarray


@dataclass
class _Paths:
    """The next segments of paths, [n]. ``key``: a number that draws the rest of a path."""

    origin: "mi.Point3f"
    direction: "mi.Vector3f"
    key: "mi.UInt32"

    def only(self, rows: "mi.UInt32") -> "_Paths":
        """Some of the paths (UInt32 [m])."""
        return _Paths(
            dr.gather(mi.Point3f, self.origin, rows),
            dr.gather(mi.Vector3f, self.direction, rows),
            dr.gather(mi.UInt32, self.key, rows),
        )


def light_paths(rays: Rays, lights: Lights) -> LightPaths:
    """Trace light paths from all emitters.

    PATHS paths leave the area emitters and as many the other emitters, of up to MAX_SEGMENTS segments each, and about
    SEGMENTS in all. A path goes on from every patch that it hits in a cosine-distributed direction, whatever the
    reflectance, or through one of the other lobes of the surface. Numbers do not depend on how patches are numbered.
    """
    lit = dr.zeros(mi.UInt32, rays.patches.count)
    hits = dr.zeros(mi.UInt32, rays.side_count)
    starts = _from_patches(rays) + _from_free(lights)
    count = sum(dr.width(start.key) for start in starts)
    if count:
        paths = _Paths(*(concat(*parts) for parts in zip(*((p.origin, p.direction, p.key) for p in starts))))
        segments = max(MIN_SEGMENTS, min(MAX_SEGMENTS, SEGMENTS // count))
        for number in range(segments):
            if dr.width(paths.key) == 0:
                break
            paths = _segment(rays, paths, number, lit, hits, number + 1 == segments)
            some = dr.width(paths.key) // GO_ON
            if number == 0 and some:
                paths = paths.only(GO_ON * dr.arange(mi.UInt32, some))
    return LightPaths(np.array(lit) > 0, np.array(hits, dtype=np.int64))


def _from_patches(rays):
    """The first segments of paths from area emitters (list of _Paths)."""
    emitting = np.flatnonzero(np.array(dr.max(rays.patches.emission) > 0))
    if len(emitting) == 0:
        return []
    each = opaque_index(-(-PATHS // len(emitting)))
    number = dr.arange(mi.UInt32, len(emitting) * (-(-PATHS // len(emitting))))
    patch = dr.gather(mi.UInt32, owned(mi.UInt32, emitting), number // each)
    side = dr.gather(mi.UInt32, owned(mi.UInt32, rays.patches.sides[emitting]), number // each)
    seed = opaque_index(stream_seed(0, Stream.REACH, 0))
    x, y, s, t = kronecker(number % each, side, seed)
    origin, direction, free = leave(rays, patch, *triangle(x, y), s, t)
    return [_Paths(origin, direction, hash_pair(side, number % each)).only(dr.compress(free))]


def _from_free(lights):
    """The first segments of paths from all other emitters (list of _Paths)."""
    paths = []
    for k, light in enumerate(lights.free):
        number, seed = dr.arange(mi.UInt32, max(1, PATHS // len(lights.free))), opaque_index(k)
        origin, direction, _ = light.shoot(*kronecker(number, seed, seed))
        every = dr.zeros(mi.Vector3f, dr.width(number))  # a directional emitter has one direction for all rays
        key = hash_pair(number, ~seed)
        paths.append(_Paths(mi.Point3f(origin + every), mi.Vector3f(direction + every), key))
    return paths


def leave(
    rays: Rays, patch: "mi.UInt32", u: "mi.Float", v: "mi.Float", s: "mi.Float", t: "mi.Float"
) -> "tuple[mi.Point3f, mi.Vector3f, mi.Bool]":
    """Origin and direction of cosine-distributed rays from points of patches, and which of the points are free: nothing
    lies on them, and, lifted off their patch, they are not behind a neighbour of it (Point3f, Vector3f, Bool [n])."""
    origin, direction = rays.leave(patch, u, v, s, t)
    above = rays.patches.above(patch, u, v)
    inwards = rays.patches.above(patch, u + INSET * (1 / 3 - u), v + INSET * (1 / 3 - v))
    return origin, direction, rays.on_top(patch, u, v) & ~rays.blocked(inwards, above)


def sure_to_end(rays: Rays, origin: "mi.Point3f", direction: "mi.Vector3f", key: "mi.UInt32") -> "mi.Bool":
    """Does a neighbour of each ray hit a side that has no patch and is not traced (Bool [n])? Between two faces a ray
    may slip through, its neighbour does not. key: draws the neighbour (UInt32 [n])."""
    jitter = mi.Vector3f(*(uniform(key, opaque_index(k)) for k in range(3))) - 0.5
    side, _, _ = rays.side_met(origin, dr.normalize(direction + NUDGE * jitter))
    return (side != NONE) & (rays.patch_of(side, side != NONE) == NONE) & ~rays.is_traced_side(side, side != NONE)


def _segment(rays, paths, number, lit, hits, last):
    """Trace a segment of paths, enter what it hits, and return the next segments."""
    side, u, v = rays.side_met(paths.origin, paths.direction)
    patch, traced = rays.patch_of(side, side != NONE), rays.is_traced_side(side, side != NONE)
    on_patch = patch != NONE
    dr.scatter(lit, mi.UInt32(1), patch, on_patch)
    dead = (side != NONE) & ~on_patch & ~traced
    dr.eval(side, u, v, patch, traced, dead, lit)
    rows = dr.compress(dead)
    if dr.width(rows):
        ended = paths.only(rows)
        sure = sure_to_end(rays, ended.origin, ended.direction, ended.key)
        dr.scatter_add(hits, mi.UInt32(1), dr.gather(mi.UInt32, side, rows), sure)
    on = dr.compress(on_patch | traced)
    if last or dr.width(on) == 0:
        return paths.only(mi.UInt32())
    side, u, v, patch = (dr.gather(type(x), x, on) for x in (side, u, v, patch))
    return _next(rays, paths.only(on), number, side, u, v, patch)


def _next(rays, paths, number, side, u, v, patch):
    """The next segments of paths that hit a point (u, v) of a patch, or a traced side without one."""
    w, x, s, t = kronecker(opaque_index(number), paths.key, opaque_index(stream_seed(0, Stream.REACH, 1)))
    on_patch = patch != NONE
    if rays.lobes is None:
        origin, direction, free = leave(rays, patch, u, v, s, t)
        return _Paths(origin, direction, paths.key).only(dr.compress(free))
    *bounced, free = leave(rays, dr.select(on_patch, patch, 0), u, v, s, t)
    # Half of the paths that hit a patch through which light goes on do so themselves.
    through = goes_on(rays, side) & ~(on_patch & (uniform(paths.key, opaque_index(number)) < 0.5))
    origin, direction, carries = pass_on(rays, paths.origin, paths.direction, w, x, s, t)
    origin, direction = (dr.select(through, a, b) for a, b in zip((origin, direction), bounced))
    return _Paths(origin, direction, paths.key).only(dr.compress(dr.select(through, carries, on_patch & free)))
