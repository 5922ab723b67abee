"""Where power ends: exact sums per element, and what escapes or is blocked."""

import drjit as dr

from ..core.arrays import NONE, ColorSums, opaque_index


class Tally:
    """Power that arrived, W: a bin per element, and two more."""

    ESCAPED, BLOCKED = 0, 1  # left the scene; absorbed by a side that reflects nothing

    def __init__(self, elements, unshot):
        self._elements = elements
        self.sums = ColorSums(elements + 2, [4 * u for u in unshot])

    def add(self, power, hit, receiver, active=True):
        """Power (3 Float64 [rays]) of rays that end at hits, of which those on patches are for elements ``receiver``."""
        lost = dr.select(hit.valid, self._bin(self.BLOCKED), self._bin(self.ESCAPED))
        self.sums.add(power, dr.select(hit.patch != NONE, receiver, lost), active)

    def _bin(self, which):
        return opaque_index(self._elements + which)

    def gather(self, element):
        """What elements received (3 Float64 [n])."""
        return self.sums.gather(element)

    def lost(self, which) -> list[float]:
        """What went into a named bin, per channel."""
        return [c[0] for c in self.sums.gather(self._bin(which))]

    def totals(self) -> list[float]:
        """All of it, per channel."""
        return self.sums.totals()
