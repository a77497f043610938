"""A hold whose page has fifty viewers, a stalled one, and a hundred strangers at the login.

Phases without and with all of them alternate in one hold. Meanwhile a viewer with a session sends
`mark`, which takes the way of STOP up to the tick, but waits behind other commands of the hold.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx

from tests.studies import viewers
from tests.support.figures import Figure, at_most

_STRANGERS = 100
_CYCLES = 1
_PAUSE_S = 0.5
_STARTS_S = 60.0


class CommandTimes:
    """Times until commands are answered, in s, while the strangers are there."""

    def __init__(self) -> None:
        self.found_s: list[float] = []
        self._over = threading.Event()

    @contextmanager
    def beside_strangers(self, link: str) -> Iterator[None]:
        """Strangers at the login, and commands of somebody with a session."""
        words = ["-m", "tests.support.service_attacks", "logins", _base(link), str(_STRANGERS)]
        with subprocess.Popen(
            [sys.executable, *words], stdout=subprocess.PIPE, text=True
        ) as strangers:
            assert strangers.stdout is not None
            assert strangers.stdout.readline(), "the strangers have ended"
            self._over.clear()
            thread = threading.Thread(target=self._send_marks, args=(link,))
            thread.start()
            try:
                yield
                assert strangers.poll() is None, "the strangers have ended"
            finally:
                self._over.set()
                thread.join()
                strangers.kill()

    def _send_marks(self, link: str) -> None:
        with httpx.Client(base_url=_base(link), timeout=_STARTS_S) as client:
            client.get(link)  # gives the cookie
            while not self._over.wait(_PAUSE_S):
                begin_s = time.monotonic()
                answer = client.post("api/commands?hold=", json={"do": "mark", "text": "strangers"})
                assert answer.status_code == 200, answer.text
                self.found_s.append(time.monotonic() - begin_s)


def _base(link: str) -> str:
    return link.partition("?")[0]


def run() -> list[Figure]:
    """Figures of one hold of the twin, in real time."""
    times = CommandTimes()
    figures = viewers.measure_viewers(viewers.VIEWERS, _CYCLES, times.beside_strangers)
    found_s = sorted(times.found_s)
    return [
        *figures,
        at_most("a command, median", statistics.median(found_s), "s", 1.0),
        at_most("a command, slowest", found_s[-1], "s", 1.0, "commands", len(found_s)),
        at_most("load of the machine at the end", os.getloadavg()[0], "", 4.0),
    ]
