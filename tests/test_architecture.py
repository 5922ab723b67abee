"""Imports point down: no circle between modules, and rooms know only those below them."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

pytestmark = pytest.mark.fast

PACKAGE = "mi_radiosity"
ROOMS = "core scene oracles mesh transport solver display export evaluation cli".split()  # from the ground up
STRANGERS = {"scene", "oracles"}  # know nothing of each other
EXCEPTIONS: set[tuple[str, str]] = set()  # (importing module, imported module)

FILES = {".".join(path.with_suffix("").parts): path for path in Path(PACKAGE).rglob("*.py")}


def imports(module):
    """Modules of the package that a module imports, within its functions too."""
    found = set()
    for node in ast.walk(ast.parse(FILES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = module.split(".")[: -node.level] if node.level else []
            base = ".".join([*above, *(node.module or "").split(".")]).strip(".")
            found |= {f"{base}.{name.name}" if f"{base}.{name.name}" in FILES else base for name in node.names}
    found = {name if name in FILES else f"{name}.__init__" for name in found}
    return {name for name in found & FILES.keys() if (module, name) not in EXCEPTIONS}


def room(module):
    return "cli" if module == f"{PACKAGE}.__init__" else module.split(".")[1]  # the package offers what all rooms have


GRAPH = {module: imports(module) for module in FILES}


def test_no_circles():
    TopologicalSorter(GRAPH).prepare()  # raises CycleError, which names them


def test_imports_point_down():
    wrong = []
    for module, others in GRAPH.items():
        for other in others:
            here, there = room(module), room(other)
            if ROOMS.index(there) > ROOMS.index(here) or {here, there} == STRANGERS:
                wrong.append(f"{module} imports {other}")
    assert not wrong and sum(map(len, GRAPH.values())) > len(GRAPH)
