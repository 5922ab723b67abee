"""Path-traced references: in passes, in two independent halves, in one file that can be added to."""

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR

from ..core.errors import RadiosityError
from ..core.files import writing
from ..core.numbers import whole_number
from ..display import hides_emitters, linear_rgb
from ..scene import Model
from ..scene.lights import Infinite
from .metrics import reference_noise
from .records import make_folder

PASS = 64  # samples per pixel of one pass, at most
WAVEFRONT = 1 << 24  # rays in flight, at most


@dataclass
class Reference:
    """A reference of one sensor: sums over passes of both halves, and what they are of.

    sums: float64 [2, height, width, 3]; spp: samples per pixel in each half.
    """

    identity: dict[str, Any]
    sums: np.ndarray
    spp: list[int] = field(default_factory=lambda: [0, 0])

    def halves(self) -> np.ndarray:
        """Means of the two halves, linear (float32 [2, height, width, 3])."""
        return (self.sums / np.maximum(self.spp, 1)[:, None, None, None]).astype(np.float32)

    def noise(self) -> float:
        """The reference's own RMSE_a (0…255), from the difference of its halves."""
        return reference_noise(self.halves())

    def image(self) -> np.ndarray:
        """The mean of both halves, linear (float32 [height, width, 3])."""
        return self.halves().mean(axis=0)

    def save(self, path: str | Path) -> None:
        """One EXR: the mean as RGB, the halves beside it, the rest in its header."""
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "mi_radiosity": json.dumps(self.identity | {"spp": self.spp, "noise": self.noise()}),
        }
        halves = self.halves()
        planes = {"RGB": halves.mean(axis=0), "half0": halves[0], "half1": halves[1]}
        with writing(path) as temporary:
            try:
                OpenEXR.File(header, {name: np.ascontiguousarray(p) for name, p in planes.items()}).write(temporary)
            except RuntimeError as error:
                raise OSError(str(error)) from None

    @staticmethod
    def load(path: str | Path) -> "Reference":
        """A kept reference. Raises RadiosityError if the file is none or is damaged."""
        try:
            with OpenEXR.File(str(path)) as file:
                data = json.loads(file.header()["mi_radiosity"])
                spp = data.pop("spp")
                data.pop("noise")
                halves = np.stack(
                    [np.array(file.channels()[name].pixels, dtype=np.float64) for name in ("half0", "half1")]
                )
            return Reference(data, halves * np.array(spp)[:, None, None, None], spp)
        except Exception as error:
            raise RadiosityError(
                f"{path} is not a readable reference ({type(error).__name__}): remove it to render it anew"
            ) from None


def identity(model: Model, sensor: "mi.Sensor", seed: int = 0, depth: int = -1) -> dict[str, Any]:
    """What a reference depends on: scene content, sensor, depth, seed, sampler, versions."""
    place = np.round(np.array(sensor.world_transform().matrix), 5).tolist()
    view = [sensor.class_name(), place, str(sensor.film()), [str(v) for _, v in mi.traverse(sensor)]]
    if hides_emitters(model.scene):
        view.append("hide_emitters")
    return {
        "scene": model.fingerprint,
        "sensor": hashlib.sha256(repr(tuple(view)).encode()).hexdigest(),
        "depth": depth,
        "seed": seed,
        "sampler": "independent",
        "mitsuba": version("mitsuba"),
        "drjit": version("drjit"),
    }


