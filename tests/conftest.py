import mi_radiosity  # noqa: F401  chooses LLVM before drjit loads
import mitsuba as mi
import numpy as np
import pytest

mi.set_variant("llvm_ad_rgb")
mi.set_log_level(mi.LogLevel.Error)


@pytest.fixture(scope="session")
def cornell():
    return mi.load_dict(mi.cornell_box())


def scene(**shapes):
    """A scene of shapes given as dictionaries, with a small camera."""
    camera = {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]), "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb"}}
    return mi.load_dict({"type": "scene", "camera": camera, **shapes})


def diffuse(reflectance=0.5, two_sided=False):
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": reflectance}}
    return {"type": "twosided", "bsdf": bsdf} if two_sided else bsdf


def lamp(exitance=1.0):
    """An area emitter of E = ``exitance`` W/m² per channel."""
    return {"type": "area", "radiance": {"type": "rgb", "value": exitance / np.pi}}


def rectangle(to_world=None, **parts):
    return {"type": "rectangle", "to_world": to_world or mi.ScalarTransform4f(), **parts}


def leaf_values(solution, name="radiosity"):
    """(values [leaves, 3], areas [leaves], patches [leaves]) of a solution's leaves as NumPy arrays."""
    leaves = np.flatnonzero(np.array(solution.elements.child) == 0)
    values = np.array(getattr(solution, name)()).reshape(3, -1).T[leaves]
    return values, np.array(solution.elements.area)[leaves], np.array(solution.elements.patch)[leaves]
