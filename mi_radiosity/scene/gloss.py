"""Rough lobes: which part of a BSDF they are, beside diffuse and smooth ones."""

import drjit as dr
import mitsuba as mi

CLEAR = 4.0  # times less is a rough lobe aside than a diffuse one, against its mirror direction, if it can be told
ASIDE = 0.985, 0.174  # sine and cosine of a direction away from the mirror direction


def is_glossy(bsdf: "mi.BSDFPtr") -> "mi.Bool":
    """Have BSDFs rough lobes (Bool [n])?"""
    return mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)


class Gloss:
    """Rough and diffuse lobes of BSDFs apart, by Mitsuba's own functions, which tell them by a mask.

    Where a BSDF has both, its density is p = a p_r + b p_d, that of each lobe by itself times how often it is drawn;
    both follow from two directions. They are 0, lobes are taken as they are drawn, and lamps are found by rays alone,
    for BSDFs that do not heed the mask (`principled`), and where rough lobes are as wide as diffuse ones.
    """

    def __init__(self, mode: "mi.TransportMode") -> None:
        self._every, self._rough, self._diffuse = (mi.BSDFContext(mode) for _ in range(3))
        self._rough.type_mask, self._diffuse.type_mask = mi.BSDFFlags.Glossy, mi.BSDFFlags.Diffuse

    def shares(
        self, bsdf: "mi.BSDFPtr", si: "mi.SurfaceInteraction3f", active: "mi.Bool"
    ) -> "tuple[mi.Float, mi.Float]":
        """a and b: how often rough lobes and diffuse ones are drawn; 1 and 0 where there are rough ones only (two Float
        [n])."""
        active = active & is_glossy(bsdf)
        mixed = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        mirror = mi.Vector3f(-si.wi.x, -si.wi.y, si.wi.z)
        aside = mi.Vector3f(dr.select(si.wi.x > 0, ASIDE[0], -ASIDE[0]), 0, dr.select(si.wi.z > 0, ASIDE[1], -ASIDE[1]))
        lobes = self._every, self._rough, self._diffuse
        p, r, d = (bsdf.pdf(ctx, si, mirror, mixed) for ctx in lobes)
        p1, r1, d1 = (bsdf.pdf(ctx, si, aside, mixed) for ctx in lobes)
        told = mixed & (r * d1 > CLEAR * r1 * d)
        scale = dr.select(told, 1 / (r * d1 - r1 * d), 0)
        a, b = ((x - y) * scale for x, y in ((p * d1, p1 * d), (r * p1, r1 * p)))
        told &= (a > 0) & (b > 0) & dr.isfinite(a + b)
        return dr.select(told, a, dr.select(active & ~mixed, 1, 0)), dr.select(told, b, 0)

    def weigh(
        self,
        bsdf: "mi.BSDFPtr",
        si: "mi.SurfaceInteraction3f",
        sample: "mi.BSDFSample3f",
        value: "mi.Color3f",
        shares: "tuple[mi.Float, mi.Float]",
    ) -> "mi.Color3f":
        """What samples of BSDFs are worth if lobes that can be told apart answer for themselves alone (Color3f [n])."""
        for ctx, share, flag in zip((self._rough, self._diffuse), shares, (mi.BSDFFlags.Glossy, mi.BSDFFlags.Diffuse)):
            drawn = (shares[1] > 0) & mi.has_flag(sample.sampled_type, flag)
            own, pdf = bsdf.eval_pdf(ctx, si, sample.wo, drawn)
            value = dr.select(drawn, dr.select(pdf > 0, own / (share * pdf), 0), value)
        return value

    def light(
        self,
        bsdf: "mi.BSDFPtr",
        si: "mi.SurfaceInteraction3f",
        wo: "mi.Vector3f",
        share: "mi.Float",
        active: "mi.Bool",
    ) -> "tuple[mi.Color3f, mi.Float]":
        """What rough lobes of a ``share`` send on of light from directions, and the density that they are drawn with,
        1/sr (Color3f, Float [n])."""
        value, pdf = bsdf.eval_pdf(self._rough, si, wo, active & (share > 0))
        density = share * pdf
        return value, dr.select(dr.isfinite(density), density, 0)
