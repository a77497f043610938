"""Runs docs/notebooks; `python -m tests.support.notebooks [NAME...]` also stores what they print
and draw.
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

from tests.support.review_runs import written
from tests.worlds.nights import GLITCH, Planted

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "notebooks"
NAMES = ("measure", "library", "tune", "review")
_TIMEOUT_S = 600


def executed(name: str, scratch: Path) -> nbformat.NotebookNode:
    """The notebook with new outputs, run by a kernel of its own in an empty folder with a run in
    `logs`.
    """
    events = [
        Planted("pressure step", 1500.0, 20.0),
        Planted(GLITCH, 2200.0, 8.0),
        Planted("flow step", 2700.0, 35.0),
    ]
    if name == "review":
        written(scratch / "logs", 1.0, events)
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    environment = {name: value for name, value in os.environ.items() if name != "RUN"}
    client = NotebookClient(
        notebook,
        timeout=_TIMEOUT_S,
        resources={"metadata": {"path": str(scratch)}},
        record_timing=False,
    )
    manager = client.create_kernel_manager()
    manager.transport, manager.ip = "ipc", str(scratch / "kernel")  # sockets in a folder, no ports
    path = os.pathsep.join((str(ROOT), *filter(None, [environment.get("PYTHONPATH")])))
    client.execute(env={**environment, "PYTHONPATH": path})
    return notebook


def text_of(notebook: nbformat.NotebookNode) -> str:
    """What all cells print."""
    outputs = (output for cell in notebook.cells for output in cell.get("outputs", []))
    return "".join(output.get("text", "") for output in outputs)


def main(names: list[str]) -> None:
    """Run notebooks and store their outputs."""
    for name in names or NAMES:
        with tempfile.TemporaryDirectory() as scratch:
            nbformat.write(executed(name, Path(scratch)), FOLDER / f"{name}.ipynb")


if __name__ == "__main__":
    main(sys.argv[1:])
