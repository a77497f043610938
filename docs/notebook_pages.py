"""A hook of MkDocs: a page for each notebook of docs/notebooks, as it is stored, with what it
prints and draws.
"""

from pathlib import Path
from typing import Any

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages; the notebooks themselves stay as downloads."""
    for path in sorted(Path(config.docs_dir).glob("notebooks/*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        parts = [part for cell in notebook.cells for part in _cell(cell)]
        title, *rest = "\n\n".join(parts).split("\n", 1)
        text = f"{title}\n\n[Download this notebook]({path.name})\n{''.join(rest)}\n"
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
    return files


def _cell(cell: Any) -> list[str]:
    if cell.cell_type == "markdown":
        return [cell.source]
    return [f"```python\n{cell.source}\n```", *map(_output, cell.outputs)]


def _output(output: Any) -> str:
    if output.output_type == "stream":
        return f"```text\n{output.text.rstrip()}\n```"
    shown = output.get("data", {})
    if "image/png" in shown:
        return (
            "![What the cell above "
            f"draws](data:image/png;base64,{''.join(shown['image/png'].split())})"
        )
    return str(shown.get("text/markdown", ""))
