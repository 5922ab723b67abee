"""Path-traced references: in passes, in two independent halves, in one file that can be added to."""

import hashlib
import json
import math
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR

from .. import __version__
from ..core.errors import RadiosityError
from ..core.files import writing
from ..scene import Model
from .metrics import reference_noise

PASS = 64  # samples per pixel of one pass: 8 × 8 strata
WAVEFRONT = 1 << 24  # rays in flight, at most


@dataclass
class Reference:
    """A reference of one sensor: sums over passes of both halves, and what they are of.

    sums: float64 [2, height, width, 3]; spp: samples per pixel in each half.
    """

    identity: dict
    sums: np.ndarray
    spp: list = field(default_factory=lambda: [0, 0])

    def halves(self):
        """Means of the two halves, linear (float32 [2, height, width, 3])."""
        return (self.sums / np.maximum(self.spp, 1)[:, None, None, None]).astype(np.float32)

    def noise(self):
        """The reference's own RMSE_a (0…255), from the difference of its halves."""
        return reference_noise(self.halves())

    def image(self):
        return self.halves().mean(axis=0)

    def save(self, path):
        """One EXR: the mean as RGB, the halves beside it, the rest in its header."""
        header = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
            "mi_radiosity": json.dumps(self.identity | {"spp": self.spp, "noise": self.noise()}),
        }
        halves = self.halves()
        with writing(path) as temporary:
            try:
                OpenEXR.File(
                    header,
                    {
                        "RGB": np.ascontiguousarray(halves.mean(axis=0)),
                        "half0": np.ascontiguousarray(halves[0]),
                        "half1": np.ascontiguousarray(halves[1]),
                    },
                ).write(temporary)
            except RuntimeError as error:
                raise OSError(str(error)) from None

    @staticmethod
    def load(path):
        """Raises RadiosityError if the file is no reference or is damaged."""
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


def identity(model, sensor, seed=0, depth=-1):
    """What a reference depends on: scene content, sensor, depth, seed, versions (dict)."""
    film = sensor.film()
    view = hashlib.sha256(
        repr(
            (
                sensor.class_name(),
                np.round(np.array(sensor.world_transform().matrix), 5).tolist(),
                str(film),
                [str(v) for _, v in mi.traverse(sensor)],
            )
        ).encode()
    ).hexdigest()
    return {
        "scene": model.fingerprint,
        "sensor": view,
        "depth": depth,
        "seed": seed,
        "sampler": "stratified",
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
    }


def render_reference(scene, sensor, path, spp=1024, seed=0, progress=lambda done, total: None):
    """Path-trace a reference into ``path`` until it has ``spp`` samples per pixel; returns a Reference.

    Passes alternate between the two halves and each is kept as soon as it is done, so a run that was
    stopped goes on where it was, and a finished one can be given more samples. Depth is unlimited,
    which is what the solver models. Processes may share a file: none undoes what another has done.
    progress is told samples per pixel.

    Raises RadiosityError if the file holds something else.
    """
    model = scene if isinstance(scene, Model) else Model(scene)
    want = identity(model, sensor, seed)
    height, width = sensor.film().crop_size()[1], sensor.film().crop_size()[0]
    reference = _kept(path, want) or Reference(want, np.zeros((2, height, width, 3)))
    each = pass_size(width * height)
    tracer = _path_with("stratified")
    while sum(reference.spp) < spp or reference.spp[0] != reference.spp[1]:
        half = int(reference.spp[1] < reference.spp[0])
        number = sum(reference.spp) // each
        image = np.array(tracer.render(model.scene, sensor, seed=_seed(seed, number), spp=each), dtype=np.float64)[
            ..., :3
        ]
        reference.sums[half] += each * image
        reference.spp[half] += each
        progress(sum(reference.spp), spp)
        if reference.spp[0] == reference.spp[1]:
            kept = _kept(path, want)
            if kept and sum(kept.spp) >= sum(reference.spp):  # another process is ahead: go on from there
                reference = kept
            else:
                reference.save(path)
    return reference


def _kept(path, want):
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


def pass_size(pixels):
    """Samples per pixel of one pass: a square number that fits in a wavefront."""
    return min(PASS, max(1, math.isqrt(WAVEFRONT // pixels)) ** 2)


def _seed(seed, number):
    return (seed * 0x9E3779B1 + number) & 0xFFFFFFFF


def path_image(scene, sensor, spp, seed=0):
    """Picture by Mitsuba's `path`, unlimited depth, independent of any reference (float32 array).

    Its samples are independent ones: with 4 or 16 samples per pixel Mitsuba's stratified sampler is
    off by up to a third in the mean.
    """
    image, done, tracer = 0.0, 0, _path_with("independent")
    most = pass_size(sensor.film().crop_size()[0] * sensor.film().crop_size()[1])
    while done < spp:
        count = min(most, spp - done)
        image = (
            image + count * np.array(tracer.render(scene, sensor, seed=_seed(seed + 0xB5, done), spp=count))[..., :3]
        )
        done += count
    return (image / done).astype(np.float32)


def _path_with(kind):
    """Mitsuba's `path` with a sampler of some kind, whatever sampler the scene has."""
    from mitsuba.python.ad.integrators.common import ADIntegrator

    class Path(ADIntegrator):
        def __init__(self):
            super().__init__(mi.Properties())
            self.path = mi.load_dict({"type": "path", "max_depth": -1})

        def prepare(self, sensor, seed, spp, aovs):
            sampler = mi.load_dict({"type": kind, "sample_count": spp})
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


def versions():
    return {"mi_radiosity": __version__, "mitsuba": mi.__version__, "drjit": dr.__version__, "numpy": np.__version__}
