"""Where power ends: exact sums per element, and what escapes or is blocked."""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from ..core.arrays import NONE, ColorSums, opaque_index
from ..scene.hit import Hit
from .emit import Batch


class Tally:
    """Power that arrived, W: a bin per element, and a few more."""

    ESCAPED, BLOCKED = 0, 1  # left the scene; absorbed by a side that reflects nothing
    SENT, TAKEN = 2, 3  # of rays that go on through lobes: what was sent, and what the lobes on the way kept

    def __init__(self, elements: int, unshot: Sequence[float], lobes: bool = False) -> None:
        self._elements, self._lobes = elements, lobes
        self.sums = ColorSums(elements + (4 if lobes else 2), [8 * u for u in unshot])

    def add(self, batch: Batch, hit: Hit, receiver: "mi.UInt32", active: "mi.Bool | bool" = True) -> None:
        """Rays of a Batch end at hits; those on patches are for elements ``receiver``."""
        lost = dr.select(hit.valid, self._bin(self.BLOCKED), self._bin(self.ESCAPED))
        power = batch.power
        if self._lobes:
            every = dr.zeros(mi.UInt32, dr.width(receiver))
            taken = [p * mi.Float64(t) for p, t in zip(power, hit.taken)]
            self.sums.add(power, every + self._bin(self.SENT), active, runs=True)
            self.sums.add(taken, every + self._bin(self.TAKEN), active, runs=True)
            power = [p * mi.Float64(w) for p, w in zip(power, hit.weight)]
        self.sums.add(power, dr.select(hit.patch != NONE, receiver, lost), active)

    def _bin(self, which):
        return opaque_index(self._elements + which)

    def gather(self, index: "mi.UInt32") -> "list[mi.Float64]":
        """What elements received (3 Float64 [n])."""
        return self.sums.gather(index)

    def lost(self, which: int) -> list[float]:
        """What went into a named bin, per channel."""
        if which > self.BLOCKED and not self._lobes:
            return [0.0] * 3
        return [c[0] for c in self.sums.gather(self._bin(which))]

    def sent(self) -> list[float]:
        """All power of the rays, per channel."""
        return self.lost(self.SENT) if self._lobes else self.sums.totals()
