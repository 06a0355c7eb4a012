"""Run examples/tour.ipynb in its own kernel and store the outputs: python docs/hooks/tour.py [output file]"""

from __future__ import annotations

import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient

TOUR = Path(__file__).parents[2] / "examples" / "tour.ipynb"


def run(folder: Path) -> nbformat.NotebookNode:
    """Return the notebook with its outputs; raise if a cell fails."""
    notebook = nbformat.read(TOUR, as_version=4)
    client = NotebookClient(notebook, timeout=300)
    client.create_kernel_manager().transport = "ipc"
    client.execute(cwd=str(folder))
    return notebook


def kept(notebook: nbformat.NotebookNode) -> str:
    """Return the notebook as text, without execution times."""
    for cell in notebook.cells:
        cell.metadata = {}
    return nbformat.writes(notebook) + "\n"


if __name__ == "__main__":
    Path(*sys.argv[1:2] or [TOUR]).write_text(kept(run(Path.cwd())), encoding="utf-8")
