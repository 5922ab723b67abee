"""What a solve will cost, before it is begun."""

import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..core.arrays import opaque_index
from ..core.points import kronecker, triangle
from ..scene import Model
from ..transport.emit import AT_ONCE

ELEMENTS = 19_000  # default mesh: so many leaves more than patches
RAYS_PER_ELEMENT, LEAST_RAYS = 300, 20  # default ray budget: for the first ELEMENTS leaves, and for all of them
SOLVING_SHARE = 0.25  # of the time for solve and pictures: 15 % and 50 % were worse
TOP = 1 / 4  # of the elements, at least, are there before the oracle is asked, where patches share them
FEW_RAYS = 30  # per element, below which it is noisy, and shares with others if the time is short
RAYS_SHARE = 0.4  # of the time of a solve, that rays have at least: classroom, 20 s in all: 5.8 → 5.0
FEW_SHARED = 32_000  # elements that many patches share where time is short: with 19,000 pictures are up to 12 % worse
ENOUGH_RAYS = 60  # per element: as long as there are fewer, rays add more to a picture than elements
MOST = 4  # times the default rays: more add less to a picture than camera samples do
SHARES = [MOST * 2 ** (k / 16 - 7) for k in range(113)]  # of the default elements and rays that are tried
SHARED = 6 * ELEMENTS  # irradiances by default, where there are more leaves: faces are smaller than light needs them
PROBES = 1 << 16  # rays that are timed
RUN = 32  # of them leave from one patch, as most rays of a solve have a neighbour there
FOLLOWED = 0.5  # of the rays go on through lobes; the others are lines
# Bytes, measured: of Mitsuba; a patch; an element more than those, with its pairs; a ray in a launch; any ray.
PROGRAM, PER_PATCH, PER_ELEMENT, PER_RAY, PER_LINK = 110e6, 2.5e3, 4e3, 24, 26
# Times what tracing a ray takes: all that is done with one; all lines that look at the pairs of an element.
WORK, LINES = 2.4, 400
# Launches that there are however few rays, as launches of rays, and the seconds of all others.
LAUNCHES, OTHERS = 300, 0.1


@dataclass(frozen=True)
class Cost:
    """What `solve` would use: leaf elements, rays, bytes of memory at its peak, and seconds after the scene is read."""

    elements: int
    rays: int
    memory: float
    seconds: float


@dataclass(frozen=True)
class Pace:
    """Seconds of what a solve does here: whatever its size, for a ray, and for an element that refinement adds."""

    least: float
    ray: float
    element: float

    @classmethod
    def of(cls, model: Model) -> "Pace":
        """Multiples of what some rays of a Model take that are traced here and now, straight and through lobes."""
        cast, lobes = model.rays, 0.0
        line, once = _seconds(model, lambda origin, direction, *_: cast.trace(origin, direction))
        if cast.lobes:
            both, _ = _seconds(model, cast.follow)
            lobes = max(both - line, 0)
        ray = WORK * line + FOLLOWED * lobes
        if model.lights.may_be_sharp:  # half of the rays are lines from where others end, and short
            ray /= 2
        return cls(OTHERS + LAUNCHES * once, ray, LINES * line)


def estimate_cost(model: Model, elements: int | None = None, rays: int | None = None) -> Cost:
    """What solving a Model costs, by default or with so many elements and rays; good to a factor of two."""
    pace, (count, more) = Pace.of(model), _sizes(model, elements)
    rays = rays or default_rays(model, count)
    memory = (
        PROGRAM + PER_PATCH * model.patches.count + PER_ELEMENT * more + PER_RAY * min(rays, AT_ONCE) + PER_LINK * rays
    )
    return Cost(count, rays, memory, pace.least + pace.ray * rays + pace.element * more)


def _sizes(model, elements):
    """Elements of a mesh, and how many of them refinement adds."""
    leaves, shared = plan(model, elements, None)
    return leaves, leaves - (top_of(shared) if shared else model.patches.count)


def default_rays(model: Model, elements: int) -> int:
    """The ray budget of so many leaf elements where none is given; twice as much where lamps cast sharp shadows, for
    which rays look from where they end."""
    rays = RAYS_PER_ELEMENT * min(elements, ELEMENTS) + LEAST_RAYS * elements
    return rays * (2 if model.lights.may_be_sharp else 1)


