"""Light that leaves elements diffusely: what their own side reflects, and what the other side transmits."""

from collections.abc import Sequence
from typing import TypeVar

import drjit as dr
import mitsuba as mi

from .elements import MAX_LEVEL, Elements
from .exposure import Exposure
from .hierarchy import pull

Values = TypeVar("Values", bound=Sequence)


class Scattering:
    """Radiosity without emission: ρ_a H_a + τ_b H_b, for an element of side a of a face whose other side is b.

    H: irradiance, W/m². ρ_a: diffuse reflectance of side a. τ_b: the share of the irradiance of side b that leaves
    diffusely from side a. The two sides are separate trees over the same coordinates (u, v). H_b is therefore the area
    average over the element of side b at the same place, or over its deepest ancestor that exists. Where more of side
    a is open than of side b, only light of the open part of side b leaves, so that no power is created.

    Without faces that transmit diffusely, this is ρ H.
    """

    def __init__(self, elements: Elements, exposure: Exposure) -> None:
        self._elements, self._area = elements, exposure.open_area
        if not self.transmits:
            return
        self._behind, self._tau = _behind(elements)
        every = dr.arange(mi.UInt32, len(elements))
        here, there = exposure.open_share(elements, every), exposure.open_share(elements, self._behind)
        self._tau *= dr.minimum(there / here, 1)
        dr.eval(self._behind, self._tau)

    @property
    def transmits(self) -> bool:
        """Does any face transmit diffusely?"""
        return self._elements.patches.twin is not None

    def of_elements(self, irradiance: "mi.Color3f", behind: "mi.Color3f | None" = None) -> "mi.Color3f":
        """Light that leaves all elements, W/m² (Color3f [elements]), from irradiance (Color3f [elements]).

        behind: the irradiance whose transmitted part is added; by default the same irradiance.
        """
        reflected = self._elements.reflectance * irradiance
        return reflected + self.transmitted(irradiance if behind is None else behind) if self.transmits else reflected

    def of_leaves(self, irradiance: Values, behind: "Sequence[dr.ArrayBase] | None" = None) -> Values:
        """Light that leaves the leaves, W/m², from irradiance (three Float or Float64 [leaves], or Color3f [leaves]).

        behind: the irradiance whose transmitted part is added; by default the same irradiance.
        """
        rho = dr.gather(mi.Color3f, self._elements.reflectance, self._elements.leaves)
        light = [h * type(h)(r) for h, r in zip(irradiance, rho)]
        if self.transmits:
            more = self.transmitted_to_leaves(irradiance if behind is None else behind)
            light = [h + type(h)(t) for h, t in zip(light, more)]
        return type(irradiance)(light)  # type: ignore[call-arg]

    def transmitted(self, irradiance: "mi.Color3f") -> "mi.Color3f":
        """The part of the light that comes from the other side, τ_b H_b, W/m² (Color3f [elements])."""
        if not self.transmits:
            return dr.zeros(mi.Color3f, len(self._elements))
        light = self._tau * dr.gather(mi.Color3f, irradiance, self._behind)
        return self._elements.averaged_over_clusters(light)

    def transmitted_to_leaves(self, irradiance: "Sequence[dr.ArrayBase]") -> "mi.Color3f":
        """The same for leaves, from the irradiance of leaves (three Float or Float64 [leaves] to Color3f [leaves])."""
        if not self.transmits:
            return mi.Color3f(0)
        light = self.transmitted(pull(self._elements, [mi.Float64(h) for h in irradiance], self._area))
        return dr.gather(mi.Color3f, light, self._elements.leaves)


def _behind(elements):
    """Elements of the other side at the place of each element, and their τ, 0 where there is no other side (UInt32,
    Color3f [elements])."""
    twin, tau, there = elements.patches.behind(elements.patch)
    if elements.crown:  # clusters are averaged from their patches
        there &= ~elements.crown.holds(dr.arange(mi.UInt32, len(elements)))
    element = _descend(elements.child, dr.select(there, twin, 0), elements.place, there)
    return element, dr.select(there, tau, 0)


@dr.syntax
def _descend(child, element, place, active):
    """The element below roots ``element`` at a ``place``, or its deepest ancestor that exists (UInt32 [n])."""
    element, depth = mi.UInt32(element), mi.UInt32(0)
    first = dr.gather(mi.UInt32, child, element, active)
    while (first != 0) & (depth < (place & 15)):
        # `Tree` keeps the child numbers on the way down as two bits each, from the top.
        element = first + ((place >> (2 * (MAX_LEVEL - depth) + 2)) & 3)
        depth += 1
        first = dr.gather(mi.UInt32, child, element)
    return element
