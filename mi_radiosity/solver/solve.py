"""solve(): one call from a scene to its radiosity."""

import time
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError, interruptible
from ..core.numbers import real_number, whole_number
from ..core.points import Stream, stream_seed
from ..mesh import Clusters, Exposure, Pairs, Tree, cluster_labels, crossed_leaves
from ..oracles import GMI, Oracle
from ..scene import Model
from ..scene.lamps import Lamps
from ..transport import PILOT, Gathering, Problem, Transport
from .cost import FEW_RAYS, afford, affordable, default_rays, plan, top_of
from .layers import POWERS, powers, solve_layers
from .refine import Refinement
from .solution import Solution


@interruptible()
def solve(
    scene: "mi.Scene | Model",
    oracle: Oracle | None = None,
    *,
    elements: int | None = None,
    epsilon: float | None = None,
    rays: int | None = None,
    lines: int = 10,
    seed: int = 0,
    transport: Transport | None = None,
    pilot: Transport = PILOT,
    layers: bool = False,
    seconds: float | None = None,
    progress: Callable[[str, int, int | None], None] | None = None,
) -> Solution:
    """Solve the diffuse light transport of a scene, B_i = E_i + ρ_i Σ_j F_ij B_j (eq. 1).

    scene: mi.Scene (or a Model of one). oracle: an Oracle, GMI(0.5) by default.
    elements: elements wanted, reached to within 3. The mesh has fewer if the oracle finds nothing left to split, and
    more if clusters of patches cannot be as large as that; a warning says so. epsilon: the ε of the oracle, instead of
    elements. Without either the mesh has 19,000 elements more than the scene has patches, but 114,000 at most, unless
    the oracle finds less to refine. Where there are to be fewer elements than patches, or hardly more, if there are
    many (by default if more than 95,000), clusters of patches are elements (`Crown`): they share one irradiance and
    one set of pairs, and the oracle splits them. rays: rays that carry the power and gather it, used exactly; by
    default 300 for each of the first 19,000 elements, and 20 for each of all, as light, not tessellation, decides what
    is needed; twice as many where lamps cast sharp shadows and are no surfaces. lines: random lines S per pair for the
    oracle. seed: any integer; the same seed gives the same solution. transport, pilot: how power is carried over the
    finished mesh, and while it grows; `Gathering()` and `PILOT` by default, while `Shooting()` shoots it only. layers:
    keep the light of every lamp by itself, for `Solution.relight`; the rays are shared out by the lamps' power.
    seconds: choose elements and rays, where they are not given, so that it takes about so long, reading the scene and
    all; from then on more of them would go into pictures with more profit (see `afford`). progress: called with
    (stage, done, total), stage being "refine" or "distribute" (total is None where it is not known).

    Returns a Solution; ``stats["warnings"]`` says if the rays are too few for the elements, and if the mesh has another
    number of elements than was asked for. The solution of a scene that no light reaches is black. Numbers may be
    Python's or NumPy's; 1e6 is a whole number, 1.5 and True are none. Raises RadiosityError for options and scenes that
    cannot be used.
    """
    oracle, transport = oracle or GMI(0.5), transport or Gathering()
    _check(oracle, transport, pilot, elements, epsilon)
    elements, rays = (
        None if n is None else whole_number(name, n) for name, n in (("elements", elements), ("rays", rays))
    )
    epsilon = None if epsilon is None else real_number("epsilon", epsilon, 0)
    seconds = None if seconds is None else real_number("seconds", seconds, 0)
    lines, seed = whole_number("lines", lines), whole_number("seed", seed, None)
    report, clock = progress or (lambda stage, done, total: None), _Clock()

    model = scene if isinstance(scene, Model) else Model(scene)
    clock.lap("scene")
    asked, fixed = elements, rays is not None
    if seconds is not None:
        elements, rays, pace = afford(model, seconds - clock.total(), elements, rays)
    wanted, shared = plan(model, elements, epsilon)

    tree = Tree(model.patches, model.materials, model.lights, _clusters(model, shared))
    pairs = Pairs(tree, model.rays, oracle, lines, seed)
    refinement = Refinement(
        model,
        tree,
        pairs,
        pilot,
        wanted,
        epsilon,
        seed,
        lambda done: report("refine", done, wanted),
    )
    refinement.run()
    mesh = tree.freeze()
    exposure = Exposure.of(mesh, model.rays, seed)
    clusters = Clusters.of_leaves(mesh) if mesh.crown else None
    problem = Problem(model, mesh, pairs.freeze(mesh), exposure, clusters=clusters)
    count = tree.leaf_count
    clock.lap("refine")

    rays = rays or default_rays(model, count)
    if seconds is not None and not fixed:  # now that it is known what refinement took
        rays = affordable(rays, count, seconds, clock.total(), pace.ray)

    def carry(problem, rays_here, number=0, before=0):
        """Transport with a part of the rays: a Flow."""
        stream = stream_seed(seed, Stream.POWER, number)
        return transport(
            problem, rays_here, stream, refinement.first_share, lambda done: report("distribute", before + done, rays)
        )

    if layers:
        kept, flows = solve_layers(problem, rays, carry, Lamps(model))
        light, power = kept.summed(kept.scales), kept.balance(kept.scales)
    else:
        flow = carry(problem, rays)
        flows, power = [flow], dict(zip(POWERS, powers(problem, flow).sum(axis=1).tolist()))
        light = {name: getattr(flow, name) for name in ("direct", "indirect", "caustic", "sharp", "landings")}
        light |= {"model": model, "elements": mesh}
    shot = sum((flow.shot or flow).rays for flow in flows)
    clock.lap("distribute")

    stats = {
        "elements": count,
        "elements_wanted": count if asked is None else int(asked),
        "leaves": dr.width(mesh.leaves),
        "patches": model.patches.count,
        "pairs": pairs.evaluated,
        "rays": sum(flow.rays for flow in flows),
        "power_rays": shot,
        "gather_rays": sum(flow.rays for flow in flows) - shot,
        "oracle_rays": pairs.evaluated * pairs.lines if oracle.uses_lines else 0,
        "pilot_rays": refinement.rays,
        "iterations": max(flow.iterations for flow in flows),
        "power": power,
        "seconds": clock.seconds(),
        "epsilon": refinement.epsilon,
        "oracle": oracle.name,
        "alpha": oracle.alpha,
        "lines": pairs.lines,
        "seed": seed,
        "warnings": [
            *_shortfall(asked, epsilon, count, refinement.shortfall),
            *_warnings(count, rays, light["caustic"], flows if layers else []),
        ],
    } | ({"lamps": list(kept.names)} if layers else {})
    return Solution(exposure=problem.exposure, stats=stats, **light)


