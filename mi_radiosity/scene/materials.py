"""Reflectances of the faces, and what of a Mitsuba scene is modelled at all."""

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arrays import opaque_index, owned
from ..core.errors import RadiosityError
from ..core.points import Stream, kronecker, permuted, stream_seed, triangle
from .averages import Averages
from .faces import Faces
from .lights import LIGHTS
from .lobes import is_sound
from .tessellate import UNMESHED, Part, children, parts

DIFFUSE = {"SmoothDiffuse"}
NESTING = {"TwoSidedBRDF", "BlendBSDF"}
OVER_UV = ("BitmapTexture", "Checkerboard", "RawConstant")  # beginnings of the classes of textures over (u, v)
CONSTANT = {"SRGBReflectanceSpectrum", "UniformSpectrum", "SRGBEmitterSpectrum", "D65Spectrum"}
GLASS = {"SmoothDielectric", "RoughDielectric", "ThinDielectric"}
FRAMES = {"NormalMap", "BumpMap"}
LOBES, BENT = 1, 2  # flags of faces
WHITEST, ROUNDING, MODEL_ERROR = 0.999, 1e-4, 0.1
SOLID_SAMPLES = 1 << 15  # for the albedo of a shape
LEAST = 1 << 6  # samples of a face of a textured shape, if there are many; SOLID_SAMPLES if there are few
MANY = 1 << 20  # samples of all such faces: bounds the work
AT_ONCE = 1 << 22  # samples in one launch


