"""Where light came down on leaves that a wall crosses: it is sent on, and shown, from there."""

import drjit as dr
import mitsuba as mi
from numpy.typing import ArrayLike

from ..core.arrays import NONE, owned
from ..core.points import hash_pair
from ..mesh import Elements
from ..scene.rays import Rays

SEATS = 16  # points kept per leaf; a power of two


class Landings:
    """SEATS points of each of ``slots`` crossed leaves where rays met them, drawn at random (a reservoir).

    u, v: patch coordinates (Float [slots · SEATS]), NaN where no light came down.
    """

    def __init__(self, slots: int, u: "ArrayLike | None" = None, v: "ArrayLike | None" = None) -> None:
        self.slots = slots
        nowhere = dr.full(mi.Float, dr.nan, SEATS * slots)
        self.u, self.v = (mi.Float(nowhere) if x is None else owned(mi.Float, x) for x in (u, v))
        self._least = dr.full(mi.UInt64, 0xFFFFFFFFFFFFFFFF, SEATS * slots)

    def offer(
        self,
        slot: "mi.UInt32",
        u: "mi.Float",
        v: "mi.Float",
        number: "mi.UInt32",
        active: "mi.Bool",
        light: "mi.Float | float" = 1.0,
    ) -> None:
        """Rays of a ``number`` each (UInt32 [n]) bring so much ``light`` to the points (u, v) of crossed leaves."""
        if self.slots == 0:
            return
        light = mi.Float(light)
        dr.eval(slot, u, v, active, light)  # lest the rays be traced again
        offer = dr.compress(active)
        if dr.width(offer) == 0:
            return
        # The least of exponential numbers, drawn in proportion to light (Efraimidis and Spirakis 2006), and the same
        # on any number of threads.
        lot = hash_pair(dr.gather(mi.UInt32, number, offer), 0)
        seat = SEATS * dr.gather(mi.UInt32, slot, offer) + lot % SEATS
        light = dr.gather(mi.Float, light, offer) if dr.width(light) > 1 else light
        time = -dr.log((mi.Float(lot >> 8) + 1) * 2.0**-24) / dr.maximum(light, 1e-30)
        lot = (mi.UInt64(dr.reinterpret_array(mi.UInt32, time)) << 32) | mi.UInt64(dr.gather(mi.UInt32, number, offer))
        dr.scatter_reduce(dr.ReduceOp.Min, self._least, lot, seat, mode=dr.ReduceMode.Direct)
        drawn = dr.gather(mi.UInt64, self._least, seat) == lot
        for points, x in ((self.u, u), (self.v, v)):
            dr.scatter(points, dr.gather(mi.Float, x, offer), seat, drawn)
        dr.eval(self.u, self.v)

    def settled(self) -> "Landings":
        """These landings, seats that were left empty shared with those that were not."""
        if self.slots == 0:
            return self
        k = dr.arange(mi.UInt32, SEATS * self.slots)
        result, step = Landings(self.slots, self.u, self.v), 1
        while step < SEATS:
            other = (k & ~mi.UInt32(SEATS - 1)) | ((k + step) & (SEATS - 1))
            result.u, result.v = (
                dr.select(dr.isnan(x), dr.gather(mi.Float, x, other), x) for x in (result.u, result.v)
            )
            dr.eval(result.u, result.v)
            step *= 2
        return result

    def points(
        self, slot: "mi.UInt32", number: "mi.UInt32", active: "mi.Bool | bool" = True
    ) -> "tuple[mi.Float, mi.Float]":
        """Patch points of crossed leaves, another for every ``number`` (UInt32 [n]) below SEATS; NaN where no light
        came down (two Float [n])."""
        seat = SEATS * slot + number % SEATS
        return tuple(dr.gather(mi.Float, x, seat, active) for x in (self.u, self.v))

    def filled_by(self, others: "Landings") -> "Landings":
        """These landings, and ``others`` on leaves that have none."""
        if self.slots == 0:
            return self
        result = Landings(self.slots, self.u, self.v)
        result.u, result.v = (dr.select(dr.isnan(a), b, a) for a, b in ((self.u, others.u), (self.v, others.v)))
        dr.eval(result.u, result.v)
        return result

    def any_on(self, slot: "mi.UInt32", active: "mi.Bool | bool") -> "mi.Bool":
        """Did light come down on crossed leaves of these slots, NONE for other leaves (Bool [n])?"""
        if self.slots == 0:
            return mi.Bool(False)
        asked = active & (slot != NONE)
        return asked & ~dr.isnan(self.points(slot, mi.UInt32(0), asked)[0])

    def in_sight(
        self,
        elements: Elements,
        rays: Rays,
        leaf: "mi.UInt32",
        slot: "mi.UInt32",
        x: "mi.Point3f",
        active: "mi.Bool | bool",
    ) -> "mi.Bool":
        """Did light come down on crossed leaves, of these slots, in sight of points x of them (Bool [n])?"""
        patch = dr.gather(mi.UInt32, elements.patch, leaf, active)

        def look(found, k):
            u, v = self.points(slot, k, active)
            asked = active & ~found
            return found | (asked & ~rays.blocked(x, elements.patches.above(patch, u, v), asked)), k + 1

        found = mi.Bool(active & False)
        return dr.while_loop((found, mi.UInt32(0)), lambda found, k: active & ~found & (k < SEATS), look)[0]
