"""Binary glTF, unlit: the light is in the colours of the vertices."""

import os
from typing import Any

import mitsuba as mi
import numpy as np

from ..core.extras import optional
from ..core.files import writing
from ..scene import Model
from .cameras import cameras, up
from .geometry import LitMesh, name_of
from .textures import Texture, png, textures

FLOAT, SHORT, INT = 5126, 5123, 5125  # component types
VERTICES, INDICES = 34962, 34963  # buffer view targets
CLAMP, LINEAR = 33071, 9729  # of samplers


def write_glb(mesh: LitMesh, path: str | os.PathLike[str], model: Model, exposure: float = 1.0) -> None:
    """Write the mesh, a node per shape, turned so that +y is up, and the scene's cameras.

    COLOR_0: radiance times ``exposure``, clipped to [0, 1], linear; where a shape is textured, what its texture, the
    base colour, is multiplied by. _RADIOSITY and _IRRADIANCE: float32, W/m². extras: the exposure.
    """
    file = GltfFile(model.scene)
    file.add_unlit("light in the vertices")
    file.gltf.extras = {"exposure": exposure, "units": "COLOR_0 = exposure * radiance, _RADIOSITY in W/m^2"}
    pictures = textures(mesh, model.faces.parts)
    for shape in np.unique(mesh.shape).tolist():
        name, primitives = name_of(model.faces.parts, shape), []
        for back in (False, True):
            chosen = (mesh.shape == shape) & (mesh.back == back)
            if chosen.any():
                primitives.append(file.primitive(mesh, chosen, pictures.get((shape, back)), exposure))
        file.gltf.meshes.append(file.lib.Mesh(name=name, primitives=primitives))
        file.add_node(name=name, mesh=len(file.gltf.meshes) - 1)
    file.add_cameras(model.scene)
    with writing(path) as temporary:
        file.save(temporary)


