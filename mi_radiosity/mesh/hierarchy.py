"""Push and pull: values of leaves and of the elements above them."""

from collections.abc import Callable, Sequence
from typing import Protocol

import drjit as dr
import mitsuba as mi

from ..core.arrays import ColorSums, totals
from .elements import Elements


class Sums(Protocol):
    """Sums by element: a Tally, or ColorSums."""

    def gather(self, index: "mi.UInt32") -> "list[mi.Float64]":
        """The sums of elements (3 Float64 [n])."""
        ...


def climb(elements: Elements, element: "mi.UInt32", visit: Callable, *state: "dr.ArrayBase") -> tuple:
    """state = visit(element, active, *state) for elements (UInt32 [n]) and all their ancestors; returns it.

    ``active`` says which of the n are still on their way (Bool).
    """

    def step(element, active, *state):
        state = visit(element, active, *state)
        parent = dr.gather(mi.UInt32, elements.parent, element)
        return (parent, active & (parent != element), *state)

    if dr.width(element) == 0:
        return state
    start = (mi.UInt32(element), dr.full(mi.Bool, True, dr.width(element)), *state)
    return dr.while_loop(start, lambda element, active, *state: active, step)[2:]


def push(elements: Elements, sums: Sums, leaves: "mi.UInt32", area: "mi.Float") -> "list[mi.Float64]":
    """What leaves and their ancestors received, over their ``area`` (Float [elements]): 3 Float64 [leaves]."""

    def add(element, active, *total):
        size = mi.Float64(dr.gather(mi.Float, area, element))
        return tuple(t + x / size for t, x in zip(total, sums.gather(element)))

    return list(climb(elements, leaves, add, *(dr.zeros(mi.Float64, dr.width(leaves)) for _ in range(3))))


def pull(elements: Elements, values: "Sequence[mi.Float64]", area: "mi.Float") -> "mi.Color3f":
    """Area averages, for all elements, of values of the leaves (3 Float64 [leaves] ─► Color3f [elements]).

    area: Float [elements], additive: an element's is the sum of its children's.
    """
    power = [h * mi.Float64(dr.gather(mi.Float, area, elements.leaves)) for h in values]
    sums = sum_up(elements, power, [2 * t for t in totals(power)])
    every = dr.arange(mi.UInt32, len(elements))
    result = mi.Color3f(*(mi.Float(p / mi.Float64(area)) for p in sums.gather(every)))
    dr.eval(result)
    return result


def sum_up(elements: Elements, values: "Sequence[mi.Float64]", bound: Sequence[float]) -> ColorSums:
    """Sums of values of the leaves (3 Float64 [leaves]) over all elements, as ColorSums."""
    sums = ColorSums(len(elements), bound)

    def add(element, active):
        sums.add(values, element, active)
        return ()

    climb(elements, elements.leaves, add)
    return sums


def mark(elements: Elements, chosen: "mi.UInt32") -> "mi.Bool":
    """Which elements are ``chosen`` (UInt32 [n]) or above one of them (Bool [elements])?"""
    marks = dr.zeros(mi.Bool, len(elements))

    def note(element, active):
        dr.scatter(marks, True, element, active)
        return ()

    climb(elements, chosen, note)
    dr.eval(marks)
    return marks
