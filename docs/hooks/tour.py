"""Runs examples/tour.ipynb in a kernel of its own and keeps what it shows: python docs/hooks/tour.py [another file]"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

TOUR = Path(__file__).parents[2] / "examples" / "tour.ipynb"


def run(folder: Path) -> nbformat.NotebookNode:
    """The notebook with its outputs; a cell that fails is an error."""
    notebook = nbformat.read(TOUR, as_version=4)
    client = NotebookClient(notebook, timeout=300)
    client.create_kernel_manager().transport = "ipc"
    client.execute(cwd=str(folder))
    return notebook


def kept(notebook: nbformat.NotebookNode) -> str:
    """Return the notebook as text, without times."""
    for cell in notebook.cells:
        cell.metadata = {}
    return nbformat.writes(notebook) + "\n"


if __name__ == "__main__":
    Path(*sys.argv[1:2] or [TOUR]).write_text(kept(run(Path.cwd())), encoding="utf-8")
