"""Push and pull: values of leaves and of the elements above them."""

import drjit as dr
import mitsuba as mi

from ..core.arrays import ColorSums, totals


def climb(elements, element, visit, *state):
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


def push(elements, sums, leaves, area):
    """What leaves and their ancestors received, over their ``area`` (Float [elements]): 3 Float64 [leaves]."""

    def add(element, active, *total):
        size = mi.Float64(dr.gather(mi.Float, area, element))
        return tuple(t + x / size for t, x in zip(total, sums.gather(element)))

    return list(climb(elements, leaves, add, *(dr.zeros(mi.Float64, dr.width(leaves)) for _ in range(3))))


def pull(elements, values, area):
    """Area averages, for all elements, of values of the leaves (3 Float64 [leaves] ─► Color3f [elements]).

    area: Float [elements], additive: an element's is the sum of its children's.
    """
    power = [h * mi.Float64(dr.gather(mi.Float, area, elements.leaves)) for h in values]
    sums = sum_up(elements, power, [2 * t for t in totals(power)])
    every = dr.arange(mi.UInt32, len(elements))
    result = mi.Color3f(*(mi.Float(p / mi.Float64(area)) for p in sums.gather(every)))
    dr.eval(result)
    return result


def sum_up(elements, values, bound):
    """Sums of values of the leaves (3 Float64 [leaves]) over all elements, as ColorSums."""
    sums = ColorSums(len(elements), bound)

    def add(element, active):
        sums.add(values, element, active)
        return ()

    climb(elements, elements.leaves, add)
    return sums


def mark(elements, chosen):
    """Which elements are ``chosen`` (UInt32 [n]) or above one of them (Bool [elements])?"""
    marks = dr.zeros(mi.Bool, len(elements))

    def note(element, active):
        dr.scatter(marks, True, element, active)
        return ()

    climb(elements, chosen, note)
    dr.eval(marks)
    return marks
