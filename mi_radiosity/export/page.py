"""One self-contained page to walk through a solution."""

import base64
import html
import json
import os
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import resources
from string import Template
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.arrays import owned_vectors
from ..core.color import LUMENS_PER_WATT, LUMINANCE
from ..core.files import check_writable, writing
from ..core.numbers import whole_number
from ..solver import Solution
from ..solver.layers import Layers
from .cameras import cameras, up, warn_of_lost_cameras
from .geometry import RAISE, LitMesh, lit_mesh, name_of
from .shown import hidden_parts, warn_of_losses, without
from .textures import png, textures
from .tone import checked, exposure_of

GRID = 2**20  # steps that the diagonal of a scene's box is quantised to
KINDS = ("direct", "indirect")  # of layers

Report = Callable[[str, int, int | None], None]


def write_page(
    solution: Solution,
    path: str | os.PathLike[str],
    exposure: float | str = 1.0,
    progress: Report | None = None,
    hide_emitters: bool | None = None,
) -> None:
    """Write the page; it needs no network and no other file.

    exposure: what radiance is multiplied by at first, a number or "auto". progress: called with ("view", done, total).
    hide_emitters: leave emitters out; by default as the scene's own integrator says. Issues a RadiosityWarning for
    everything that the page leaves out.
    Raises RadiosityError if the file cannot be written.
    """
    check_writable(path)
    text = page(solution, exposure, progress, hide_emitters)
    with writing(path) as temporary, open(temporary, "w", encoding="utf-8") as file:
        file.write(text)


@dataclass(frozen=True)
class Frame:
    """A page, as notebooks show it."""

    page: str
    height: int

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe srcdoc="{html.escape(self.page)}" style="{style}"></iframe>'


def view(solution: Solution, exposure: float | str = 1.0, height: int = 480) -> Frame:
    """The page within a notebook, as many pixels high."""
    return Frame(page(solution, exposure), whole_number("height", height))


def page(
    solution: Solution,
    exposure: float | str = 1.0,
    progress: Report | None = None,
    hide_emitters: bool | None = None,
) -> str:
    """The text of the page."""
    report = progress or (lambda stage, done, total: None)
    exposure = checked(exposure)
    report("view", 0, 2)
    mesh = lit_mesh(solution) if solution.layers is None else lit_mesh(solution.relight({}), by_lamp=True)
    mesh = shown = without(mesh, hidden_parts(solution.model, hide_emitters))
    warn_of_losses(solution.model, mesh.shape.tolist(), textures=True)
    warn_of_lost_cameras(solution.model.scene, "the page")
    if solution.layers:
        shown = _dimmed(mesh, solution.layers)
    report("view", 1, 2)
    assets = resources.files(__package__) / "assets"
    template, script, three = (
        (assets / name).read_text(encoding="utf-8") for name in ("view.html", "view.js", "three.min.js")
    )
    lux = LUMENS_PER_WATT * shown.irradiance @ LUMINANCE
    seen = {"exposure": exposure_of(shown, exposure), "most": _round_up(float(np.percentile(lux, 98)))}
    data = json.dumps(_data(solution, mesh) | seen, separators=(",", ":"))
    text = Template(template).substitute(
        title="A walk through the light", data=data.replace("<", "\\u003c"), three=three, script=script
    )
    report("view", 2, 2)
    return text


def _dimmed(mesh: LitMesh, layers: Layers) -> LitMesh:
    """A mesh that has the light of every lamp, lit as a solution is."""
    direct, indirect = np.einsum("lc,vlkc->kvc", layers.scales, mesh.lamps)
    lamp = np.full(len(mesh.vertices), -1)
    lamp[mesh.triangles] = layers.lamps.of_parts[mesh.shape][:, None]
    emission = mesh.emission * np.vstack([layers.scales, np.ones(3)])[lamp]
    through = np.einsum("lc,vlkc->vkc", layers.scales, mesh.through[:, 1:])[:, None]
    return replace(mesh, direct=direct, indirect=indirect, emission=emission, through=through)


