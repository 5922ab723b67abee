"""MERGE: delete this file, and import SHADERS from display instead (cli, compare, bench)."""

from .. import display
from ..core.plugins import Registry

SHADERS = getattr(display, "SHADERS", None) or Registry("shader")
SHADERS.update(dict.fromkeys(getattr(display, "SHADINGS", ())))
