"""The commands that make the mirror safe: they overtake all others on every interface, and none is
dropped.
"""

from __future__ import annotations

import re

from membrane_ctrl.controller.command_precedence import DOWN
from membrane_ctrl.controller.commands import SAME_AS

SAFETY: frozenset[str] = frozenset(DOWN)

_OTHER_NAMES = {name for name, kind in SAME_AS.items() if kind in SAFETY}
_NAMED = re.compile("|".join(f'"{kind}"' for kind in sorted(SAFETY | _OTHER_NAMES)).encode())


def is_safety_command(kind: str) -> bool:
    """Whether a command, by any of its names, overtakes all others."""
    return SAME_AS.get(kind, kind) in SAFETY


def may_hold_safety_command(line: bytes) -> bool:
    r"""Whether a line of the protocol may hold a safety command.

    A fast test for the lines of a flood: it reads no JSON, so it also accepts a line that only
    quotes such a name. A line with an escape sequence (`"st\u006fp"`) is accepted as well, because
    the escape may spell the name.
    """
    return _NAMED.search(line) is not None or b"\\" in line
