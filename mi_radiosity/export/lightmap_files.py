"""Lightmaps as files: irradiance in an EXR, or a glTF scene that has it on a second set of coordinates."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from ..core.extras import optional
from ..core.files import check_writable, writing
from ..display import write_image
from ..scene import Model
from ..scene.materials import is_textured
from ..solver import Solution
from .atlas import face_of, is_back
from .cameras import warn_of_lost_cameras
from .geometry import RAISE, dark_faces, name_of, sides_below
from .gltf import FLOAT, INDICES, INT, GltfFile
from .lightmap import SAMPLES, Lightmap, lightmap
from .shown import hidden_parts, warn_of_losses
from .textures import png, png8
from .tone import BRIGHT, checked

SUFFIXES = (".exr", ".glb")
BLACK = 5  # texels along a side of a place that no light is on
UNITS = "MOZ_lightmap: texture * intensity = exposure * irradiance, W/m^2; linear"
CLIPPED = 1e-4  # of the lit area may be brighter than the texture's white


def export_lightmap(
    solution: Solution,
    path: str | os.PathLike[str],
    size: int,
    samples: int = SAMPLES,
    denoise: bool = False,
    unlit: bool = False,
    exposure: float | str = 1.0,
    seed: int = 0,
    progress: Callable[[str, int, int], None] = lambda stage, done, total: None,
    hide_emitters: bool | None = None,
) -> Lightmap:
    """Bake a lightmap of size × size texels and write it: .exr for irradiance, W/m², or .glb for the scene with it.

    unlit: a scene whose texture is exposure × radiance, which every viewer shows, instead of one whose materials have
    the light as `MOZ_lightmap`. exposure: a number, or "auto". samples, denoise, progress: see `lightmap`.
    hide_emitters: leave emitters out of the scene; by default as the scene's own integrator says.
    Raises RadiosityError for another name, for a file that cannot be written, and for an exposure of irradiance (.exr).
    """
    path = Path(path)
    exposure = checked(exposure, path)
    check_target(path, unlit)
    found = lightmap(solution, size, samples, denoise, seed, progress)
    if path.suffix.lower() == ".exr":
        write_image(path, mi.TensorXf(found.irradiance.astype(np.float32)))
        return found
    model = solution.model
    hidden = hidden_parts(model, hide_emitters)
    warn_of_losses(model, set(range(len(model.faces.parts))) - set(hidden), textures=True)
    warn_of_lost_cameras(model.scene, "glTF")
    file = _scene_file(model, found, unlit, _exposure(found, exposure), hidden)
    with writing(path) as temporary:
        file.save(temporary)
    return found


def check_target(path: Path, unlit: bool) -> None:
    """Raise RadiosityError if ``path`` is no file that a lightmap could be written to."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise RadiosityError(f"-o {path}: a lightmap goes into a file that ends in {' or '.join(SUFFIXES)}")
    if unlit and suffix != ".glb":
        raise RadiosityError(f"-o {path}: --unlit belongs to a file that ends in .glb")
    if suffix == ".glb":
        optional("pygltflib", "glTF", "export")
    check_writable(path)


def _exposure(found, exposure):
    """The number itself; for "auto" what brings 98 % of the area that is no lamp below 1."""
    if exposure != "auto":
        return float(exposure)
    level = _brightest(found, found.radiosity, BRIGHT, found.emission.max(axis=2) == 0) / np.pi
    return 1 / level if level > 0 else 1.0


def _brightest(found, values, share, which=True):
    """What a share of the open area does not exceed in any channel."""
    area, most = (found.area * which).ravel(), values.max(axis=2).ravel()
    order = np.argsort(most)
    below = np.cumsum(area[order])
    return float(most[order[np.searchsorted(below, share * below[-1])]])


def _scene_file(model: Model, found: Lightmap, unlit: bool, exposure: float, hidden: list[int]) -> GltfFile:
    file = GltfFile(model.scene)
    light, scale = _picture(found, unlit, exposure)
    texture = file.add_texture(light, mipmaps=False)
    file.gltf.extras = {"exposure": exposure, "units": "texture = exposure * radiance" if unlit else UNITS}
    if unlit:
        materials = _unlit_materials(file, texture)
    else:
        materials = _lit_materials(file, texture, model, found, scale * exposure, exposure)
    patch, face, points, normals, place = _triangles(model, found)
    shape = model.faces.shape[face]
    for number in np.setdiff1d(shape, hidden).tolist():
        name, part, primitives = name_of(model.faces.parts, number), np.flatnonzero(shape == number), []
        for which, material in materials(number, name, patch[part]):
            chosen = part[which]
            primitives.append(_primitive(file, points[chosen], normals[chosen], place[chosen], material))
        file.gltf.meshes.append(file.lib.Mesh(name=name, primitives=primitives))
        file.add_node(name=name, mesh=len(file.gltf.meshes) - 1)
    file.add_cameras(model.scene)
    return file


