"""Packages that only some commands need, imported when they are."""

import importlib
from types import ModuleType

from .errors import RadiosityError


def optional(module: str, what: str, extra: str) -> ModuleType:
    """The module of a name. Raises RadiosityError, saying that ``what`` needs it, if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        needed = module.partition(".")[0].replace("_", "-")
        raise RadiosityError(f"{what} needs {needed}: pip install 'mi_radiosity[{extra}]'") from None
