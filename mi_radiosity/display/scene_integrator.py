"""What a scene's own integrator says about pictures, as far as a radiosity solution can follow it."""

import re
from typing import Any

import mitsuba as mi

from ..scene.tessellate import children

RADIANCE = re.compile(r"Path|Volumetric|Volpath|PRB|RadiosityIntegrator|Direct|ParticleTracer")
UNLIMITED = {"-1", str(2**32 - 1)}  # how Mitsuba's integrators describe a path length without limit


def hides_emitters(scene: "mi.Scene") -> bool:
    """Does the scene's integrator hide emitters from the camera?

    Of integrators that contain others, such as ``aov`` and ``moment``, the first one inside makes the picture.
    """
    return bool(getattr(_innermost(scene.integrator()), "hide_emitters", False))


def solve_options(scene: "mi.Scene") -> tuple[dict[str, Any], str | None]:
    """Options of `solve` and the shading that an integrator ``radiosity`` of the scene names; none of other
    integrators."""
    integrator = _innermost(scene.integrator())
    if integrator is None or _name(integrator) != "RadiosityIntegrator":
        return {}, None
    return dict(integrator.named), integrator.named_shading


def unmodelled(scene: "mi.Scene") -> list[str]:
    """What the scene's integrator says and pictures of a solution do not follow: one line each."""
    outer = scene.integrator()
    inner, lines = _innermost(outer), []
    if inner is None:
        return []
    name = _name(inner)
    if inner is not outer:
        lines.append(f"the integrator {outer.class_name()} of the scene adds channels: pictures hold radiance only")
    if not RADIANCE.search(name):
        lines.append(f"the integrator {name} of the scene shows no radiance: pictures here show it")
    elif "Direct" in name:
        lines.append(f"the integrator {name} of the scene stops at direct light: pictures here hold all light")
    elif (depth := re.search(r"max_depth = (-?\d+)", str(inner))) and depth[1] not in UNLIMITED:
        lines.append(f"the integrator {name} of the scene stops at max_depth {depth[1]}: pictures here have no limit")
    if not hasattr(inner, "hide_emitters"):
        lines.append(f"the integrator {name} of the scene does not tell whether it hides emitters: see --hide-emitters")
    return lines


def _innermost(integrator):
    """The integrator that makes the picture: inside of others the first one; None without an integrator."""
    while integrator is not None:
        nested = [child for child in children(integrator) if isinstance(child, mi.Integrator)]
        if not nested:
            break
        integrator = nested[0]
    return integrator


def _name(integrator):
    """The class of an integrator; those written in Python share Mitsuba's name of their base class."""
    name = integrator.class_name()
    return type(integrator).__name__ if name == "SamplingIntegrator" else name
