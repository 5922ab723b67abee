"""Parts that others add: classes known by a name, and the modules that define them."""

import functools
import importlib
import importlib.metadata
import runpy
import warnings
from pathlib import Path
from typing import Any

from .errors import RadiosityError

GROUP = "mi_radiosity.plugins"  # entry points of installed packages


class Registry(dict):
    """Classes by name; ``kind`` is what messages call one of them."""

    def __init__(self, kind: str):
        super().__init__()
        self.kind = kind

    def add(self, name: str, cls: type) -> None:
        """Make a class known; a later one of the same name takes its place."""
        self[name] = cls

    def find(self, name: str) -> Any:
        """The class of a name. Raises RadiosityError that lists the names there are."""
        if name not in self:
            raise RadiosityError(f"unknown {self.kind} '{name}': choose one of {', '.join(self)}")
        return self[name]


def load(name: str) -> None:
    """Run a plugin: the name of a module, or a path that ends in .py. What it defines registers itself.

    Raises RadiosityError if there is none, or if it fails.
    """
    try:
        if name.endswith(".py"):
            if not Path(name).is_file():
                raise RadiosityError(f"the plugin {name} does not exist: check the path")
            runpy.run_path(name)
        else:
            importlib.import_module(name)
    except (RadiosityError, KeyboardInterrupt):
        raise
    except ModuleNotFoundError as error:
        if error.name != name:
            raise RadiosityError(f"the plugin {name} needs the module {error.name}: install it") from None
        raise RadiosityError(f"there is no plugin module {name}: install it, or name a file that ends in .py") from None
    except Exception as error:
        raise RadiosityError(f"the plugin {name} fails: {type(error).__name__}: {error}") from error


def load_installed() -> None:
    """Run the plugins that installed packages declare."""
    for entry in importlib.metadata.entry_points(group=GROUP):
        load(entry.value)


@functools.cache
def welcome_installed() -> None:
    """`load_installed`, once; one that fails is a warning, so that it does not keep others from their work."""
    try:
        load_installed()
    except RadiosityError as error:
        warnings.warn(str(error), stacklevel=2)