def render_reference(
    scene: "mi.Scene | Model",
    sensor: "mi.Sensor",
    path: Path,
    spp: int = 1024,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Reference:
    """Path-trace a reference into ``path`` until it has ``spp`` samples per pixel.

    Passes alternate between the two halves and each is kept as soon as it is done, so a run that was
    stopped goes on where it was, and a finished one can be given more samples. Depth is unlimited,
    which is what the solver models. Emitters are hidden where the scene's own integrator hides them.
    Processes may share a file: none undoes what another has done.
    progress is told samples per pixel.

    Raises RadiosityError if the file holds something else, or if Mitsuba would trace the scene wrongly.
    """
    spp, seed = whole_number("spp", spp), whole_number("seed", seed, None)
    model = scene if isinstance(scene, Model) else Model(scene)
    _require_whole_box(model)
    want = identity(model, sensor, seed)
    width, height = sensor.film().crop_size()
    reference = _kept(path, want) or Reference(want, np.zeros((2, height, width, 3)))
    each, tracer = pass_size(sensor), _path(hides_emitters(model.scene))
    while sum(reference.spp) < spp or reference.spp[0] != reference.spp[1]:
        half = int(reference.spp[1] < reference.spp[0])
        image = tracer.render(model.scene, sensor, seed=_seed(seed, sum(reference.spp) // each), spp=each)
        reference.sums[half] += each * linear_rgb(image, sensor.film()).astype(np.float64)
        reference.spp[half] += each
        progress(sum(reference.spp), spp)
        if reference.spp[0] == reference.spp[1]:
            reference = _keep(reference, path)
    return reference


def _require_whole_box(model: Model) -> None:
    """Refuse scenes whose sky and sun shine through walls in `path`, see docs/mitsuba_issues.md."""
    box, faces = model.scene.bbox(), model.faces
    slack = 1e-5 * float(np.abs([faces.low, faces.high]).max())
    whole = (np.array(box.min) <= faces.low + slack).all() and (np.array(box.max) >= faces.high - slack).all()
    if not whole and any(isinstance(light, Infinite) for light in model.lights.free):
        raise RadiosityError(
            "Mitsuba's box of the scene does not hold all of its faces, so 'path' lets the sky shine through walls: "
            "load the scene with optimize=False"
        )


def _keep(reference: Reference, path: Path) -> Reference:
    """Write a reference, unless another process is ahead: then go on from what that has kept."""
    kept = _kept(path, reference.identity)
    if kept and sum(kept.spp) >= sum(reference.spp):
        return kept
    reference.save(path)
    return reference


def _kept(path: Path, want: dict[str, Any]) -> Reference | None:
    """The Reference in ``path`` if there is one; an error if it is not of identity ``want``."""
    if not path.exists():
        return None
    reference = Reference.load(path)
    changed = [name for name in want if reference.identity.get(name) != want[name]]
    if changed:
        raise RadiosityError(
            f"{path} is the reference of another {' and '.join(changed)}: remove it or choose another name"
        )
    return reference


def cached_reference(
    model: Model, view: int, output: Path, spp: int, progress: Callable[[str, int, int], None]
) -> tuple[Reference, Path]:
    """(Reference, file) of a view, from ``output``/references or rendered into it; its name says what it is of."""
    sensor = model.scene.sensors()[view]
    mark = identity(model, sensor)
    file = output / "references" / f"view{view}_{mark['scene'][:12]}_{mark['sensor'][:12]}_{mark['sampler']}.exr"
    make_folder(file.parent)
    stage = f"reference of view {view}"
    return render_reference(model, sensor, file, spp, progress=lambda done, total: progress(stage, done, total)), file


def pass_size(sensor: "mi.Sensor") -> int:
    """Samples per pixel of one pass, as many as a wavefront holds."""
    return min(PASS, max(1, WAVEFRONT // dr.prod(sensor.film().crop_size())))


def _seed(seed: int, number: int) -> int:
    return (seed * 0x9E3779B1 + number) & 0xFFFFFFFF


def path_image(scene: "mi.Scene", sensor: "mi.Sensor", spp: int, seed: int = 0) -> np.ndarray:
    """Linear RGB by Mitsuba's `path`, unlimited depth, independent of any reference (float32 [height, width, 3])."""
    image: Any = 0.0
    done, tracer = 0, _path(hides_emitters(scene))
    while done < spp:
        count = min(pass_size(sensor), spp - done)
        part = tracer.render(scene, sensor, seed=_seed(seed + 0xB5, done), spp=count)
        image, done = image + count * linear_rgb(part, sensor.film()), done + count
    return np.asarray(image / done, dtype=np.float32)


def _path(hide_emitters: bool) -> Any:
    """Mitsuba's `path` with independent samples, whatever sampler the scene names.

    Its stratified sampler is biased: with 4 samples per pixel the office is 37 % too bright in the
    mean, with 16 by 5 %, with 64 by 0.15 % too dark.
    """
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class Path(ADIntegrator):
        def __init__(self):
            super().__init__(mi.Properties())
            self.path = mi.load_dict({"type": "path", "max_depth": -1, "hide_emitters": hide_emitters})

        def prepare(self, sensor, seed, spp, aovs):
            sampler = mi.load_dict({"type": "independent", "sample_count": spp})
            sampler.set_samples_per_wavefront(spp)
            film = sensor.film()
            size = film.crop_size() + (2 * film.rfilter().border_size() if film.sample_border() else 0)
            sampler.seed(seed, dr.prod(size) * spp)
            film.prepare(aovs)
            return sampler, spp

        def sample(self, mode, scene, sampler, ray, **_):
            color, valid, _ = self.path.sample(scene, sampler, ray, None, True)
            return color, valid, [], None

    return Path()


def versions() -> dict[str, str]:
    """What results were made with."""
    return {name: version(name) for name in ("mi_radiosity", "mitsuba", "drjit", "numpy")}
