"""Judging solutions: path-traced references, metrics, comparisons, benchmarks."""

from importlib.util import find_spec

from ..core.errors import RadiosityError


def require_extra() -> None:
    """Raise RadiosityError if a library of the ``evaluation`` extra is missing; asked before anything is computed."""
    missing = [name for name in ("scipy", "matplotlib", "jinja2") if find_spec(name) is None]
    if missing:
        raise RadiosityError(f"tables and figures need {', '.join(missing)}: pip install 'mi_radiosity[evaluation]'")
