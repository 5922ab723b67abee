"""The notebooks are stored without outputs and run from start to end, on small budgets."""

import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = pytest.mark.parametrize("path", sorted(Path("notebooks").glob("*.ipynb")), ids=lambda p: p.stem)


@pytest.mark.fast
@NOTEBOOKS
def test_notebook_is_clean(path):
    """What to learn, what to see next, nothing that a run leaves behind, and mi_radiosity before it loads LLVM."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert "You will learn" in notebook.cells[0].source and "See also" in notebook.cells[-1].source
    assert all(not cell.outputs and cell.execution_count is None and not cell.metadata for cell in code)
    imported = re.findall(r"^(?:import|from) (mi_radiosity|mitsuba|drjit)", code[0].source, re.MULTILINE)
    assert imported[0] == "mi_radiosity"


@NOTEBOOKS
def test_notebook_runs(path, monkeypatch):
    monkeypatch.setenv("QUICK", "1")
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)  # as on a machine where nobody has chosen one
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": "notebooks"}}).execute()
