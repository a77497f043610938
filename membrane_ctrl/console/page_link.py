"""The link of the page, as soon as its service answers."""

from __future__ import annotations

import math
from pathlib import Path

from membrane_ctrl.control_port import service_link

_LOOK_S = 2.0


class PageLink:
    """Looks for the service of a folder of runs.

    Parameters
    ----------
    logs : Path
        Folder of the runs, in which a service names its address.
    """

    def __init__(self, logs: Path) -> None:
        self._logs = logs
        self._next_s = -math.inf
        self._link = ""

    def find(self, now_s: float) -> str:
        """The link; empty while no service answers."""
        if now_s >= self._next_s:
            self._next_s = now_s + _LOOK_S
            link = service_link.find_service(self._logs)
            self._link = link if link and service_link.is_answering(link) else ""
        return self._link
