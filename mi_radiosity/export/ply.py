"""Stanford PLY, binary: colours for viewers, and the light itself."""

import os
from collections.abc import Sequence

import numpy as np

from ..core.color import srgb8
from ..core.files import writing
from .geometry import LitMesh

LIGHT = ("irradiance", "radiosity")


def write_ply(
    mesh: LitMesh, path: str | os.PathLike[str], exposure: float | None = 1.0, comments: Sequence[str] = ()
) -> None:
    """Write the mesh; ``comments`` become lines of the header.

    Vertices have ``irradiance_r/g/b`` and ``radiosity_r/g/b``, W/m², and ``red, green, blue``: sRGB of the radiance
    times ``exposure``, left out if that is None. Faces have the numbers of their leaf and shape.
    """
    names = [*"xyz", *(f"{light}_{c}" for light in LIGHT for c in "rgb")]
    vertex = np.empty(len(mesh.vertices), [(name, "<f4") for name in names] + _colors(exposure))
    columns = np.hstack([mesh.vertices, mesh.irradiance, mesh.radiosity])
    for name, column in zip(names, columns.T):
        vertex[name] = column
    if exposure is not None:
        for name, column in zip(("red", "green", "blue"), srgb8(mesh.radiosity / np.pi * exposure).T):
            vertex[name] = column
    face = np.empty(len(mesh.triangles), [("count", "u1"), ("corner", "<i4", 3), ("leaf", "<i4"), ("shape", "<i4")])
    face["count"], face["corner"], face["leaf"], face["shape"] = 3, mesh.triangles, mesh.leaf, mesh.shape
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment irradiance and radiosity in W/m^2",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(vertex)}",
        *(f"property {'float' if vertex.dtype[name] == '<f4' else 'uchar'} {name}" for name in vertex.dtype.names),
        f"element face {len(face)}",
        "property list uchar int vertex_indices",
        "property int leaf",
        "property int shape",
        "end_header\n",
    ]
    with writing(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(header).encode() + vertex.tobytes() + face.tobytes())


def _colors(exposure):
    return [] if exposure is None else [(name, "u1") for name in ("red", "green", "blue")]