def _clusters(model, shared):
    """Labels of clusters that leave room for what the oracle splits of ``shared`` elements, if the patches are to have
    no more than so many; the largest clusters that there can be, where these are more than that."""
    if shared is None:
        return None
    patches = Tree(model.patches, model.materials, model.lights).freeze()
    crossed = np.zeros(model.patches.count, dtype=bool)
    crossed[np.array(crossed_leaves(patches, model.rays))] = True
    return cluster_labels(model.faces, model.patches, crossed, top_of(shared))


def _check(oracle, transport, pilot, elements, epsilon):
    """Refuse options of the wrong kind, and options that exclude each other."""
    if not isinstance(oracle, Oracle):
        raise RadiosityError(
            f"the oracle must be an instance of mi_radiosity.Oracle, such as GMI(alpha=0.5), not {oracle!r}"
        )
    if elements is not None and epsilon is not None:
        raise RadiosityError("give either elements or epsilon, not both")
    for name, value in (("transport", transport), ("pilot", pilot)):
        if not callable(value):
            raise RadiosityError(f"{name} must be a mi_radiosity.Transport, such as Gathering(), not {value!r}")


def _shortfall(asked, epsilon, count, why):
    """What a user should know of a mesh that is not as was asked for (list of str)."""
    if asked is not None and count > asked + 2:
        why = "only neighbours of one shape and of like normals share their light"
    elif (asked is None and epsilon is None) or why is None:
        return []
    if asked is None:
        return [f"epsilon {epsilon:g} was not reached with {count:,} elements: {why}"]
    return [f"the mesh has {count:,} elements instead of {asked:,}: {why}"]


def _warnings(elements, rays, caustic, flows):
    """What a user should know of the budget, and of light that is shown less well (list of str)."""
    enough, found = FEW_RAYS * elements, []
    if rays < enough:
        found.append(
            f"{rays:,} rays are few for {elements:,} elements, and noisy: give {enough:,} or more, or fewer elements"
        )
    elif few := sum(flow.rays < enough for flow in flows):
        found.append(
            f"{few} of {len(flows)} lamps are weak, have fewer than {enough:,} rays, and are noisy by themselves"
        )
    if caustic is not None and dr.any(caustic > 0, axis=None):
        found.append(
            "light of lamps that are no surfaces comes through glass or off mirrors: it is shown as sharp as elements "
            "are, and only known of surfaces"
        )
    return found


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self._stages: dict[str, float] = {}

    def lap(self, stage):
        dr.sync_thread()
        now = time.perf_counter()
        self._stages[stage], self._last = now - self._last, now

    def total(self):
        """Seconds so far."""
        return time.perf_counter() - self._start

    def seconds(self):
        return self._stages | {"total": self._last - self._start}
