"""Binary glTF, unlit: the light is in the colours of the vertices."""

import os

import numpy as np

from ..core.errors import RadiosityError
from ..core.files import writing
from ..scene import Model
from .cameras import cameras, up
from .geometry import LitMesh, name_of
from .textures import png, textures

FLOAT, SHORT, INT = 5126, 5123, 5125  # component types
VERTICES, INDICES = 34962, 34963  # buffer view targets


def write_glb(mesh: LitMesh, path: str | os.PathLike[str], model: Model, exposure: float = 1.0) -> None:
    """Write the mesh, a node per shape, turned so that +y is up, and the scene's cameras.

    COLOR_0: radiance times ``exposure``, clipped to [0, 1], linear; where a shape is textured, what its texture, the
    base colour, is multiplied by. _RADIOSITY and _IRRADIANCE: float32, W/m². extras: the exposure.
    """
    file = _File()
    root = file.gltf.nodes
    root.append(file.lib.Node(name="mi_radiosity", rotation=_upright(up(model.scene)), children=[]))
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
    for camera in cameras(model.scene):
        width, height = camera.size
        view = file.lib.Perspective(
            aspectRatio=width / height, yfov=float(np.radians(camera.y_fov)), znear=camera.near, zfar=camera.far
        )
        file.gltf.cameras.append(file.lib.Camera(name=camera.name, type="perspective", perspective=view))
        matrix = camera.to_world @ np.diag([-1.0, 1, -1, 1])  # glTF's cameras look along −z
        file.add_node(name=camera.name, camera=len(file.gltf.cameras) - 1, matrix=matrix.T.ravel().tolist())
    with writing(path) as temporary:
        file.save(temporary)


class _File:
    """A glTF file that grows."""

    def __init__(self) -> None:
        try:
            import pygltflib
        except ImportError:
            raise RadiosityError("glTF needs the library pygltflib: pip install 'mi_radiosity[export]'") from None
        self.lib, self._bytes = pygltflib, bytearray()
        self.gltf = pygltflib.GLTF2(
            asset=pygltflib.Asset(version="2.0", generator="mi_radiosity"),
            scene=0,
            scenes=[pygltflib.Scene(nodes=[0])],
            extensionsUsed=["KHR_materials_unlit"],
        )
        self.gltf.materials.append(self._unlit("light in the vertices"))

    def add_node(self, **parts):
        self.gltf.nodes[0].children.append(len(self.gltf.nodes))
        self.gltf.nodes.append(self.lib.Node(**parts))

    def primitive(self, mesh, chosen, picture, exposure):
        """Some triangles of a mesh."""
        kept, number = np.unique(mesh.triangles[chosen], return_inverse=True)
        radiosity, material, texcoord = mesh.radiosity[kept], 0, {}
        color = radiosity
        if picture is not None and not mesh.emission[kept].any():  # the light of a lamp has no texture
            white = max(float(picture.image.max()), 1e-6)
            color, material = mesh.irradiance[kept] * white, self._textured(picture.image / white)
            texcoord = {"TEXCOORD_0": self._accessor(picture.place(mesh.uv[kept]).astype("<f4"), FLOAT, "VEC2")}
        color = np.column_stack([np.clip(color / np.pi * exposure, 0, 1), np.ones(len(kept))])
        points = mesh.vertices[kept].astype("<f4")
        attributes = self.lib.Attributes(
            POSITION=self._accessor(points, FLOAT, "VEC3", min=points.min(axis=0), max=points.max(axis=0)),
            COLOR_0=self._accessor(np.round(color * 65535).astype("<u2"), SHORT, "VEC4", normalized=True),
            _RADIOSITY=self._accessor(radiosity.astype("<f4"), FLOAT, "VEC3"),
            _IRRADIANCE=self._accessor(mesh.irradiance[kept].astype("<f4"), FLOAT, "VEC3"),
            **texcoord,
        )
        indices = self._accessor(number.ravel().astype("<u4"), INT, "SCALAR", target=INDICES)
        return self.lib.Primitive(attributes=attributes, indices=indices, material=material)

    def _unlit(self, name, **parts):
        pbr = self.lib.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0, **parts)
        return self.lib.Material(name=name, pbrMetallicRoughness=pbr, extensions={"KHR_materials_unlit": {}})

    def _textured(self, rho):
        number = len(self.gltf.textures)
        self.gltf.images.append(self.lib.Image(bufferView=self._view(png(rho)), mimeType="image/png"))
        self.gltf.textures.append(self.lib.Texture(source=number, sampler=0))
        if number == 0:
            self.gltf.samplers.append(self.lib.Sampler(wrapS=33071, wrapT=33071))
        self.gltf.materials.append(
            self._unlit(f"texture-{number}", baseColorTexture=self.lib.TextureInfo(index=number))
        )
        return len(self.gltf.materials) - 1

    def _view(self, data, target=None):
        self._bytes += bytes(-len(self._bytes) % 4)
        view = self.lib.BufferView(buffer=0, byteOffset=len(self._bytes), byteLength=len(data), target=target)
        self._bytes += data
        self.gltf.bufferViews.append(view)
        return len(self.gltf.bufferViews) - 1

    def _accessor(self, array, component, kind, target=VERTICES, normalized=False, **bounds):
        self.gltf.accessors.append(
            self.lib.Accessor(
                bufferView=self._view(array.tobytes(), target),
                componentType=component,
                count=len(array),
                type=kind,
                normalized=normalized,
                **{name: value.tolist() for name, value in bounds.items()},
            )
        )
        return len(self.gltf.accessors) - 1

    def save(self, path):
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