class GltfFile:
    """A glTF file that grows: nodes under one that turns the scene so that +y is up."""

    def __init__(self, scene: "mi.Scene") -> None:
        pygltflib = optional("pygltflib", "glTF", "export")
        self.lib, self._bytes = pygltflib, bytearray()
        self.gltf = pygltflib.GLTF2(
            asset=pygltflib.Asset(version="2.0", generator="mi_radiosity"),
            scene=0,
            scenes=[pygltflib.Scene(nodes=[0])],
        )
        self.gltf.nodes.append(pygltflib.Node(name="mi_radiosity", rotation=_upright(up(scene)), children=[]))

    def add_node(self, **parts: Any) -> None:
        """A node of the scene."""
        self.gltf.nodes[0].children.append(len(self.gltf.nodes))
        self.gltf.nodes.append(self.lib.Node(**parts))

    def add_cameras(self, scene: "mi.Scene") -> None:
        """A node for each perspective sensor."""
        for camera in cameras(scene):
            width, height = camera.film.size
            view = self.lib.Perspective(
                aspectRatio=width / height, yfov=float(np.radians(camera.y_fov)), znear=camera.near, zfar=camera.far
            )
            self.gltf.cameras.append(self.lib.Camera(name=camera.name, type="perspective", perspective=view))
            matrix = camera.to_world @ np.diag([-1.0, 1, -1, 1])  # glTF's cameras look along −z
            self.add_node(name=camera.name, camera=len(self.gltf.cameras) - 1, matrix=matrix.T.ravel().tolist())

    def primitive(self, mesh: LitMesh, chosen: np.ndarray, picture: Texture | None, exposure: float) -> Any:
        """Some triangles of a mesh."""
        kept, number = np.unique(mesh.triangles[chosen], return_inverse=True)
        radiosity, material, texcoord = mesh.radiosity[kept], 0, {}
        color = radiosity
        if picture is not None and not mesh.emission[kept].any():  # the light of a lamp has no texture
            white = max(float(picture.image.max()), 1e-6)
            color, material = mesh.irradiance[kept] * white, self._textured(picture.image / white)
            texcoord = {"TEXCOORD_0": self.accessor(picture.place(mesh.uv[kept]).astype("<f4"), FLOAT, "VEC2")}
        color = np.column_stack([np.clip(color / np.pi * exposure, 0, 1), np.ones(len(kept))])
        points = mesh.vertices[kept].astype("<f4")
        attributes = self.lib.Attributes(
            POSITION=self.accessor(points, FLOAT, "VEC3", min=points.min(axis=0), max=points.max(axis=0)),
            COLOR_0=self.accessor(np.round(color * 65535).astype("<u2"), SHORT, "VEC4", normalized=True),
            _RADIOSITY=self.accessor(radiosity.astype("<f4"), FLOAT, "VEC3"),
            _IRRADIANCE=self.accessor(mesh.irradiance[kept].astype("<f4"), FLOAT, "VEC3"),
            **texcoord,
        )
        indices = self.accessor(number.ravel().astype("<u4"), INT, "SCALAR", target=INDICES)
        return self.lib.Primitive(attributes=attributes, indices=indices, material=material)

    def add_material(
        self, name: str, extensions: dict[str, Any], emissive: list[float] | None = None, **pbr: Any
    ) -> int:
        """A matte material; returns its number."""
        base = self.lib.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0, **pbr)
        self.gltf.materials.append(
            self.lib.Material(name=name, pbrMetallicRoughness=base, extensions=extensions, emissiveFactor=emissive)
        )
        self.gltf.extensionsUsed = sorted({*self.gltf.extensionsUsed, *extensions})
        return len(self.gltf.materials) - 1

    def add_unlit(self, name: str, **pbr: Any) -> int:
        """A material shown in its base colour; returns its number."""
        return self.add_material(name, {"KHR_materials_unlit": {}}, **pbr)

    def add_texture(self, data: bytes, mipmaps: bool = True) -> int:
        """A texture of a PNG file, clamped at its edges; returns its number."""
        number = len(self.gltf.textures)
        self.gltf.images.append(self.lib.Image(bufferView=self.view(data), mimeType="image/png"))
        self.gltf.textures.append(self.lib.Texture(source=number, sampler=number))
        filters = {} if mipmaps else {"magFilter": LINEAR, "minFilter": LINEAR}
        self.gltf.samplers.append(self.lib.Sampler(wrapS=CLAMP, wrapT=CLAMP, **filters))
        return number

    def _textured(self, rho):
        number = self.add_texture(png(rho))
        return self.add_unlit(f"texture-{number}", baseColorTexture=self.lib.TextureInfo(index=number))

    def view(self, data: bytes, target: int | None = None) -> int:
        """Bytes of the file; returns the number of the buffer view."""
        self._bytes += bytes(-len(self._bytes) % 4)
        view = self.lib.BufferView(buffer=0, byteOffset=len(self._bytes), byteLength=len(data), target=target)
        self._bytes += data
        self.gltf.bufferViews.append(view)
        return len(self.gltf.bufferViews) - 1

    def accessor(
        self,
        array: np.ndarray,
        component: int,
        kind: str,
        target: int = VERTICES,
        normalized: bool = False,
        **bounds: Any,
    ) -> int:
        """Numbers in the file, one row each; returns the number of the accessor."""
        self.gltf.accessors.append(
            self.lib.Accessor(
                bufferView=self.view(array.tobytes(), target),
                componentType=component,
                count=len(array),
                type=kind,
                normalized=normalized,
                **{name: value.tolist() for name, value in bounds.items()},
            )
        )
        return len(self.gltf.accessors) - 1

    def save(self, path: str) -> None:
        self.gltf.buffers.append(self.lib.Buffer(byteLength=len(self._bytes)))
        self.gltf.set_binary_blob(bytes(self._bytes))
        self.gltf.save_binary(path)


def _upright(above):
    """The rotation (x, y, z, w) that turns the axis ``above`` to +y."""
    cross = np.cross(above, [0.0, 1, 0])
    if above[1] < 0:
        return [1.0, 0.0, 0.0, 0.0]
    quaternion = np.array([*cross, 1 + above[1]])
    return (quaternion / np.linalg.norm(quaternion)).tolist()
