"""Textures of shapes as pictures: whatever their reflectance is made of."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import owned
from ..core.color import srgb8
from ..core.errors import warn_of
from ..scene.tessellate import Part, children
from .geometry import LitMesh

FEWEST, MOST = 512, 2048  # pixels along a side
FLAT = 1e-3  # extent of a texture along a coordinate that is the same all over a shape
CELL = 16  # pixels along a cell of a checkerboard, so that its edges are sharp
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
        high = np.where(high > low, high, low + FLAT)
        found[shape, back] = _bake(parts[shape], back, low, high)
    return found


def _bake(part, back, low, high):
    bsdf, wanted = part.shape.bsdf(), np.ceil(_density(part.shape.bsdf()) * (high - low))
    size = tuple(int(n) for n in np.clip(wanted, FEWEST, MOST))
    sharp = bool((wanted <= MOST).all())
    if not sharp:
        need = " x ".join(f"{n:,.0f}" for n in wanted)
        warn_of(f"{part.name}: its texture needs {need} pixels, and has {size[0]:,} x {size[1]:,} in the file")
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


def _density(thing):
    """Pixels per unit of u and v that the textures in a BSDF need: the finest of all (float [2])."""
    finest = np.zeros(2)
    for part in children(thing):
        if isinstance(part, mi.BSDF):
            finest = np.maximum(finest, _density(part))
            continue
        values = dict(mi.traverse(part))
        if "data" in values:
            size = np.array(values["data"].shape[1::-1], dtype=np.float64)
        elif part.class_name() == "Checkerboard":
            size = np.full(2, 2.0 * CELL)  # two cells per unit
        else:
            continue
        if "to_uv" in values:  # columns: where steps of u and v go in the texture
            matrix = np.array(values["to_uv"].matrix, dtype=np.float64).reshape(3, 3, -1)[:2, :2, 0]
            size = np.linalg.norm(matrix * size[:, None], axis=0)
        finest = np.maximum(finest, size)
    return finest
