"""A scene file as any process loads it."""

import functools
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..core.errors import RadiosityError
from ..core.llvm import require_variant
from ..core.plugins import load, load_installed
from ..scene import Model

MAX_REASON = 600  # characters of Mitsuba's own message: files that include one another make it as long as their depth


@dataclass(frozen=True)
class SceneFile:
    """What another process needs to see the same scene, and the same oracles and shaders by name."""

    path: str
    variant: str
    definitions: tuple[tuple[str, str], ...] = ()  # values of the file's $KEYs
    plugins: tuple[str, ...] = ()  # modules, or files that end in .py

    def prepare(self) -> None:
        """Choose the variant and run the plugins: from then on what they define can be named.

        Raises RadiosityError if the variant cannot be used or a plugin fails.
        """
        require_variant(self.variant)
        if mi.variant() != self.variant:
            mi.set_variant(self.variant)
        _run_plugins(self.plugins)

    def load(self, optimize: bool = False) -> "mi.Scene":
        """The scene; ``optimize`` merges shapes, which then lose their names.

        Raises RadiosityError if there is none in the file.
        """
        self.prepare()
        if not Path(self.path).is_file():
            why = "is a folder: name a file" if Path(self.path).is_dir() else "does not exist: check the path"
            raise RadiosityError(f"the scene {self.path} {why}")
        definitions: dict[str, Any] = dict(self.definitions)
        try:
            scene = mi.load_file(self.path, optimize=optimize, **definitions)
        except Exception as error:  # of Mitsuba, and of plugins written in Python
            raise RadiosityError(f"Mitsuba cannot read {self.path}: {_reason(str(error))}") from None
        if not isinstance(scene, mi.Scene):
            raise RadiosityError(f"{self.path} holds no <scene>: give a scene file")
        return scene

    def model(self) -> Model:
        """The Model of the scene, kept until the file changes."""
        self.prepare()
        path = Path(self.path)
        return _model(self, path.stat().st_mtime_ns if path.exists() else 0)


def scene_file(
    path: str | Path,
    variant: str | None = None,
    definitions: Mapping[str, str] | None = None,
    plugins: Iterable[str] = (),
) -> SceneFile:
    """The SceneFile of a path, in the active variant by default; paths are made absolute."""
    return SceneFile(
        str(Path(path).resolve()),
        variant or mi.variant() or "none",
        tuple(sorted(dict(definitions or {}).items())),
        tuple(str(Path(name).resolve()) if name.endswith(".py") else name for name in plugins),
    )


def _reason(text):
    """What Mitsuba says is wrong: without its source lines, without the traceback of a Python plugin, and not longer
    than MAX_REASON."""
    text = re.sub(r"\[\w+\.cpp:\d+\] ", "", text)
    if "Traceback (most recent call last)" in text:
        before, trace = text.split("Traceback (most recent call last)", 1)
        errors = re.findall(r"^(?:[\w.]+\.)?(\w+(?:Error|Exception): .*)$", trace, flags=re.MULTILINE)
        text = before + (errors[-1].removeprefix("RadiosityError: ") if errors else trace)
    text = " ".join(text.split())
    return text if len(text) <= MAX_REASON else f"{text[: MAX_REASON // 3]} … {text[-MAX_REASON * 2 // 3 :]}"


@functools.lru_cache(maxsize=2)
def _model(file: SceneFile, changed: int) -> Model:
    return Model(file.load())


@functools.cache
def _run_plugins(names: tuple[str, ...]) -> None:
    load_installed()
    for name in names:
        load(name)
