"""The link of the page as a QR code of half blocks, for a phone in front of a terminal."""

from __future__ import annotations

import sys
from itertools import zip_longest
from urllib.parse import urlsplit

from membrane_ctrl.config.port import LOCAL_HOSTS
from membrane_ctrl.model.optional import is_installed

_BORDER = 2
# light modules are drawn, because most terminals are dark; scanners read either
_BLOCKS = {(False, False): "█", (False, True): "▀", (True, False): "▄", (True, True): " "}


def draw_link_code(link: str) -> str:
    """Return the QR code of a link, with line ends.

    Empty if no phone could open it: the link is for this machine only, the output is no terminal,
    or the library is not installed.
    """
    is_local = urlsplit(link).hostname in LOCAL_HOSTS
    if is_local or not link or not sys.stderr.isatty() or not is_installed("segno"):
        return ""
    import segno

    code = segno.make(link, error="l", micro=False)
    rows = [bytes(row) for row in code.matrix_iter(border=_BORDER)]
    lines = []
    for upper, lower in zip_longest(rows[::2], rows[1::2], fillvalue=b"\1" * len(rows[0])):
        pairs = zip(upper, lower, strict=True)
        lines.append("".join(_BLOCKS[bool(above), bool(below)] for above, below in pairs))
    return "\n".join(lines) + "\n"
