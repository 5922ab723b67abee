"""Model only what a scene needs: which sides of faces exchange light with a lamp, directly or over others."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, components, owned
from ..core.points import ROUNDS, Stream, hash_pair, kronecker, stream_seed, triangle

PROBES = 32  # rays per side that look for light
LAMP_PROBES = 1 << 16  # rays from all lamps together


def reached(rays, lights):
    """Which patches can light reach (bool [patches])?

    Every patch casts PROBES rays and the lamps LAMP_PROBES; light spreads along them, in both
    directions, until nothing new is reached. As rays hardly find lamps that are small or seen at
    a grazing angle, and those of lamps that are no surfaces hardly find small patches, every patch draws PROBES
    lines to lamps of either kind as well. A ray that leaves the scene sees the sky, if there is one.
    """
    patches = rays.patches
    emits = np.array(dr.max(patches.emission) > 0).astype(bool)
    source = np.repeat(np.arange(patches.count), PROBES)
    target, escaped = _cast(rays, source, np.tile(np.arange(PROBES), patches.count))
    links = [(source, target)]
    if emits.any():
        links += [_from_lamps(rays, np.flatnonzero(emits)), _towards_lamps(rays, np.flatnonzero(emits))]
    source, target = np.concatenate([a for a, _ in links]), np.concatenate([b for _, b in links])
    source, target = source[target != NONE], target[target != NONE]
    lit = emits | _see_free(rays, lights)
    if lights.sky_light:
        lit |= escaped.reshape(patches.count, PROBES).any(axis=1)
    label = components(patches.count, source, target)
    return np.isin(label, label[lit])


def _cast(rays, patch, number):
    """Patches that cosine-distributed rays from patches meet, NONE for none, and which of them leave the scene (int,
    bool [n])."""
    seed = dr.opaque(mi.UInt32, stream_seed(0, Stream.REACH))
    patch, number = owned(mi.UInt32, patch), owned(mi.UInt32, number)
    u, v, s, t = kronecker(number, patch, seed)
    hit = rays.follow(*rays.leave(patch, *triangle(u, v), s, t), hash_pair(patch, number), seed)
    dr.eval(hit.patch, hit.valid)
    return np.array(hit.patch), ~np.array(hit.valid).astype(bool)


def _from_lamps(rays, lamps):
    """Links of lamps to what their rays meet."""
    each = -(-LAMP_PROBES // len(lamps))
    source = np.repeat(lamps, each)
    return source, _cast(rays, source, np.tile(np.arange(each), len(lamps)))[0]


def _towards_lamps(rays, lamps):
    """Links of lamps to patches that see them, each more than rounding above the plane of the other."""
    p = rays.patches
    index = dr.arange(mi.UInt32, p.count * PROBES)
    patch, line = index // PROBES, index % PROBES
    lot = mi.sample_tea_32(index, 0, ROUNDS)[0] % dr.opaque(mi.UInt32, len(lamps))
    lamp = dr.gather(mi.UInt32, owned(mi.UInt32, lamps), lot)
    x0, x1, y0, y1 = kronecker(line, patch, dr.opaque(mi.UInt32, stream_seed(0, Stream.REACH, 1)))
    x, y = triangle(x0, x1), triangle(y0, y1)
    d = p.point(lamp, *y) - p.point(patch, *x)
    here, there = dr.gather(mi.Vector3f, p.normal, patch), dr.gather(mi.Vector3f, p.normal, lamp)
    above = (dr.dot(here, d) > p.lift) & (-dr.dot(there, d) > p.lift)
    sees = np.array(above & (rays.kernel(patch, *x, lamp, *y) > 0)).astype(bool)
    return np.array(lamp)[sees], np.array(patch)[sees]


def _see_free(rays, lights):
    """Which patches are met by rays of lamps that are no surfaces, or see one along lines to it (bool [patches])?"""
    p = rays.patches
    lit = np.zeros(p.count, dtype=bool)
    for number, light in enumerate(lights.free):
        n, seed = dr.arange(mi.UInt32, LAMP_PROBES // len(lights.free)), dr.opaque(mi.UInt32, number)
        origin, direction, _ = light.shoot(*kronecker(n, seed, seed))
        met = np.array(rays.follow(origin, direction, n, seed).patch)
        lit[met[met != NONE]] = True
        each = max(1, PROBES // len(lights.free))
        index = dr.arange(mi.UInt32, p.count * each)
        patch = index // each
        x0, x1, s, t = kronecker(index % each, patch, dr.opaque(mi.UInt32, stream_seed(0, Stream.REACH, 2 + number)))
        u, v = triangle(x0, x1)
        normal, on_top = dr.gather(mi.Vector3f, p.normal, patch), rays.on_top(patch, u, v)
        sees = dr.max(light.lights_up(rays, p.point(patch, u, v), normal, s, t, on_top)) > 0
        lit |= np.array(sees).astype(bool).reshape(p.count, each).any(axis=1)
    return lit
