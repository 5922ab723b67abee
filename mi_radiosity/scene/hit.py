"""Where rays end."""

from dataclasses import dataclass, fields

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE

STRAIGHT = 1 - 1e-6  # cosine of an angle that is none


@dataclass
class Hit:
    """Where rays end. ``patch`` is NONE on the sides of faces that take no part in light transport."""

    valid: "mi.Bool"  # [rays] something was hit
    patch: "mi.UInt32"  # [rays]
    u: "mi.Float"  # [rays] barycentric coordinates on the face
    v: "mi.Float"
    back: "mi.Bool"  # [rays] the side they meet is the back of its face
    traced: "mi.Bool"  # [rays] the surface has lobes that are not diffuse


@dataclass
class Trail:
    """Where rays end that went on through lobes; [rays], like a `Hit`, which it can stand for.

    ``patch`` is NONE for rays that escape (not ``valid``) or end without a diffuse lobe. ``traced`` says that rays met
    a surface with other lobes than a diffuse one. ``weight``: what is left of a ray at its end; where that surface has
    other lobes, too, times the weight of the diffuse lobe that was drawn, whether it reflects or transmits, over the
    mean ρ + τ of the side that the ray hits, so that the mean is right.
    ``taken``: power that the lobes on the way kept, less what they sent on from surfaces that count all of
    theirs as received; per power of the ray. ``glow``: E of the surfaces on the way that have other lobes, the one at
    the end included (it is ``coated``), and of lamps that lines from rough lobes have found, times the weight there,
    W/m². ``share``: of the lamp that the end is on, or of the sky, what those lines leave to the ray. ``rough``: the
    first lobe on the way is one that such lines look from.
    """

    valid: "mi.Bool"
    patch: "mi.UInt32"
    u: "mi.Float"
    v: "mi.Float"
    direction: "mi.Vector3f"  # at the end
    weight: "mi.Color3f"
    bounced: "mi.Bool"  # it went through a lobe
    traced: "mi.Bool"
    coated: "mi.Bool"
    taken: "mi.Color3f"
    glow: "mi.Color3f"
    share: "mi.Float"
    rough: "mi.Bool"

    @staticmethod
    def straight(hit: Hit, direction: "mi.Vector3f") -> "Trail":
        """Rays along directions that end where they `Hit` something."""
        n = dr.width(direction)
        no, nought, black = dr.zeros(mi.Bool, n), dr.zeros(mi.Float, n), dr.zeros(mi.Color3f, n)
        return Trail(
            valid=hit.valid,
            patch=hit.patch,
            u=hit.u,
            v=hit.v,
            direction=mi.Vector3f(direction),
            weight=black + 1,
            bounced=no,
            traced=no,
            coated=no,
            taken=black,
            glow=black,
            share=nought + 1,
            rough=no,
        )

    def straight_on(self, direction: "mi.Vector3f") -> "mi.Bool":
        """Have rays along directions kept them (Bool [rays])? Through masks and thin glass they do."""
        return dr.dot(self.direction, direction) > STRAIGHT * dr.norm(self.direction) * dr.norm(direction)

    def replaced(self, rows: "mi.UInt32", others: "Trail") -> "Trail":
        """These ends, but in some rows (UInt32) those of ``others``."""
        row = dr.full(mi.UInt32, NONE, dr.width(self.patch))
        dr.scatter(row, dr.arange(mi.UInt32, dr.width(rows)), rows)
        dr.eval(others)
        there = row != NONE
        gathered = (dr.gather(type(x), x, row, there) for x in (getattr(others, f.name) for f in fields(self)))
        return Trail(*gathered).where(there, self)

    def where(self, which: "mi.Bool", other: "Trail") -> "Trail":
        """These ends where ``which``, elsewhere the ``other`` ones."""
        return Trail(*(dr.select(which, getattr(self, f.name), getattr(other, f.name)) for f in fields(self)))
