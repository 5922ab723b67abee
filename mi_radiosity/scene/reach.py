"""Model only what a scene needs: which sides of faces exchange light with a lamp, directly or over others."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, components, opaque_index, owned
from ..core.points import ROUNDS, Stream, hash_pair, kronecker, stream_seed, triangle
from .light_paths import LightPaths
from .lights import Lights
from .passing import goes_on, pass_on
from .rays import Rays

GLANCES, PROBES = 2, 32  # rays per side that look for light: of all, and of those that found none
FEW = 1 << 14  # sides: so many look with all their rays at once
MOST_PROBES = 1 << 23  # rays of all sides together, where there are that many
MAX_SURFACES = 16  # through which a ray goes on


def reached(rays: Rays, lights: Lights, paths: LightPaths) -> np.ndarray:
    """Which patches can light reach (bool [patches])?

    ``paths`` are light paths from all emitters; what they hit is lit. Every patch casts GLANCES rays, which go on
    through surfaces that pass light on (see `_cast`). Light spreads along the rays, in both directions, until nothing
    new is reached. What is still dark casts PROBES rays. Rays hardly find emitters that are small or seen at a grazing
    angle, and light paths hardly find small patches, so every patch traces as many shadow rays to emitters as well.
    A ray that leaves the scene sees the sky, if there is one. A ray that hits a side without a patch that light paths
    have hit (see `scene.solids`) starts in a room with light, even if the walls of that room reflect none.
    """
    patches = rays.patches
    emits = np.array(dr.max(patches.emission) > 0).astype(bool)
    lit, links = emits | paths.lit, []
    if patches.twin is not None:  # light on one side of a face that transmits is light on the other side
        links.append((np.arange(patches.count), patches.twin))
    dark = np.arange(patches.count)
    probes = max(4 * GLANCES, min(PROBES, MOST_PROBES // patches.count))
    glances = PROBES if patches.count <= FEW else GLANCES
    for first, last in ((0, glances), (glances, probes)):
        source, number = np.repeat(dark, last - first), np.tile(np.arange(first, last), len(dark))
        joined, escaped, in_room = _cast(rays, source, number)
        links += joined
        lit[in_room] = True
        if emits.any():
            links.append(_towards_lamps(rays, np.flatnonzero(emits), source, number))
        if lights.sky_light:
            lit[escaped] = True
        lit[_see_free(rays, lights, source, number)] = True
        a, b = (np.concatenate(ends) for ends in zip(*links))
        label = components(patches.count, a, b)
        found = np.zeros(patches.count, dtype=bool)
        found[label[lit]] = True
        found = found[label]
        dark = np.flatnonzero(~found)
        if len(dark) == 0 or last >= probes:
            break
    return found


def _cast(rays, patch, number):
    """Links between patches that one cosine-distributed ray per entry finds (list of pairs of int arrays), the patches
    from which rays leave the scene, and those from which they hit the walls of rooms (int).

    A ray ends at the first surface with nothing but diffuse reflection. It goes on through up to MAX_SURFACES others,
    by one sampled lobe each, but through one patch only, because that patch and the next one cast rays of their own.
    So there are at most MAX_SURFACES + 1 segments per ray.
    """
    seed = opaque_index(stream_seed(0, Stream.REACH))
    patch, number = owned(mi.UInt32, patch), owned(mi.UInt32, number)
    u, v, s, t = kronecker(number, patch, seed)
    origin, direction = rays.leave(patch, *triangle(u, v), s, t)
    links, escaped, in_room, start = [], [], [], patch
    for depth in range(MAX_SURFACES + 1):
        if dr.width(patch) == 0:
            break
        side, _, _ = rays.side_met(origin, direction)
        hit = rays.patch_of(side, side != NONE)
        dr.eval(side, hit, origin, direction)
        linked = np.array(hit) != NONE
        links.append((np.array(patch)[linked], np.array(hit)[linked]))
        escaped.append(np.array(patch)[np.array(side) == NONE])
        in_room.append(np.array(patch)[np.array(rays.is_wall_of_room(side)).astype(bool)])
        if rays.lobes is None:
            break
        on = dr.compress(goes_on(rays, side) & ((hit == NONE) | (patch == start)))
        if dr.width(on) == 0:
            break
        origin, direction = dr.gather(mi.Point3f, origin, on), dr.gather(mi.Vector3f, direction, on)
        start, patch, hit, number = (dr.gather(mi.UInt32, x, on) for x in (start, patch, hit, number))
        w, x, s, t = kronecker(opaque_index(depth), hash_pair(patch, number), seed)
        patch = dr.select(hit != NONE, hit, patch)
        origin, direction, carries = pass_on(rays, origin, direction, w, x, s, t)
        on = dr.compress(carries)
        origin, direction = dr.gather(mi.Point3f, origin, on), dr.gather(mi.Vector3f, direction, on)
        start, patch, number = (dr.gather(mi.UInt32, x, on) for x in (start, patch, number))
    return links, np.concatenate(escaped), np.concatenate(in_room)


def _towards_lamps(rays, lamps, patch, number):
    """Links of lamps to patches that see them, each more than rounding above the plane of the other."""
    p, patch, line = rays.patches, owned(mi.UInt32, patch), owned(mi.UInt32, number)
    lot = mi.sample_tea_32(patch, line, ROUNDS)[0] % dr.opaque(mi.UInt32, len(lamps))
    lamp = dr.gather(mi.UInt32, owned(mi.UInt32, lamps), lot)
    x0, x1, y0, y1 = kronecker(line, patch, dr.opaque(mi.UInt32, stream_seed(0, Stream.REACH, 1)))
    x, y = triangle(x0, x1), triangle(y0, y1)
    d = p.point(lamp, *y) - p.point(patch, *x)
    here, there = dr.gather(mi.Vector3f, p.normal, patch), dr.gather(mi.Vector3f, p.normal, lamp)
    above = (dr.dot(here, d) > p.lift) & (-dr.dot(there, d) > p.lift)
    sees = np.array(above & (rays.kernel(patch, *x, lamp, *y) > 0)).astype(bool)
    return np.array(lamp)[sees], np.array(patch)[sees]


def _see_free(rays, lights, source, number):
    """Those of the patches ``source`` that see a lamp that is no surface along a line to it (int)."""
    p, found = rays.patches, [np.zeros(0, dtype=np.int64)]
    patch, line = owned(mi.UInt32, source), owned(mi.UInt32, number)
    for k, light in enumerate(lights.free):
        x0, x1, s, t = kronecker(line, patch, dr.opaque(mi.UInt32, stream_seed(0, Stream.REACH, 2 + k)))
        u, v = triangle(x0, x1)
        normal, on_top = dr.gather(mi.Vector3f, p.normal, patch), rays.on_top(patch, u, v)
        sees = dr.max(light.lights_up(rays, p.point(patch, u, v), normal, s, t, on_top)[1]) > 0
        found.append(source[np.array(sees).astype(bool)])
    return np.concatenate(found)
