"""One layer of light per lamp: sums of them, scaled, are the light of lamps dimmed and recoloured."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import apportion, owned, owned_vectors, totals
from ..core.errors import RadiosityError
from ..core.points import hash_pair
from ..mesh import Elements
from ..scene.lamps import Lamps
from ..transport import Flow, Problem
from ..transport.landings import SEATS, Landings
from ..transport.series import LEAST_RAYS

Scales = Mapping[str | int, float | tuple[float, float, float]]  # of lamps, by name or number
POWERS = ("emitted", "absorbed", "escaped", "unshot", "shown")  # by a transport; and absorbed of what is shown
LIGHT = ("direct", "indirect", "caustic", "sharp")  # of a Flow; the last two where there is some
ARRAYS = ("direct", "indirect", "u", "v", "power", "scales")  # that an archive keeps


@dataclass(frozen=True)
class Layers:
    """Light of every lamp as the scene has it, on one mesh.

    lamps: who they are. elements: the mesh, with the emission of the scene. direct, indirect, caustic, sharp:
    irradiance, W/m² (float32 [lamps, 3, elements]). u, v: landings [lamps, seats] (see `Landings`). power: W [POWERS,
    lamps, 3].
    scales: those of the solution that these layers belong to [lamps, 3].
    """

    lamps: Lamps
    elements: Elements
    direct: np.ndarray
    indirect: np.ndarray
    u: np.ndarray
    v: np.ndarray
    power: np.ndarray
    scales: np.ndarray
    caustic: np.ndarray | None = None
    sharp: np.ndarray | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return self.lamps.names

    def read(self, scales: Scales) -> np.ndarray:
        """Scales [lamps, 3] from a mapping; lamps it does not name stay as the scene has them.

        Raises RadiosityError for lamps there are none of, and for scales that are no light.
        """
        result = np.ones((len(self.lamps), 3))
        for lamp, scale in scales.items():
            number = self.names.index(lamp) if lamp in self.names else lamp
            if not isinstance(number, int | np.integer) or not 0 <= number < len(self.lamps):
                raise RadiosityError(f"there is no lamp {lamp!r}: choose from {', '.join(self.names)}")
            values = np.asarray(scale, dtype=np.float64)
            if values.shape not in ((), (3,)) or not np.isfinite(values).all() or (values < 0).any():
                raise RadiosityError(f"the scale of lamp {lamp!r} must be one number ≥ 0 or three, not {scale!r}")
            result[number] = values
        return result

    def summed(self, scales: np.ndarray) -> dict:
        """What of a Solution changes with the light: Σ_l s_l H_l, exact by superposition."""
        model = self.lamps.dimmed(scales)
        light = {name: getattr(self, name) for name in LIGHT}
        light = {
            name: None if h is None else owned_vectors(mi.Color3f, np.einsum("lc,lce->ec", scales, h))
            for name, h in light.items()
        }
        return {
            "model": model,
            "elements": _lit(self.elements, self.lamps, model, scales),
            "landings": self._landings(scales),
            "layers": replace(self, scales=scales),
        } | light

    def balance(self, scales: np.ndarray) -> dict[str, float]:
        """Power by where it went, W, channels added up."""
        return dict(zip(POWERS, map(float, (self.power * scales).sum(axis=(1, 2)))))

    def _landings(self, scales):
        """Every seat goes to one of the lamps that are on and came down on its leaf, drawn at random."""
        u, v = (x[scales.any(axis=1)] for x in (self.u, self.v))
        known, seats = ~np.isnan(u), np.arange(u.shape[1])
        count = known.sum(axis=0)
        lot = np.array(hash_pair(owned(mi.UInt32, seats), mi.UInt32(1))) if len(seats) else seats
        chosen = (np.cumsum(known, axis=0) == lot % np.maximum(count, 1) + 1) & known
        who = chosen.argmax(axis=0) if len(u) else np.zeros(0, int)
        points = [np.where(count > 0, x[who, seats], np.nan) if len(u) else np.full(u.shape[1], np.nan) for x in (u, v)]
        return Landings(u.shape[1] // SEATS, *points)

    # ---- Files ---------------------------------------------------------------------------------

    def arrays(self) -> dict[str, np.ndarray]:
        """What an archive keeps."""
        kept = (*ARRAYS, *(name for name in LIGHT[2:] if getattr(self, name) is not None))
        return {"lamps": np.array(self.names)} | {f"layers_{name}": getattr(self, name) for name in kept}

    @staticmethod
    def load(data: Mapping[str, np.ndarray], lamps: Lamps, elements: Elements) -> "Layers":
        """The layers in the arrays of an archive.

        Raises RadiosityError if its lamps have other names, so that they might be others.
        """
        if tuple(data["lamps"]) != lamps.names:
            raise RadiosityError(
                f"the lamps were called {', '.join(data['lamps'])}, and are called {', '.join(lamps.names)} now: "
                "solve the scene again"
            )
        kept = {name: data[f"layers_{name}"] for name in ARRAYS}
        caustic, sharp = (data.get(f"layers_{name}") for name in LIGHT[2:])
        return Layers(lamps, elements, **kept, caustic=caustic, sharp=sharp)


def solve_layers(
    problem: Problem, rays: int, carry: Callable[[Problem, int, int, int], Flow], lamps: Lamps
) -> tuple[Layers, list]:
    """Carry the power of every lamp by itself; returns the layers and their Flows.

    carry(problem, rays, number, done) transports the power of the lamp of a number, after ``done`` rays. Rays are
    shared out by power, LEAST_RAYS each at least.
    """
    flows, power, done = [], [], 0
    for number, (share, only) in enumerate(zip(_shares(lamps, rays), _one_by_one(len(lamps)))):
        model = lamps.dimmed(only)
        one = replace(problem, model=model, elements=_lit(problem.elements, lamps, model, only))
        flows.append(carry(one, share, number, done))
        power.append(powers(one, flows[-1]))
        done += share

    def stack(name):
        light = [getattr(flow, name) for flow in flows]
        known = [x is not None for x in light]
        none = np.zeros((3, len(problem.elements)), dtype=np.float32)
        rows = [np.array(x, dtype=np.float32).reshape(3, -1) if k else none for x, k in zip(light, known)]
        return np.array(rows) if any(known) else None

    u, v = (np.array([np.array(getattr(flow.landings, x)) for flow in flows]) for x in "uv")
    table, ones = np.array(power).swapaxes(0, 1), np.ones((len(lamps), 3))
    light = {name: stack(name) for name in LIGHT}
    return Layers(lamps, problem.elements, **light, u=u, v=v, power=table, scales=ones), flows


def powers(problem: Problem, flow: Flow) -> np.ndarray:
    """Emitted, absorbed, escaped and unshot power of a transport, and what of it is absorbed as it is shown, W
    [POWERS, 3].

    What is absorbed comes from irradiance, not from counting rays.
    """
    shot = flow.shot or flow
    absorbed, shown = (_absorbed(problem, f.direct + f.indirect) + f.blocked for f in (shot, flow))
    return np.array([shot.emitted, absorbed, shot.escaped, shot.unshot, shown])


def _absorbed(problem, irradiance):
    """(1 − ρ) H A of all leaves less what the other sides of faces transmit to them, W [3]."""
    leaves, elements = problem.elements.leaves, problem.elements
    kept = 1 - dr.gather(mi.Color3f, elements.reflectance, leaves)
    received, area = dr.gather(mi.Color3f, irradiance, leaves), dr.gather(mi.Float, problem.exposure.open_area, leaves)
    passed = problem.scattering.transmitted_to_leaves(received) * area
    return np.array(totals([mi.Float64(a) - mi.Float64(p) for a, p in zip(kept * received * area, passed)]))


def _lit(elements, lamps, model, scales):
    """Elements with the emission of a dimmed model."""
    return elements.with_light(model.patches, lamps.exitance(elements.exitance, elements.patch, scales))


def _one_by_one(count):
    for k in range(count):
        yield np.repeat(np.eye(count)[k][:, None], 3, axis=1)


def _shares(lamps, rays):
    """Whole numbers of rays for the lamps that add up to ``rays``, in proportion to their power (list)."""
    if len(lamps) == 0:
        raise RadiosityError("layers keep the light of emitters, and none has any power: leave out layers")
    enough = LEAST_RAYS * len(lamps)
    if rays < enough:
        raise RadiosityError(
            f"{rays} rays are too few for {len(lamps)} lamp{'s' * (len(lamps) > 1)}: give at least {enough}"
        )
    return apportion(rays, lamps.power.sum(axis=1), LEAST_RAYS)
