"""The notebooks run from start to end, on small budgets."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient


@pytest.mark.parametrize("path", sorted(Path("notebooks").glob("*.ipynb")), ids=lambda p: p.stem)
def test_notebook(path, monkeypatch):
    monkeypatch.setenv("QUICK", "1")
    notebook = nbformat.read(path, as_version=4)
    assert "You will learn" in notebook.cells[0].source and "See also" in notebook.cells[-1].source
    assert all(not cell.get("outputs") for cell in notebook.cells)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": "notebooks"}}).execute()