def _data(solution: Solution, mesh: LitMesh) -> dict[str, Any]:
    """What view.js reads: arrays of vertices, triangles and leaves, and what there is once."""
    scene, parts, flat = solution.model.scene, solution.model.faces.parts, solution.leaves()
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size = mesh.size
    pictures = textures(mesh, parts)
    order, runs = _runs(mesh, solution, list(pictures))
    layers, light, leaf_light = _layers(solution, mesh)
    through, leaf_through = _through(solution, mesh)
    unit = max(float(max(x.max() for x in (*light, *through, mesh.emission))), 1e-30) / 2**15  # so that halves suffice
    arrays = {
        "places": _packed(np.round((mesh.raised(RAISE * size) - low) / (size / GRID)).clip(0).astype(np.uint32)),
        "triangles": _packed(mesh.triangles[order].astype(np.uint32)),
        "inner": _packed(_inner(mesh)[order], deltas=False),
        "leaf": _packed(np.where(mesh.leaf < 0, len(flat), mesh.leaf)[order, None].astype(np.uint32)),
        "reflectance": _packed(np.round(mesh.reflectance * 65535).astype(np.uint16)),
        "emission": _packed(_halves(mesh.emission / unit)),
    }
    for name, smooth, flat in (("layer", light, leaf_light), ("through", through, leaf_through)):
        for k, (of_vertices, of_leaves) in enumerate(zip(smooth, flat)):
            arrays[f"{name}{k}"] = _packed(_halves(of_vertices / unit))
            arrays[f"leaf_{name}{k}"] = _packed(_halves(np.vstack([of_leaves, np.zeros(3)]) / unit))
    if pictures:
        arrays["uv"] = _packed(np.round(_placed(mesh, pictures) * 65535).astype(np.uint16))
    return {
        "light": unit,
        "luminous": [LUMENS_PER_WATT * w for w in LUMINANCE],
        "layers": layers,
        "lamps": _lamps(solution),
        "parts": runs,
        "textures": [base64.b64encode(png(picture.image)).decode() for picture in pictures.values()],
        "views": _views(scene, low, high),
        "up": up(scene).tolist(),
        "size": size,
        "low": low.tolist(),
        "step": size / GRID,
        "arrays": arrays,
    }


def _lamps(solution):
    """Who can be dimmed, and what their emission is multiplied by at first."""
    layers = solution.layers
    return [{"name": n, "scale": s} for n, s in zip(layers.names, layers.scales.tolist())] if layers else []


def _layers(solution, mesh):
    """What there is of every layer: its name, irradiance of the vertices [vertices, 3] and leaves [leaves, 3]."""
    leaves = np.array(solution.elements.leaves)
    if solution.layers is None:
        of_leaves = [np.array(getattr(solution, kind), dtype=np.float64).reshape(3, -1).T[leaves] for kind in KINDS]
        return [{"name": kind, "kind": kind, "lamp": None} for kind in KINDS], [mesh.direct, mesh.indirect], of_leaves
    every = [(lamp, name, k) for lamp, name in enumerate(solution.layers.names) for k in range(len(KINDS))]
    return (
        [{"name": f"{name}, {KINDS[k]}", "kind": KINDS[k], "lamp": lamp} for lamp, name, k in every],
        [mesh.lamps[:, lamp, k] for lamp, _, k in every],
        [getattr(solution.layers, KINDS[k])[lamp].T[leaves] for lamp, _, k in every],
    )


def _through(solution, mesh):
    """τ H of the other side, of every layer: of vertices [vertices, 3] and leaves [leaves, 3]; none if no face
    transmits."""
    if not solution.scattering.transmits:
        return [], []
    leaves = np.array(solution.elements.leaves)

    def of_leaves(irradiance):
        light = solution.scattering.transmitted(irradiance)
        return np.array(light, dtype=np.float64).reshape(3, -1).T[leaves]

    kinds, layers = range(len(KINDS)), solution.layers
    if layers is None:
        return [mesh.through[:, 0, k] for k in kinds], [of_leaves(getattr(solution, kind)) for kind in KINDS]
    every = [(lamp, k) for lamp in range(len(layers.names)) for k in kinds]
    return (
        [mesh.through[:, 1 + lamp, k] for lamp, k in every],
        [of_leaves(owned_vectors(mi.Color3f, getattr(layers, KINDS[k])[lamp].T)) for lamp, k in every],
    )


