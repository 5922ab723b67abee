"""Textures of shapes as pictures: whatever their reflectance is made of."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned
from ..core.color import srgb8
from ..scene.tessellate import Part
from .geometry import LitMesh

FEWEST, MOST = 512, 2048  # pixels along a side
CELLS = 2, 4  # along a side of a pixel that is the mean of many points: at least, at most
POINTS = 1 << 22  # of a picture, beyond which pixels have as few cells as they may: bounds the work


@dataclass(frozen=True)
class Texture:
    """ρ of a side of a shape over a rectangle of its texture coordinates."""

    image: np.ndarray  # [height, width, 3] ρ, linear; the first row is v = high[1]
    low: np.ndarray  # [2] the coordinates it spans
    high: np.ndarray

    def place(self, uv: np.ndarray) -> np.ndarray:
        """Coordinates of the shape as those of the picture, (0, 0) its upper left corner [n, 2]."""
        share = (uv - self.low) / (self.high - self.low)
        return np.column_stack([share[:, 0], 1 - share[:, 1]])


def png(linear: np.ndarray) -> bytes:
    """Linear values in [0, 1] [height, width, 3] as a PNG file in sRGB."""
    return png8(srgb8(linear))


def png8(values: np.ndarray) -> bytes:
    """Pixels (uint8 [height, width, 3]) as a PNG file."""
    stream = mi.MemoryStream()
    mi.Bitmap(np.ascontiguousarray(values)).write(stream, mi.Bitmap.FileFormat.PNG)
    return bytes(stream.raw_buffer())


def textures(mesh: LitMesh, parts: list[Part]) -> dict[tuple[int, bool], Texture]:
    """The textures of a mesh by shape and side."""
    found, textured = {}, ~np.isnan(mesh.uv[mesh.triangles[:, 0], 0])
    for shape, back in sorted(set(zip(mesh.shape[textured].tolist(), mesh.back[textured].tolist()))):
        part = textured & (mesh.shape == shape) & (mesh.back == back)
        uv = mesh.uv[np.unique(mesh.triangles[part])]
        low, high = uv.min(axis=0), uv.max(axis=0)
        if (high > low).all():
            found[shape, back] = _bake(parts[shape].shape.bsdf(), back, low, high)
    return found


def _bake(bsdf, back, low, high):
    size, sharp = _resolution(bsdf, high - low)
    x, y = (k.ravel() for k in np.meshgrid(*(np.arange(n) for n in size)))
    rho = np.zeros((len(x), 3))
    # A pixel that holds many texels shows their mean: one random point in each of its cells, so that no period of the
    # texture can be in step with the pixels.
    cells = 1 if sharp else int(np.clip((POINTS / len(x)) ** 0.5, *CELLS))
    random = np.random.default_rng(0)
    for column, line in np.ndindex(cells, cells):
        a, b = (0.5, 0.5) if sharp else random.random((2, len(x)))
        right, down = (x + (column + a) / cells) / size[0], (y + (line + b) / cells) / size[1]
        si = dr.zeros(mi.SurfaceInteraction3f, x.size)
        u, v = low[0] + right * (high - low)[0], high[1] - down * (high - low)[1]
        si.uv = mi.Point2f(owned(mi.Float, u), owned(mi.Float, v))
        si.wi = mi.Vector3f(0, 0, -1.0 if back else 1.0)
        rho += np.array(mi.Color3f(bsdf.eval_diffuse_reflectance(si)), dtype=np.float64).T.reshape(-1, 3) / cells**2
    return Texture(rho.reshape(size[1], size[0], 3), low, high)


def _resolution(bsdf, span):
    """Width and height in pixels, those of the largest bitmap in a BSDF, as often as it is repeated, where that is
    possible; and is one point per pixel enough, which is then the middle of a texel, or is in one?"""
    values = dict(mi.traverse(bsdf))
    wanted = [
        np.array(value.shape[1::-1]) * span * _repeats(values.get(name.removesuffix("data") + "to_uv"))
        for name, value in values.items()
        if name.endswith("data") and dr.is_tensor_v(value)
    ]
    most = np.max(wanted, axis=0) if wanted else np.array([np.inf, np.inf])
    size = np.clip(np.ceil(np.where(np.isfinite(most), most, FEWEST)), FEWEST, MOST)
    return tuple(int(n) for n in size), bool((most <= size).all())


def _repeats(to_uv):
    """How often a texture is repeated along both axes by a transform of its coordinates (float [2])."""
    if to_uv is None:
        return np.ones(2)
    return np.abs(np.array(to_uv.matrix, dtype=np.float64)[:2, :2]).max(axis=0)