def plan(model: Model, elements: int | None, epsilon: float | None) -> tuple[int | None, int | None]:
    """Elements to refine to, None where ε decides; the same again if patches share them, else None.

    Faces that are smaller than the light needs share: where fewer elements are asked for than there are faces, or where
    there are very many by default; and where there are many faces and so few more elements that clusters of a tenth of
    the faces, or more, would leave the oracle some to split large faces with.
    """
    count = model.patches.count
    if epsilon is not None:
        return None, None
    wanted = min(count + ELEMENTS, SHARED) if elements is None else elements
    if elements is None:
        shares = count + ELEMENTS > SHARED
    else:
        shares = elements < count or (count > ELEMENTS and top_of(elements) < 0.9 * count)
    return wanted, wanted if shares else None


def top_of(elements: int) -> int:
    """How many of the elements are clusters to begin with where patches share; the oracle splits them from there on."""
    return max(round(TOP * elements), elements - ELEMENTS, 1)


def afford(
    model: Model, seconds: float, elements: int | None = None, rays: int | None = None
) -> tuple[int | None, int, Pace]:
    """Elements and rays, where they are not given, that a solve of about so many seconds has, None for the default; and
    the Pace they were found by.

    Both go with the time, up to the default elements and MOST times the default rays. Of the seconds that pass whatever
    there is to do, these are charged with half: with all of them nothing would be left where time is short.
    """
    pace, (count, more) = Pace.of(model), _sizes(model, elements)
    usual = rays or default_rays(model, count)
    default = pace.ray * usual + pace.element * more
    work = default * (seconds - 0.5 * pace.least) / (default + 0.5 * pace.least)

    def budget(share):
        """Elements and rays of a share of the default."""
        cast = rays or round(share * usual)
        if elements is not None or share >= 1:
            return elements, cast
        fewer = min(model.patches.count, SHARED - ELEMENTS) + round(ELEMENTS * share)
        fewer = min(fewer, max(cast // ENOUGH_RAYS, FEW_SHARED))
        return fewer, rays or max(cast, FEW_RAYS * fewer)

    def fits(share):
        fewer, cast = budget(share)
        return pace.ray * cast + pace.element * _sizes(model, fewer)[1] <= work * (1 + 1e-9)

    fewer, cast = budget(max(filter(fits, SHARES), default=SHARES[0]))
    least = min(usual, round(RAYS_SHARE * seconds / max(pace.ray, 1e-12)))
    return fewer, rays or max(cast, least), pace


def affordable(rays: int, elements: int, seconds: float, spent: float, each: float) -> int:
    """How many of the planned rays fit into what is left of a solve's seconds, at so many for each; not so few that
    elements are noisy."""
    left = max(seconds - spent, RAYS_SHARE * seconds)
    return min(rays, max(FEW_RAYS * elements, int(left / max(each, 1e-12))))


def _seconds(model, follow):
    """What a ray takes, and what a launch of them does whatever their number."""
    few = PROBES // 8
    _trace(model, follow, few)  # once before, as kernels are compiled
    taken = []
    for rays in (few, PROBES):
        start = time.perf_counter()
        _trace(model, follow, rays)
        taken.append(time.perf_counter() - start)
    ray = max(taken[1] - taken[0], 0) / (PROBES - few)
    return ray, max(taken[0] - few * ray, 0)


def _trace(model, follow, rays):
    """Trace cosine-distributed rays from all over the scene, neighbours after neighbours as a solve does."""
    n = dr.arange(mi.UInt32, rays)
    u, v, s, t = kronecker(n, opaque_index(0), opaque_index(0))
    patch = mi.UInt32(
        (mi.UInt64(n // RUN * RUN) * mi.UInt64(opaque_index(model.patches.count))) // mi.UInt64(opaque_index(rays))
    )
    hit = follow(*model.rays.leave(patch, *triangle(u, v), s, t), n, opaque_index(0))
    dr.eval(hit.patch, hit.u)
    dr.sync_thread()