def _runs(mesh, solution, textured):
    """The order in which triangles are drawn, and runs of them with one name, lamp and texture."""
    parts, layers = solution.model.faces.parts, solution.layers
    _, first, number = np.unique(2 * mesh.shape + mesh.back, return_index=True, return_inverse=True)
    order, counts = np.argsort(number, kind="stable"), np.bincount(number)
    runs, start = [], 0
    for at, count in zip(first.tolist(), counts.tolist()):
        shape, back = int(mesh.shape[at]), bool(mesh.back[at])
        texture = textured.index((shape, back)) if (shape, back) in textured else None
        lamp = int(layers.lamps.of_parts[shape]) if layers else -1
        run = {"name": name_of(parts, shape), "back": back, "texture": texture, "lamp": None if lamp < 0 else lamp}
        runs.append(run | {"start": 3 * start, "count": 3 * count})
        start += count
    return order, runs


def _inner(mesh):
    """For each triangle, a bit for each side that both its triangles have in one leaf (uint8 [triangles, 1])."""
    _, place = np.unique(np.round(mesh.vertices, 9), axis=0, return_inverse=True)
    corner = place.reshape(-1)[mesh.triangles]
    bits = np.zeros(len(corner), dtype=np.uint8)
    ends = np.stack([np.sort(corner[:, [k - 2, k - 1]], axis=1) for k in range(3)], axis=1).reshape(-1, 2)
    key = (ends[:, 0] << 32) | ends[:, 1]
    order = np.lexsort([key, np.repeat(mesh.leaf, 3)])
    same = (key[order][1:] == key[order][:-1]) & (np.diff(np.repeat(mesh.leaf, 3)[order]) == 0)
    for side in (order[1:][same], order[:-1][same]):
        np.bitwise_or.at(bits, side // 3, (1 << (side % 3)).astype(np.uint8))
    return bits[:, None]


def _placed(mesh, pictures):
    """Coordinates of vertices on the pictures of their shapes, 0 without one [vertices, 2]."""
    placed = np.zeros((len(mesh.vertices), 2))
    for (shape, back), picture in pictures.items():
        kept = np.unique(mesh.triangles[(mesh.shape == shape) & (mesh.back == back)])
        placed[kept] = picture.place(mesh.uv[kept])
    return np.clip(placed, 0, 1)


def _views(scene, low, high):
    """Where one can stand at first: the scene's sensors, or outside of it."""
    views = [
        {"name": c.name, "fov": c.y_fov, "matrix": (c.to_world @ np.diag([-1.0, 1, -1, 1])).ravel().tolist()}
        for c in cameras(scene)
    ]
    if views:
        return views
    matrix = np.eye(4)
    matrix[:3, 3] = (low + high) / 2 + [0, 0, 1.5 * np.linalg.norm(high - low)]
    return [{"name": "outside", "fov": 45.0, "matrix": matrix.ravel().tolist()}]


def _halves(values):
    """float16 of which the last two bits are rounded away, as uint16: 0.2 % is less than the noise."""
    bits = np.clip(values, 0, 60000).astype(np.float16).view(np.uint16)
    return (bits.astype(np.uint32) + 2 & 0xFFFC).astype(np.uint16)


def _packed(array, deltas=True):
    """An array of unsigned integers [rows, items] for JSON: differences from row to row, byte by byte, deflated."""
    size, items = array.dtype.itemsize, array.shape[1]
    if deltas:
        signed = np.diff(array.astype(np.int64), axis=0, prepend=0)
        signed = (signed + 2 ** (8 * size - 1)) % 2 ** (8 * size) - 2 ** (8 * size - 1)
        array = (np.where(signed < 0, -2 * signed - 1, 2 * signed)).astype(array.dtype)
    planes = np.ascontiguousarray(array).view(np.uint8).reshape(-1, size).T
    data = base64.b64encode(zlib.compress(planes.tobytes(), 9)).decode()
    return {"size": size, "items": items, "deltas": deltas, "data": data}


def _round_up(value):
    """The next of 1, 2, 5, 10, 20, … that is not below ``value``."""
    decade = 10.0 ** np.floor(np.log10(max(value, 1e-6)))
    return float(next(m * decade for m in (1, 2, 5, 10) if m * decade >= value * 0.999))