class Materials:
    """What the faces are made of: ``rho`` [2 sides, faces, 3], the albedo of the diffuse lobe, ``two_sided`` [faces],
    ``varies`` (UInt32 [faces]: 1 where ρ of a diffuse BSDF is textured), ``textured`` (does any vary?), and which
    shapes have other lobes, which are ``traced`` [shapes]. ``bsdfs`` [shapes]: Mitsuba's. ``bent`` [faces]: shading
    normals, of vertices or of a map, are far from the geometric one. ``mixed``: some surfaces have a diffuse lobe and
    others.

    ``tau`` [2 sides, faces, 3]: diffuse transmittance, the share of the irradiance of a side that leaves diffusely from
    the other side. ``transmits`` [faces]: which faces have a diffuse transmittance greater than 0.

    Raises RadiosityError for reflectances that conserve no energy, naming the shape.
    """

    def __init__(self, faces: Faces) -> None:
        self._faces = faces
        shapes = faces.tracing.shapes()
        two_sided = np.array([mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.BackSide) for s in shapes])
        self.two_sided = two_sided[faces.shape]
        textured = np.array([is_textured(s.bsdf()) for s in shapes])
        self.traced = np.array([not is_diffuse(s.bsdf()) for s in shapes])
        self._alike = np.array([has_like_sides(s.bsdf()) for s in shapes])
        self.bsdfs = mi.BSDFPtr([s.bsdf() for s in shapes])
        bent_frames = np.array([has_bent_frames(s.bsdf()) for s in shapes])
        self.bent = faces.bent | bent_frames[faces.shape]
        # 0: plainly diffuse.
        self._kind = owned(mi.UInt32, LOBES * self.traced[faces.shape] | BENT * self.bent)
        self.all_plain = not (self.traced.any() or self.bent.any())
        transmits = np.array([mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Transmission) for s in shapes])
        self._transmitting_faces = owned(mi.UInt32, transmits[faces.shape])
        self.textured = bool((textured & ~self.traced).any())
        self.rho, self.tau = np.zeros((2, len(faces), 3)), np.zeros((2, len(faces), 3))
        plain = np.flatnonzero(~self.traced[faces.shape])
        varies = (textured & ~self.traced)[faces.shape]
        self._averages, self.varies = Averages(faces, varies), owned(mi.UInt32, varies)
        if len(plain):
            face, n = owned(mi.UInt32, plain), len(plain)
            zero, one = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n)
            for rho, back in zip(self.rho, (False, True)):
                mean = self.mean_reflectance(face, dr.full(mi.Bool, back, n), zero, zero, one)
                rho[plain] = np.array(mean, dtype=np.float64).reshape(3, n).T
        self._transmits = np.array(
            [mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.DiffuseTransmission) for s in shapes], dtype=bool
        )
        self._find_albedos(textured)
        nulls = np.array([mi.has_flag(s.bsdf().flags(), mi.BSDFFlags.Null) for s in shapes])
        self._find_opacities(np.flatnonzero((nulls & textured)[faces.shape]))
        albedo = self.rho + self.tau
        faces.refuse(~np.isfinite(albedo).all(axis=(0, 2)), "has a reflectance that is not a number: repair its BSDF")
        # Some of Mitsuba's own models send out a few per cent too much, such as a white `principledthin`.
        most = np.where(self.traced[faces.shape], MODEL_ERROR, ROUNDING)[:, None] + 1
        faces.refuse(
            (albedo > most).any(axis=(0, 2)),
            "has a reflectance of more than 1, which makes energy from nothing: make it less than 1",
        )
        tinted = [part.shape.interior_medium() is not None for part in faces.parts]
        if any(tinted):
            where = faces.names(np.array(tinted)[faces.shape])
            faces.warnings.append(f"{where}: the medium inside the glass is not modelled, and taken to be clear")
        white = albedo > WHITEST
        if white.any():
            where = faces.names(np.asarray(white.any(axis=(0, 2))))
            faces.warnings.append(f"{where}: a reflectance of 1 keeps light for ever, and is taken to be {WHITEST}")
            self.tau = np.minimum(self.tau, WHITEST)
            self.rho = np.minimum(self.rho, WHITEST - self.tau)
        self.transmits = self.tau.any(axis=(0, 2))
        albedo = self.rho + self.tau
        # Are there surfaces with a diffuse lobe and others?
        self.mixed = bool((self.bent | (self.traced[faces.shape] & albedo.any(axis=(0, 2)))).any())
        negative = ((self.rho < 0) | (self.tau < 0)).any(axis=(0, 2))
        faces.refuse(negative, "has a negative reflectance: make it 0 or more")

    def mean_reflectance(
        self, face: "mi.UInt32", back: "mi.Bool", u0: "mi.Float", v0: "mi.Float", scale: "mi.Float"
    ) -> "mi.Color3f":
        """ρ averaged over triangles (u0 + scale a, v0 + scale b) of diffuse faces, on the back side where ``back``
        (see `Averages`). Returns Color3f [n]."""
        return self._averages.mean(self.reflectance_at, face, back, u0, v0, scale)

    def is_traced(self, face: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.Bool":
        """Are faces not plainly diffuse, so that paths evaluate their BSDF (Bool [n])?"""
        if self.all_plain:
            return mi.Bool(False)
        return dr.gather(mi.UInt32, self._kind, face, active) != 0

    def is_bent(self, face: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.Bool":
        """Are the shading normals of faces far from the geometric one (Bool [n])?"""
        if self.all_plain:
            return mi.Bool(False)
        return (dr.gather(mi.UInt32, self._kind, face, active) & BENT) != 0

    def has_lobes(self, face: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.Bool":
        """Have faces lobes other than a diffuse one (Bool [n])?"""
        if self.all_plain:
            return mi.Bool(False)
        return (dr.gather(mi.UInt32, self._kind, face, active) & LOBES) != 0

    def arrays(self) -> list:
        """What `is_traced` and `is_bent` read, and Mitsuba's BSDFs."""
        return [self._kind, self.bsdfs]

    def is_transmitting(self, face: "mi.UInt32", active: "mi.Bool | bool" = True) -> "mi.Bool":
        """Do faces have lobes that transmit light (Bool [n])?"""
        return dr.gather(mi.UInt32, self._transmitting_faces, face, active) != 0

    def _find_opacities(self, faces):
        """The mean opacity of faces whose null lobe is textured, and 0 for all others, which need none."""
        self._opacity, n = None, len(faces)
        if n == 0:
            return
        varies = np.zeros(len(self._faces), dtype=bool)
        varies[faces] = True

        def opacity(face, u, v, back):
            si = self._faces.surface(face, u, v)
            return 1 - mi.Color3f(si.bsdf().eval_null_transmission(si))

        zero, one, no = dr.zeros(mi.Float, n), dr.full(mi.Float, 1, n), dr.full(mi.Bool, False, n)
        mean = Averages(self._faces, varies).mean(opacity, owned(mi.UInt32, faces), no, zero, zero, one)
        self._opacity = dr.zeros(mi.Float, len(self._faces))
        dr.scatter(self._opacity, dr.mean(mean), owned(mi.UInt32, faces))
        dr.eval(self._opacity)

    def relative_opacity(self, si: "mi.SurfaceInteraction3f", face: "mi.UInt32", active: "mi.Bool") -> "mi.Float":
        """Opacity at points over its mean on the face (Float [n]): what ρ and τ of masks vary with. 1 where it is the
        same everywhere."""
        if self._opacity is None:
            return mi.Float(1)
        mean = dr.gather(mi.Float, self._opacity, face, active)
        here = 1 - dr.mean(mi.Color3f(si.bsdf().eval_null_transmission(si, active)))
        return dr.select(mean > 0, dr.maximum(here, 0) / dr.maximum(mean, 1e-6), 1)

    def _find_albedos(self, textured):
        """ρ and τ of shapes whose other lobes are traced: once per shape, or per face where they vary."""
        shape = self._faces.shape
        first = np.searchsorted(shape, np.arange(len(self.traced)))
        solid = np.flatnonzero(self.traced & ~textured & np.isin(np.arange(len(self.traced)), shape))
        various = np.flatnonzero((self.traced & textured)[shape])
        each = max(LEAST, min(SOLID_SAMPLES, MANY // max(len(various), 1)))
        for faces, samples, spread in ((first[solid], SOLID_SAMPLES, True), (various, each, False)):
            for part in np.array_split(faces, len(faces) * samples // AT_ONCE + 1):
                for side, (rho, tau) in enumerate(self._albedos(part, samples)):
                    for table, values in ((self.rho[side], rho), (self.tau[side], tau)):
                        if spread:
                            for face, value in zip(part, values):
                                table[shape == shape[face]] = value
                        else:
                            table[part] = values

    def _albedos(self, faces, samples):
        """ρ and τ of BSDFs on both sides of faces ([2 sides, 2, faces, 3])."""
        front = self._albedo(faces, samples, 1)
        alike = self._alike[self._faces.shape[faces]]
        back, other = np.where(alike[:, None], front, 0), self.two_sided[faces] & ~alike
        back[:, other] = self._albedo(faces[other], samples, -1)
        return front, back

    def _albedo(self, faces, samples, side):
        """E[w; diffuse, reflected] and E[w; diffuse, transmitted] of BSDFs on the front of faces, or on the back if
        ``side`` is −1: at random points, for cosine-distributed directions ([2, faces, 3])."""
        found = np.zeros((2, len(faces), 3))
        if not len(faces):
            return found
        each = opaque_index(samples)
        k = dr.arange(mi.UInt32, len(faces) * samples)
        face = dr.gather(mi.UInt32, owned(mi.UInt32, faces), k // each)
        key = owned(mi.UInt32, self._faces.rank[faces])  # not Mitsuba's number of the face, which varies
        _, _, s, t = kronecker(k % each, key, opaque_index(stream_seed(0, Stream.ALBEDO)), k // each)
        # Points in an order of their own: in the order of directions and lobes, a lobe would see some places only.
        at = permuted(k % each, each, opaque_index(stream_seed(0, Stream.ALBEDO, 2)))
        x, y, _, _ = kronecker(at, key, opaque_index(stream_seed(0, Stream.ALBEDO, 3)), k // each)
        a, b, c, _ = kronecker(k % each, key, opaque_index(stream_seed(0, Stream.ALBEDO, 1)), k // each)
        si = self._faces.surface(face, *triangle(x, y))
        wi = mi.warp.square_to_cosine_hemisphere(mi.Point2f(s, t))
        si.wi = mi.Vector3f(wi.x, wi.y, wi.z * side)
        sample, value = si.bsdf().sample(mi.BSDFContext(), si, a, mi.Point2f(b, c))
        kinds = [mi.BSDFFlags.DiffuseReflection]
        if self._transmits[self._faces.shape[faces]].any():
            kinds.append(mi.BSDFFlags.DiffuseTransmission)
        sound = is_sound(si, sample, value)
        lobes = [dr.select(mi.has_flag(sample.sampled_type, kind) & sound, value, 0) for kind in kinds]
        dr.eval(lobes)  # in one go: sums one by one would draw all again
        for total, lobe in zip(found, lobes):
            total[:] = np.array([dr.block_sum(x, samples) for x in lobe], dtype=np.float64).T / samples
        return found

    def reflectance_at(self, face: "mi.UInt32", u: "mi.Float", v: "mi.Float", back: "mi.Bool") -> "mi.Color3f":
        """ρ at points of faces, on the back side where ``back`` (Bool). Returns Color3f [n]."""
        si = self._faces.surface(face, u, v)
        si.wi = mi.Vector3f(0, 0, dr.select(back, -1.0, 1.0))
        return mi.Color3f(si.bsdf().eval_diffuse_reflectance(si))


# ---- What is modelled ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Finding:
    """One part of a scene that is not modelled."""

    what: str  # "shape 'ball' (Sphere)"
    why: str  # what is wrong and what to do


def is_diffuse(bsdf: "mi.BSDF") -> bool:
    """Is ``bsdf`` made of diffuse lobes that reflect, and of nothing else?"""
    kind = bsdf.class_name()
    if kind in NESTING:
        return all(is_diffuse(part) for part in children(bsdf) if isinstance(part, mi.BSDF))
    return kind in DIFFUSE


def has_bent_frames(bsdf: "mi.BSDF") -> bool:
    """Does ``bsdf`` contain a normal map or a bump map?"""
    return bsdf.class_name() in FRAMES or any(has_bent_frames(b) for b in children(bsdf) if isinstance(b, mi.BSDF))


def has_like_sides(bsdf: "mi.BSDF") -> bool:
    """Is ``bsdf`` one that is wrapped, to be the same on both sides of a surface?"""
    return bsdf.class_name() == "TwoSidedBRDF" and len({part.ptr for part in children(bsdf)}) == 1


def is_textured(bsdf: "mi.BSDF") -> bool:
    """Does the reflectance of ``bsdf`` vary over a surface?"""
    return any(
        is_textured(part) if isinstance(part, mi.BSDF) else part.class_name() not in CONSTANT for part in children(bsdf)
    )


def textures_of(bsdf: "mi.BSDF") -> list[str]:
    """Classes of the textures that a BSDF and those in it are made of, without constant ones."""
    found = []
    for part in children(bsdf):
        if isinstance(part, mi.BSDF):
            found += textures_of(part)
        elif part.class_name() not in CONSTANT:
            found.append(part.class_name())
    return found


def varies_over_uv(bsdf: "mi.BSDF") -> bool:
    """Does the reflectance of ``bsdf`` vary with texture coordinates, and with nothing else?

    Colours of vertices and faces, and textures in space, vary with more than those.
    """
    names = textures_of(bsdf)
    return bool(names) and all(name.startswith(OVER_UV) for name in names)


def _inspect_shape(shape):
    """What is wrong with a shape that is no mesh."""
    if shape.class_name() == "Instance":
        yield "its shape group is not found: give the group an id, in the scene itself, and refer to it"
    elif shape.class_name() in UNMESHED:
        yield f"{UNMESHED[shape.class_name()]} are not modelled: export it as a mesh"
    else:
        yield "shapes of this kind are not modelled: export it as a mesh"


def is_glass(shape: "mi.Shape") -> bool:
    """Is ``shape`` of glass, so that a medium inside tints it, and no ray is lost in it for want of the medium?"""
    return shape.bsdf().class_name() in GLASS


def inspect_part(part: Part) -> Iterator[str]:
    """What is wrong with a part of a scene."""
    shape = part.shape
    if not part.can_mesh:
        yield from _inspect_shape(shape)
        return
    if (shape.interior_medium() is not None and not is_glass(shape)) or shape.exterior_medium() is not None:
        yield "participating media are not modelled: remove the medium"
    if shape.is_emitter() and shape.emitter().get_medium() is not None:
        yield "its emitter is in a medium, and those are not modelled: remove the medium"
    if kind := _unreadable(shape.bsdf()):
        yield f"Mitsuba cannot list the parameters of its BSDF '{kind}', so it is not modelled: use another one"


def _unreadable(bsdf):
    """The class of the first of the nested BSDFs with a parameter that is None, such as Hair, or None."""
    for part in children(bsdf):
        if isinstance(part, mi.BSDF) and (kind := _unreadable(part)):
            return kind
    try:
        dict(mi.traverse(bsdf))
    except TypeError:
        return bsdf.class_name()
    return None


def inspect_emitter(emitter: "mi.Emitter") -> Iterator[str]:
    """What is wrong with an emitter."""
    if emitter.class_name() not in LIGHTS:
        yield f"emitters of this kind are not modelled: use one of {', '.join(LIGHTS)}"
    elif refusal := LIGHTS.find(emitter.class_name()).refusal(emitter):
        yield refusal


def inspect(scene: "mi.Scene") -> list[Finding]:
    """List everything in ``scene`` that the solver does not model."""
    findings = []
    for part in parts(scene):
        findings += [Finding(f"{part.name} ({part.shape.class_name()})", why) for why in inspect_part(part)]
    for index, emitter in enumerate(scene.emitters()):
        what = f"emitter '{emitter.id() or index}' ({emitter.class_name()})"
        findings += [Finding(what, why) for why in inspect_emitter(emitter)]
    return findings


def require_supported(scene: "mi.Scene") -> None:
    """Raise RadiosityError, naming the first part of ``scene`` that is not modelled."""
    findings = inspect(scene)
    if findings:
        more = f" (and {len(findings) - 1} more: see `mi-radiosity info`)" if len(findings) > 1 else ""
        raise RadiosityError(f"{findings[0].what}: {findings[0].why}{more}")
