"""The commands that make the mirror safe: they overtake all others on every interface, and none is dropped."""

from __future__ import annotations

import re

from membrane_ctrl.controller.commands import DOWN

SAFETY: frozenset[str] = frozenset(DOWN)

_NAMED = re.compile("|".join(f'"{kind}"' for kind in sorted(SAFETY)).encode())


def is_safety_command(kind: str) -> bool:
    """Whether a command overtakes all others."""
    return kind in SAFETY


def may_hold_safety_command(line: bytes) -> bool:
    r"""Whether a line of the protocol may hold a safety command.

    A fast test for the lines of a flood: it reads no JSON, so it also accepts a line that only quotes such a name. A
    line with an escape sequence (`"st\u006fp"`) is accepted as well, because the escape may spell the name.
    """
    return _NAMED.search(line) is not None or b"\\" in line
