"""The Python of README.md and of docs/ runs as it stands, but for its budgets."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.fast

PAGES = [Path("README.md"), *(page for page in sorted(Path("docs").glob("*.md")) if page.name != "gallery.md")]
BUDGETS = {"elements": 1_500, "rays": 50_000, "spp": 2}  # at most
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def script(text):
    """All Python blocks of a page on the lines they have there, with small budgets."""
    lines = ["\n"] * text.count("\n")
    for block in BLOCK.finditer(text):
        start = text.count("\n", 0, block.start(1))
        lines[start : start + block[1].count("\n")] = block[1].splitlines(keepends=True)

    def lower(found):
        return f"{found[1]}={min(int(found[2]), BUDGETS[found[1]])}"

    return re.sub(rf"\b({'|'.join(BUDGETS)})=([\d_]+)", lower, "".join(lines))


@pytest.mark.parametrize("page", PAGES, ids=str)
def test_snippets_run(page, tmp_path):
    """One page after the other in a process of its own, that has chosen no LLVM."""
    root = Path().resolve()
    (tmp_path / "scenes_xml").symlink_to(root / "scenes_xml")
    (tmp_path / page.name).write_text(script(page.read_text(encoding="utf-8")), encoding="utf-8")
    environment = {k: v for k, v in os.environ.items() if k != "DRJIT_LIBLLVM_PATH"} | {"PYTHONPATH": str(root)}
    run = subprocess.run(
        [sys.executable, page.name], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stderr


def test_there_are_snippets():
    assert all("import mi" in script(page.read_text(encoding="utf-8")) for page in PAGES)


def test_blocks_keep_their_lines_and_lower_their_budgets():
    text = "A\n```python\nsolve(elements=19_000,\n      rays=900, lines=20)\n```\nB\n```\nno Python\n```\n"
    assert script(text) == "\n\nsolve(elements=1500,\n      rays=900, lines=20)\n\n\n\n\n\n"


def test_one_version():
    """pyproject.toml, CITATION.cff, the package and the top of CHANGELOG.md name the same version."""
    patterns = {
        "pyproject.toml": r'^version = "(.+)"$',
        "CITATION.cff": r"^version: (.+)$",
        "CHANGELOG.md": r"^## \[(.+?)\]",
        "mi_radiosity/__init__.py": r'^__version__ = "(.+)"$',
    }
    found = {
        file: re.search(pattern, Path(file).read_text(encoding="utf-8"), re.MULTILINE)[1]
        for file, pattern in patterns.items()
    }
    assert len(set(found.values())) == 1, found
