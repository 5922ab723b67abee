"""What a scene is like: to notice that it has been edited."""

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import RadiosityError
from .tessellate import parts


class State:
    """The parameters of a scene's shapes, materials and lamps at one moment; cameras may move.

    Keeps Dr.Jit's variables, so that a comparison costs no look at their contents unless they were replaced.
    """

    def __init__(self, scene: "mi.Scene") -> None:
        self._shapes = [shape.ptr for shape in scene.shapes()]
        self._parameters = _parameters(scene)

    def same_as(self, scene: "mi.Scene") -> bool:
        """Is ``scene`` as it was?"""
        if self._shapes != [shape.ptr for shape in scene.shapes()]:
            return False
        now = _parameters(scene)
        return now.keys() == self._parameters.keys() and all(
            _equal(value, now[name]) for name, value in self._parameters.items()
        )


def refuse_gradients(scene: "mi.Scene") -> None:
    """Raise RadiosityError if a parameter of the scene asks for gradients: a solution has none."""
    with dr.resume_grad():  # mi.render suspends them around an integrator
        for (_, name), value in _parameters(scene).items():
            if dr.is_array_v(value) and dr.grad_enabled(value):
                raise RadiosityError(
                    f"'{name}' asks for gradients, which a radiosity solution does not have yet: use 'prb'"
                )


class Parameters:
    """What tells a lamp or a material from others, as it is now: its class, and all of its parameters that Mitsuba
    shows. They are kept as Dr.Jit's variables, and only looked at when their bytes are asked for."""

    def __init__(self, thing: "mi.Object") -> None:
        self._kind = thing.class_name()
        self._values = sorted(((name, _kept(value)) for name, value in mi.traverse(thing)), key=lambda item: item[0])

    def __bytes__(self) -> bytes:
        found = [self._kind.encode()]
        for name, value in self._values:
            number = dr.is_array_v(value) or isinstance(value, (bool, int, float))
            found += [name.encode(), np.array(value if number else value.matrix, dtype=np.float32).tobytes()]
        return b"".join(found)


def _kept(value):
    """A value that stays as it is: Mitsuba's own would change with the scene."""
    return type(value)(value)


def _parameters(scene):
    """{(number, name): value} of everything that decides what is solved."""
    members = {part.shape.ptr: part.shape for part in parts(scene) if part.to_world is not None}
    things = [*scene.shapes(), *members.values(), *scene.emitters()]
    return {
        (number, f"{thing.id() or number}.{name}"): _kept(value)
        for number, thing in enumerate(things)
        for name, value in mi.traverse(thing)
    }


def _equal(a, b):
    if not dr.is_array_v(a) or not dr.is_array_v(b):
        return a is b or a == b
    if type(a) is not type(b) or dr.shape(a) != dr.shape(b):
        return False
    return _indices(a) == _indices(b) or bool(dr.all(a == b, axis=None))


def _indices(value):
    """Numbers of the variables behind an array."""
    if dr.is_tensor_v(value):
        return [value.array.index]
    return [value.index] if dr.depth_v(value) == 1 else [part.index for part in value]
