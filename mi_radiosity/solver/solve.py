"""solve(): one call from a scene to its radiosity."""

import time

import drjit as dr
import mitsuba as mi

from ..core.errors import RadiosityError, interruptible
from ..oracles import GMI, Oracle
from ..scene import Model
from ..core.arrays import totals
from ..mesh.exposure import find_covered, find_divided
from ..mesh.elements import Elements
from ..transport.gather import Starved
from ..mesh.pairs import Pairs
from ..transport.series import distribute
from .refine import Refinement
from .solution import Solution

ELEMENTS = 19_000  # default mesh: so many leaves more than patches, or twice the patches
RAYS_PER_ELEMENT = 300  # default ray budget


@interruptible()
def solve(scene, oracle=None, *, elements=None, epsilon=None, rays=None, lines=10, seed=0, progress=None):
    """Solve the diffuse light transport of a scene, B_i = E_i + ρ_i Σ_j F_ij B_j (eq. 1).

    scene: mi.Scene (or a Model of one). oracle: an Oracle, GMI(0.5) by default.
    elements: leaf elements wanted, reached to within 3; or epsilon: the ε of the oracle. Without
    either, 19,000 more than the scene has patches, or twice the patches, unless the oracle finds less
    to refine. rays: rays that carry the power, used exactly; 300 per element by default. lines: random
    lines S per pair for the oracle. seed: any integer; the same seed gives the same solution.
    progress: called with (stage, done, total), stage
    being "refine" or "distribute" (total is None where it is not known).

    Returns a Solution. Raises RadiosityError for options and scenes that cannot be used.
    """
    oracle = GMI(0.5) if oracle is None else oracle
    if not isinstance(oracle, Oracle):
        raise RadiosityError(
            f"the oracle must be an instance of mi_radiosity.Oracle, such as GMI(alpha=0.5), not {oracle!r}"
        )
    if elements is not None and epsilon is not None:
        raise RadiosityError("give either --elements or --epsilon, not both")
    for name, value in (("elements", elements), ("rays", rays), ("lines", lines)):
        if value is not None and (value != int(value) or value <= 0):
            raise RadiosityError(f"--{name} must be a whole number greater than 0, not {value}")
    if epsilon is not None and not 0 < epsilon < float("inf"):
        raise RadiosityError(f"--epsilon must be a number greater than 0, not {epsilon}")
    report = progress or (lambda stage, done, total: None)

    clock = [time.perf_counter()]

    def lap():
        dr.sync_thread()
        clock.append(time.perf_counter())
        return clock[-1] - clock[-2]

    model = scene if isinstance(scene, Model) else Model(scene)
    exact = elements is not None
    if epsilon is None and elements is None:
        elements = model.count + max(ELEMENTS, model.count)
    if elements is not None and elements < model.count:
        raise RadiosityError(
            f"the scene has {model.count} patches, so {elements} elements cannot be reached: ask for at least {model.count} --elements"
        )
    seconds = {"scene": lap()}

    tree = Elements(model)
    pairs = Pairs(tree, oracle, int(lines), seed & 0xFFFFFFFF)
    refinement = Refinement(
        pairs, elements, epsilon, seed & 0xFFFFFFFF, lambda done: report("refine", done, elements), exact
    )
    refinement.run()
    find_covered(tree, seed & 0xFFFFFFFF)
    find_divided(tree)
    seconds["refine"] = lap()

    rays = int(rays or RAYS_PER_ELEMENT * tree.leaves)
    starved = Starved(tree, rays, seed & 0xFFFFFFFF)
    flow = distribute(
        pairs,
        rays - starved.rays,
        seed & 0xFFFFFFFF,
        first_share=refinement.first_share,
        progress=lambda done: report("distribute", done + starved.rays, rays),
    )
    power = _balance(tree, flow)
    starved.feed(flow)
    seconds["distribute"] = lap()
    seconds["total"] = clock[-1] - clock[0]

    stats = {
        "elements": tree.leaves,
        "patches": model.count,
        "pairs": pairs.evaluated,
        "rays": flow.rays + starved.rays,
        "oracle_rays": pairs.evaluated * pairs.lines if oracle.uses_lines else 0,
        "pilot_rays": refinement.rays,
        "iterations": flow.iterations,
        "power": power,
        "seconds": seconds,
        "epsilon": refinement.epsilon,
        "oracle": oracle.name,
        "alpha": oracle.alpha,
        "lines": pairs.lines,
        "seed": seed,
    }
    return Solution(model, tree, flow.direct, flow.indirect, stats)


def _balance(tree, flow):
    """Emitted, absorbed, escaped and unshot power in W, channels added up.

    What is absorbed comes from the irradiance of the solution, not from counting rays.
    """
    leaves = tree.leaf_indices()
    irradiance = dr.gather(mi.Color3f, flow.direct + flow.indirect, leaves)
    absorbed = (
        (1 - dr.gather(mi.Color3f, tree.reflectance, leaves)) * irradiance * dr.gather(mi.Float, tree.open_area, leaves)
    )
    return {
        "emitted": sum(flow.emitted),
        "absorbed": sum(totals([mi.Float64(a) for a in absorbed])) + sum(flow.blocked),
        "escaped": sum(flow.escaped),
        "unshot": sum(flow.unshot),
    }
