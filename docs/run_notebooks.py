"""Run the notebooks of docs/notebooks and store their outputs.

Run from the repository root: python -m docs.run_notebooks [NAME ...]
"""

import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from traitlets.config import Config

NOTEBOOKS = Path(__file__).resolve().parent / "notebooks"
TIMEOUT_S = 600  # of a cell, on a busy machine


def execute(path: Path) -> nbformat.NotebookNode:
    """Run a notebook and return it with its outputs.

    Raises:
        CellExecutionError: A cell failed.
    """
    notebook = nbformat.read(path, nbformat.NO_CONVERT)
    resources = {"metadata": {"path": str(path.parent)}}
    with tempfile.TemporaryDirectory() as sockets:  # not TCP, which other users of the machine could read
        files = Config({"KernelManager": {"transport": "ipc", "ip": f"{sockets}/kernel"}})
        client = NotebookClient(
            notebook, timeout=TIMEOUT_S, kernel_name="python3", resources=resources, config=files
        )
        client.execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # times, which would differ in each run
    notebook.metadata.pop("language_info", None)
    return notebook


if __name__ == "__main__":
    for name in sys.argv[1:] or [path.stem for path in sorted(NOTEBOOKS.glob("*.ipynb"))]:
        nbformat.write(execute(NOTEBOOKS / f"{name}.ipynb"), NOTEBOOKS / f"{name}.ipynb")