def _picture(found, unlit, exposure):
    """The light as a PNG file, and what its white stands for."""
    if unlit:
        return png(found.radiosity / np.pi * exposure), 1.0
    white = max(_brightest(found, found.effective, 1 - CLIPPED), 1e-30)
    # Linear light in 8 bits shows bands, unless it is dithered; black stays black.
    dither = np.random.default_rng(0).uniform(-0.5, 0.5, found.effective.shape)
    values = np.clip(found.effective / white, 0, 1) * 255
    return png8(np.round(values + np.where(values > 0, dither, 0)).clip(0, 255).astype(np.uint8)), white


def _unlit_materials(file, texture):
    """One material for all, the picture itself: materials(shape, name, patches) gives (mask, number) pairs."""
    number = file.add_unlit("light", baseColorTexture=file.lib.TextureInfo(index=texture))
    return lambda shape, name, patch: [(np.ones(len(patch), dtype=bool), number)]


def _lit_materials(file, texture, model, found, intensity, exposure):
    """A material for each ρ and E of a shape; the base colour of textured shapes is a texture laid out as the light is.

    materials(shape, name, patches) gives (mask, number) pairs.
    """
    rho, emission = (
        np.array(x, dtype=np.float64).reshape(3, -1).T.round(4) for x in (model.patches.albedo, model.patches.emission)
    )
    colors: list[int] = []

    def base_color(textured, color):
        if not textured:
            return {"baseColorFactor": [*color.tolist(), 1.0]}
        if not colors:
            colors.append(file.add_texture(png(found.albedo), mipmaps=False))
        return {"baseColorTexture": file.lib.TextureInfo(index=colors[0])}

    def materials(shape, name, patch):
        lit = patch >= 0
        textured = lit & is_textured(model.faces.parts[shape].shape.bsdf())
        table = np.where(lit[:, None], np.hstack([rho[patch], emission[patch]]), 0)
        table[textured, :3] = 0
        kinds, kind = np.unique(np.column_stack([textured, table]), axis=0, return_inverse=True)
        for k, (has_texture, *numbers) in enumerate(kinds):
            extensions: dict[str, Any] = {"MOZ_lightmap": {"index": texture, "texCoord": 1, "intensity": intensity}}
            color, E = np.split(np.array(numbers), 2)
            if most := float(E.max()):
                extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": most / np.pi * exposure}
            emissive = (E / most).tolist() if most else None
            yield kind.ravel() == k, file.add_material(name, extensions, emissive, **base_color(has_texture, color))

    return materials


def _triangles(model, found):
    """Patch (−1: none), face, corners, normals and places in the texture of all triangles to be shown."""
    pieces, place = found.atlas.pieces, found.atlas.place / found.atlas.size
    face, back = face_of(model, pieces.patch), is_back(model, pieces.patch)
    points, normals = pieces.points(model), pieces.normals(model)
    flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    size = np.linalg.norm(np.ptp(model.faces.corners.reshape(-1, 3), axis=0))
    points = points + (RAISE * size * sides_below(model, face, back)[:, None] * flat)[:, None]
    dark, black = dark_faces(model), _black_place(found)
    if black is None or not len(dark):
        return pieces.patch, face, points, normals, place
    corners = model.faces.corners[dark]
    corners = np.where(model.faces.flipped[dark][:, None, None], corners[:, ::-1], corners)
    return (
        np.concatenate([pieces.patch, np.full(len(dark), -1)]),
        np.concatenate([face, dark]),
        np.concatenate([points, corners]),
        np.concatenate([normals, np.repeat(model.faces.normal[dark][:, None], 3, axis=1)]),
        np.concatenate([place, np.broadcast_to(black, (len(dark), 3, 2))]),
    )


def _black_place(found):
    """A place of the texture that nothing is on, or None."""
    used = (found.radiosity.max(axis=2) > 0) | (found.area > 0)
    counts = np.pad(used.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    block = counts[BLACK:, BLACK:] - counts[BLACK:, :-BLACK] - counts[:-BLACK, BLACK:] + counts[:-BLACK, :-BLACK]
    free = np.flatnonzero(block.ravel() == 0)
    if not len(free):
        return None
    row, column = np.divmod(free[-1], block.shape[1])
    return (np.array([column, row]) + BLACK / 2) / found.atlas.size


def _primitive(file, points, normals, place, material):
    """Triangles, their corners welded where all of them is the same."""
    rows = np.hstack([x.reshape(-1, x.shape[-1]) for x in (points, normals, place)]).astype("<f4")
    rows, index = np.unique(rows, axis=0, return_inverse=True)
    position, normal, uv = (np.ascontiguousarray(x) for x in np.split(rows, (3, 6), axis=1))
    coordinates = file.accessor(uv, FLOAT, "VEC2")
    attributes = file.lib.Attributes(
        POSITION=file.accessor(position, FLOAT, "VEC3", min=position.min(axis=0), max=position.max(axis=0)),
        NORMAL=file.accessor(normal, FLOAT, "VEC3"),
        TEXCOORD_0=coordinates,  # which readers expect where there is a second set
        TEXCOORD_1=coordinates,
    )
    indices = file.accessor(index.ravel().astype("<u4"), INT, "SCALAR", target=INDICES)
    return file.lib.Primitive(attributes=attributes, indices=indices, material=material)
