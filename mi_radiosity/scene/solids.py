"""Which sides without a patch are the inside of a solid, and which are walls of a room.

The back of a one-sided face exchanges no light. A closed mesh with outward normals is a solid if it is empty, and a
room if emitters, or all that the scene consists of, are inside. Geometry alone does not tell. Light does: light paths
from the emitters reach the inside of a room, and never that of a solid. In scenes that need no emitter, the points of
patches do: those that see other patches, or the sky, are not inside of a solid.
"""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import NONE, opaque_index, owned
from ..core.points import Stream, kronecker, stream_seed, triangle
from .faces import Faces
from .light_paths import leave, sure_to_end
from .overlap import surfaces
from .rays import Rays

MIN_HITS = 2  # of a smooth surface: a single hit may be a ray that slipped into a solid between two faces
SMOOTH = 0.7  # cosine between normals of neighbouring faces up to which they are one smooth surface
CONNECTED = -2.0  # cosine that all neighbouring faces have
POINTS, MAX_POINTS = 1 << 16, 64  # of all patches together, if each has one at least; of a patch
RAYS_PER_POINT = 16
OPEN = 15 / 16  # of the openness of the most open point of a connected mesh, from which a point is sure to be in a room
ROUNDS = 32  # in which rooms spread


def seen_by_light(faces: Faces, hits: np.ndarray) -> np.ndarray:
    """Sides that rays hit at least MIN_HITS times, together with the rest of their smooth surface, because rays do
    not hit all faces of a fine mesh (bool [2 · faces]).

    hits: of sides 2 · face + (1 for the back), see `LightPaths`.
    """
    if not hits.any():
        return np.zeros(len(hits), dtype=bool)
    return _enough(hits, _label(faces, SMOOTH))


def seen_from_patches(faces: Faces, rays: Rays) -> np.ndarray:
    """Sides that are seen from points of patches that are sure to be in a room, without any emitter (bool [2 · faces]).

    Points all over the patches cast rays. How open a point is, is the share of its rays that escape, or hit a patch or
    a wall of a room. A point is sure to be in a room if it is nearly as open as the most open one of its connected
    mesh: the rest of the mesh may be inside of a solid, but not all of it. What points in a room see are walls of the
    room, so that more points are in it, until nothing new is found.
    """
    dead = rays.sides_without_patch
    room = np.zeros(len(dead), dtype=bool)
    if not dead.any():
        return room
    side, label = _views(faces, rays)
    hit = side < len(dead)
    hit[hit] = dead[side[hit]]
    if not hit.any():
        return room
    smooth, hits = _label(faces, SMOOTH), np.zeros(len(dead), dtype=np.int64)
    target = np.where(hit, side, 0)
    for _ in range(ROUNDS):
        openness = (~hit | room[target]).mean(axis=1)
        most = np.zeros(label.max() + 1)
        np.maximum.at(most, label, openness)
        sources = openness >= OPEN * most[label]
        hits[:] = np.bincount(target[sources][hit[sources]], minlength=len(dead))
        found = room | _enough(hits, smooth)
        if (found == room).all():
            break
        room = found
    return room & dead


def _label(faces, min_cosine):
    """A number for the surface of every side, from those of its face (int [2 · faces])."""
    surface = surfaces(faces.vertex, faces.normal, min_cosine)
    return np.column_stack([2 * surface, 2 * surface + 1]).ravel()


def _enough(hits, label):
    """Sides of surfaces that were hit often enough (bool [2 · faces])."""
    return (np.bincount(label, weights=hits) >= MIN_HITS)[label]


def _views(faces, rays):
    """The sides that rays from points of patches hit, NONE for those that escape or are not sure to end where they do
    (int [points, RAYS_PER_POINT]), and the connected mesh of every point (int [points])."""
    patches = rays.patches
    points = max(1, min(MAX_POINTS, POINTS // patches.count))
    point = dr.arange(mi.UInt32, patches.count * points)
    patch, key = point // opaque_index(points), owned(mi.UInt32, patches.sides)
    x, y, _, _ = kronecker(point % opaque_index(points), key, opaque_index(stream_seed(0, Stream.REACH, 2)), patch)
    u, v = triangle(x, y)
    nought = dr.zeros(mi.Float, dr.width(u))
    _, _, free = leave(rays, patch, u, v, nought, nought)
    open_points = dr.compress(free)
    patch, u, v = (dr.gather(type(a), a, open_points) for a in (patch, u, v))
    dr.eval(patch, u, v)
    each = opaque_index(RAYS_PER_POINT)
    ray = dr.arange(mi.UInt32, dr.width(patch) * RAYS_PER_POINT)
    of, key = ray // each, dr.gather(mi.UInt32, open_points, ray // each)
    _, _, s, t = kronecker(ray % each, key, opaque_index(stream_seed(0, Stream.REACH, 3)))
    start = (dr.gather(type(a), a, of) for a in (patch, u, v))
    origin, direction = rays.leave(*start, s, t)
    side, _, _ = rays.side_met(origin, direction)
    side = dr.select(sure_to_end(rays, origin, direction, ray), side, NONE)
    number = np.array(patch)
    label = _label(faces, CONNECTED)
    own = 2 * np.array(patches.face)[number].astype(np.int64) + np.array(patches.back)[number]
    return np.array(side, dtype=np.int64).reshape(-1, RAYS_PER_POINT), label[own]
