"""Tables and pictures of a report in HTML."""

import base64
import html
from collections.abc import Sequence

from membrane_ctrl.sessions.folder import SessionFolder


def make_table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of plain texts."""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heads)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows
    )
    return f"<table><tr>{head}</tr>{body}</table>"


def embed_picture(folder: SessionFolder, name: str) -> str:
    """Return a picture of the session as an element of the page; empty if it is missing."""
    path = folder.file_path(name)
    if not path.exists():
        return ""
    data = base64.b64encode(folder.read_content(name)).decode()
    return f'<img alt="{path.stem}" src="data:image/png;base64,{data}">'
