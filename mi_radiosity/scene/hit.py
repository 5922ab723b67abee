"""Where rays end."""

from dataclasses import dataclass, field

import mitsuba as mi


@dataclass
class Hit:
    """Where rays end; one entry per ray. The last four say what happened on the way, where power rays passed
    surfaces that are not plainly diffuse (`Lobes`); elsewhere they are literals, which cost nothing.

    ``patch`` is NONE for rays that escape (not ``valid``), on sides of faces that take no part in light transport, and
    for power rays that are absorbed on the way.
    """

    valid: "mi.Bool"  # something was hit
    patch: "mi.UInt32"
    u: "mi.Float"  # barycentric coordinates on the face
    v: "mi.Float"
    back: "mi.Bool"  # the side that was hit first is the back of its face
    traced: "mi.Bool"  # the surface that was hit first is not plainly diffuse

    bounced: "mi.Bool" = field(default_factory=lambda: mi.Bool(False))  # a lobe was sampled that is not diffuse
    rough: "mi.Bool" = field(default_factory=lambda: mi.Bool(False))  # the first such lobe was no delta lobe
    weight: "mi.Color3f" = field(default_factory=lambda: mi.Color3f(1))  # of the power that arrives
    taken: "mi.Color3f" = field(default_factory=lambda: mi.Color3f(0))  # share of the power absorbed on the way
