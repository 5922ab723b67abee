"""Pictures of solutions beside Mitsuba's `path`: the mean of all of it, and of every shape in it."""

import mi_radiosity as mr

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import stats

RUNS, SPP, TRUE_SPP = 8, 64, 256
DOUBT = 1e-4  # of all comparisons of one call together
FEW = 12  # pixels that make no mean


def pixels_of_shapes(scene):
    """Which pixels' middles show which shape: a mask each [shapes, height, width], all of them first; and their ids."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().size()
    k = dr.arange(mi.UInt32, int(width) * int(height))
    at = mi.Point2f((mi.Float(k % width) + 0.5) / width, (mi.Float(k // width) + 0.5) / height)
    si = scene.ray_intersect(sensor.sample_ray(0, 0, at, mi.Point2f(0.5))[0])
    shape = np.array(dr.reinterpret_array(mi.UInt32, si.shape)).reshape(int(height), int(width))
    ids = {int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(s))[0]): s.id() for s in scene.shapes()}
    shown = [s for s in np.unique(shape) if (shape == s).sum() >= FEW]
    masks = np.array([shape >= 0, *(shape == s for s in shown)])
    return masks, [None, *(ids.get(int(s), "") for s in shown)]


def compare(scene, bias=0.01, shading="gather", depth=-1, aside=None, **budget):
    """Solve and show a scene RUNS times, with other seeds, and as often by `path`; the means must be the same to
    ``bias``, that of all of the picture to half of it, but for what is left to chance at a doubt of DOUBT in all
    (Welch's t, Bonferroni). ``aside``: ids of shapes that are allowed another bias, and theirs.

    Returns the solutions, and the means of both [runs, shapes, 3].
    """
    (masks, names), path = pixels_of_shapes(scene), mi.load_dict({"type": "path", "max_depth": depth})

    def means(image):
        return np.array([np.array(image)[mask][:, :3].mean(axis=0) for mask in masks], dtype=np.float64)

    solutions = [mr.solve(scene, seed=seed, **budget) for seed in range(RUNS)]
    ours = np.array([means(s.render(spp=SPP, shading=shading, seed=seed)) for seed, s in enumerate(solutions)])
    true = np.array([means(mi.render(scene, integrator=path, spp=TRUE_SPP, seed=seed)) for seed in range(RUNS)])
    error = np.hypot(*(x.std(axis=0, ddof=1) / RUNS**0.5 for x in (ours, true)))
    sure = stats.t.ppf(1 - DOUBT / (2 * error.size), RUNS - 1)
    off, want = np.abs(ours.mean(axis=0) - true.mean(axis=0)), true.mean(axis=0)
    biases = {None: bias / 2} | (aside or {})
    allowed = np.array([biases.get(name, bias) for name in names])[:, None]
    assert (off <= allowed * want + sure * error).all(), (ours.mean(axis=0) / want, error / want)
    return solutions, ours, true
