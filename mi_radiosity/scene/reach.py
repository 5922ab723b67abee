"""Model only what a scene needs: which sides of faces exchange light with a lamp, directly or over others."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, components, owned
from ..core.points import ROUNDS, Stream, hash_pair, kronecker, stream_seed, triangle
from .lights import Lights
from .rays import Rays

GLANCES, PROBES = 2, 32  # rays per side that look for light: of all, and of those that found none
FEW = 1 << 14  # sides: so many look with all their rays at once
MOST_PROBES = 1 << 23  # rays of all sides together, where there are that many
LAMP_PROBES = 1 << 16  # rays from all lamps together


def reached(rays: Rays, lights: Lights) -> np.ndarray:
    """Which patches can light reach (bool [patches])?

    Every patch casts GLANCES rays and the lamps LAMP_PROBES; light spreads along them, in both
    directions, until nothing new is reached. What is still dark looks again, with PROBES rays. As rays hardly find
    lamps that are small or seen at a grazing angle, and those of lamps that are no surfaces hardly find small patches,
    every patch draws as many lines to lamps of either kind as well. A ray that leaves the scene sees the sky, if
    there is one.
    """
    patches = rays.patches
    emits = np.array(dr.max(patches.emission) > 0).astype(bool)
    lit = emits | _met_by_free(rays, lights)
    links = [_from_lamps(rays, np.flatnonzero(emits))] if emits.any() else []
    if patches.twin is not None:  # light on one side of a face that transmits is light on the other side
        links.append((np.arange(patches.count), patches.twin))
    dark = np.arange(patches.count)
    probes = max(4 * GLANCES, min(PROBES, MOST_PROBES // patches.count))
    glances = PROBES if patches.count <= FEW else GLANCES
    for first, last in ((0, glances), (glances, probes)):
        source, number = np.repeat(dark, last - first), np.tile(np.arange(first, last), len(dark))
        target, escaped = _cast(rays, source, number)
        links.append((source, target))
        if emits.any():
            links.append(_towards_lamps(rays, np.flatnonzero(emits), source, number))
        if lights.sky_light:
            lit[source[escaped]] = True
        lit[_see_free(rays, lights, source, number)] = True
        a, b = (np.concatenate(ends) for ends in zip(*links))
        label = components(patches.count, a[b != NONE], b[b != NONE])
        found = np.zeros(patches.count, dtype=bool)
        found[label[lit]] = True
        found = found[label]
        dark = np.flatnonzero(~found)
        if len(dark) == 0 or last >= probes:
            break
    return found


def _cast(rays, patch, number):
    """Patches that cosine-distributed rays from patches meet, NONE for none, and which of them leave the scene (int,
    bool [n])."""
    seed = dr.opaque(mi.UInt32, stream_seed(0, Stream.REACH))
    patch, number = owned(mi.UInt32, patch), owned(mi.UInt32, number)
    u, v, s, t = kronecker(number, patch, seed)
    origin, direction = rays.leave(patch, *triangle(u, v), s, t)
    hit = rays.trace(origin, direction)
    end, valid = hit.patch, hit.valid
    dr.eval(end, valid, origin, direction)
    # What has no diffuse lobe sends them on; of the others their light gets some.
    on = dr.compress(valid & (end == NONE)) if rays.lobes else mi.UInt32()
    if dr.width(on):
        start = dr.gather(mi.Point3f, origin, on), dr.gather(mi.Vector3f, direction, on)
        last = rays.follow(*start, dr.gather(mi.UInt32, hash_pair(patch, number), on), seed)
        dr.scatter(end, last.patch, on)
        dr.scatter(valid, last.valid, on)
    return np.array(end), ~np.array(valid).astype(bool)


def _from_lamps(rays, lamps):
    """Links of lamps to what their rays meet."""
    each = -(-LAMP_PROBES // len(lamps))
    source = np.repeat(lamps, each)
    return source, _cast(rays, source, np.tile(np.arange(each), len(lamps)))[0]


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


def _met_by_free(rays, lights):
    """Which patches are met by rays of lamps that are no surfaces (bool [patches])?"""
    lit = np.zeros(rays.patches.count, dtype=bool)
    for number, light in enumerate(lights.free):
        n, seed = dr.arange(mi.UInt32, LAMP_PROBES // len(lights.free)), dr.opaque(mi.UInt32, number)
        origin, direction, _ = light.shoot(*kronecker(n, seed, seed))
        met = np.array(rays.follow(origin, direction, n, seed).patch)
        lit[met[met != NONE]] = True
    return lit


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
