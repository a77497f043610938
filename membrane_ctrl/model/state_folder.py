"""The user's own folder for what programs remember from one start to the next."""

from __future__ import annotations

import os
from pathlib import Path

_NAME = "membrane-ctrl"


def find_state_folder() -> Path | None:
    """Return `$XDG_STATE_HOME/membrane-ctrl` or `~/.local/state/membrane-ctrl`; None without a
    home.
    """
    named = os.environ.get("XDG_STATE_HOME", "")
    if named:
        return Path(named).absolute() / _NAME
    try:
        return Path.home() / ".local" / "state" / _NAME
    except RuntimeError:
        return None
