"""Rays that go on through surfaces: lobes that are not diffuse pass light on, in front of a patch as well."""

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE
from .rays import Rays

BELOW_ONE = 1 - 2.0**-24


def goes_on(rays: Rays, side: "mi.UInt32") -> "mi.Bool":
    """Does light go on from the sides that rays hit (UInt32 [n], NONE allowed) to places that the side's own diffuse
    light does not reach (Bool [n])?

    From surfaces without a patch it does so through any lobe. A patch sends diffuse light to all of its own side, so
    only transmission adds something there.
    """
    hit = side != NONE
    return rays.is_traced_side(side, hit) & ((rays.patch_of(side, hit) == NONE) | rays.is_transmitting(side, hit))


def pass_on(
    rays: Rays,
    origin: "mi.Point3f",
    direction: "mi.Vector3f",
    w: "mi.Float",
    x: "mi.Float",
    s: "mi.Float",
    t: "mi.Float",
) -> "tuple[mi.Point3f, mi.Vector3f, mi.Bool]":
    """Rays that a sampled lobe of the surface that each ray hits sends on, and which of them carry light (Point3f,
    Vector3f, Bool [n]).

    w, x, s, t: uniform numbers. x selects the lobe. In a half of the samples the first or the last lobe is selected
    instead, because a lobe of a small weight, such as that of a mask of opacity 0.99, lights what lies behind it, too.
    """
    ray = mi.Ray3f(origin, direction)
    si = rays.meet(origin, direction).compute_surface_interaction(ray, mi.RayFlags.All)
    lobe = dr.select(w < 0.25, 0, dr.select(w < 0.5, BELOW_ONE, x))
    sample, value = si.bsdf(ray).sample(mi.BSDFContext(), si, lobe, mi.Point2f(s, t), si.is_valid())
    carries = si.is_valid() & dr.all(dr.isfinite(value)) & (dr.max(value) > 0)
    on = si.spawn_ray(si.to_world(sample.wo))
    return on.o, on.d, carries
