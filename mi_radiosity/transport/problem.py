"""What a transport is given, and what it leaves behind."""

from dataclasses import dataclass
from functools import cached_property

import mitsuba as mi

from ..mesh import Clusters, Elements, Exposure, Pairs, Scattering
from ..scene import Model
from .landings import Landings


@dataclass(frozen=True)
class Problem:
    """A scene, a mesh of it, and who exchanges power with whom; all of it finished."""

    model: Model
    elements: Elements
    pairs: Pairs
    exposure: Exposure
    known: "Known | None" = None
    clusters: Clusters | None = None  # leaves that share one irradiance, if any do

    @cached_property
    def scattering(self) -> Scattering:
        """What of the irradiance leaves the elements diffusely."""
        return Scattering(self.elements, self.exposure)


@dataclass(frozen=True)
class Known:
    """Irradiance straight from the lamps that is known beforehand (3 Float64 [leaves], W/m²), and where it came down. A
    transport may start from it; what it sends from there is better than what it had shot there."""

    direct: "list[mi.Float64]"
    landings: Landings


@dataclass
class Record:
    """Rays that met a patch, to discover pairs with: from source (j, uj, vj) to receiver (i, ui, vi)."""

    i: "mi.UInt32"
    ui: "mi.Float"
    vi: "mi.Float"
    j: "mi.UInt32"
    uj: "mi.Float"
    vj: "mi.Float"
    pair: "mi.UInt32"  # where each ray stands in the pair tree, NONE before its root exists


@dataclass(frozen=True)
class Flow:
    """What one transport did. Power in W per channel, irradiance in W/m².

    Irradiances are Color3f [elements]: right at the leaves, area averages at their ancestors. ``direct`` came straight
    from the lamps, ``indirect`` is all other light. ``caustic`` is the part of it that only shooting finds: light of
    lamps that no ray can meet, such as `point`, or not but by chance, such as the sun, which came through smooth lobes
    first. ``sharp`` is the part of ``direct`` that is as if from points, of such lamps. Both are None where there is
    none, or it is not known apart.
    """

    direct: "mi.Color3f"
    indirect: "mi.Color3f"
    landings: Landings  # where light came down on leaves that a wall crosses
    rays: int
    iterations: int
    first_share: float  # of the power shot in all, the lamps' part
    emitted: list[float]
    escaped: list[float]
    blocked: list[float]  # absorbed by sides that reflect nothing, and by lobes that are traced
    unshot: list[float]
    records: tuple[Record, ...] = ()
    caustic: "mi.Color3f | None" = None
    sharp: "mi.Color3f | None" = None
    shot: "Flow | None" = None  # what the light was gathered from, if it was; its power is kept to the letter
