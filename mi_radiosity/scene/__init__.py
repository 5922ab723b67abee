"""A Mitsuba scene seen as oriented patches, and rays between them."""

from .model import Model
from .support import Finding, inspect

__all__ = ["Model", "Finding", "inspect"]
