"""Numbers that callers and command lines give: any numeric type, checked in one place.

Studies take budgets and seeds from NumPy arrays. Dr.Jit and JSON accept Python numbers only, so that every public
function converts its numbers here before it uses them.
"""

import math
import operator
from typing import Any

import numpy as np

from .errors import RadiosityError


def whole_number(name: str, value: Any, least: int | None = 1) -> int:
    """``value`` as a Python int: of Python's and NumPy's integers, and of floats without a fraction, such as 1e3.

    name: what messages call the number. least: the smallest value allowed, None for any.
    Raises RadiosityError for all other values (fractions, NaN, infinity, bool, text) and for smaller ones.
    """
    number = _integer(value)
    if number is None or (least is not None and number < least):
        raise RadiosityError(f"{name} must be {_kind('a whole number', least)}, not {value!s}")
    return number


def real_number(name: str, value: Any, least: float | None = None) -> float:
    """``value`` as a Python float: of Python's and NumPy's integers and floats.

    name: what messages call the number. least: the number must be greater than this; None for any finite number.
    Raises RadiosityError for all other values (NaN, infinity, bool, text) and for numbers that are too small.
    """
    number = _scalar(value)
    finite = isinstance(number, int | float) and math.isfinite(number)
    if not finite or (least is not None and number <= least):
        wanted = "a finite number" if least is None else f"a number greater than {least:g}"
        raise RadiosityError(f"{name} must be {wanted}, not {value!s}")
    return float(number)


def _kind(what, least):
    return what if least is None else f"{what} greater than {least - 1}" if least == 1 else f"{what}, {least} or more"


def _integer(value):
    """The int that a value stands for, or None."""
    number = _scalar(value)
    if isinstance(number, float):
        return int(number) if number.is_integer() else None
    return number


def _scalar(value):
    """The Python int or float of a number or of an array with one entry and no dimension; None for anything else."""
    if isinstance(value, bool | np.bool_ | str | bytes):
        return None
    if isinstance(value, np.ndarray | np.generic):
        if value.ndim or value.dtype.kind not in "iuf":
            return None
        return value.item() if value.dtype.kind != "f" else float(value)
    if isinstance(value, int | float):
        return value
    try:
        return operator.index(value)
    except TypeError:
        return None
