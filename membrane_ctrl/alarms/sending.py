"""Sends a message through several services at once, in bounded time and memory.

A mail or web server may answer without end, or a byte a minute; the libraries behind Apprise read
all of it. So each service has a thread of its own, which is abandoned after `SERVICE_S`, and the
process has a limit of memory.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from typing import Any

SERVICE_S = 60.0  # for one message; a mail server may take most of it


class Service:
    """One service: an Apprise plug-in that is called in a thread."""

    def __init__(self, plugin: Any) -> None:
        self._plugin = plugin
        self._thread: threading.Thread | None = None
        self._begun = False
        self._accepted = False

    def begin_sending(self, title: str, body: str, kind: str) -> None:
        """Begin to send, unless the last attempt still hangs.

        Parameters
        ----------
        title, body : str
            Of the message, as text.
        kind : str
            Apprise's type: `info`, `success`, `warning` or `failure`.
        """
        self._begun = self._thread is None or not self._thread.is_alive()
        if not self._begun:
            return
        self._accepted = False
        self._thread = threading.Thread(
            target=self._send_message, args=(title, body, kind), daemon=True
        )
        self._thread.start()

    def has_accepted(self, until_s: float) -> bool:
        """Whether the service has accepted the message of the last `begin_sending`, by a time of
        the monotonic clock.
        """
        if self._thread is None or not self._begun:  # what still hangs is an earlier message
            return False
        self._thread.join(max(0.0, until_s - time.monotonic()))
        return not self._thread.is_alive() and self._accepted

    def _send_message(self, title: str, body: str, kind: str) -> None:
        try:
            self._accepted = bool(self._plugin.notify(title=title, body=body, notify_type=kind))
        except Exception as error:  # plug-ins raise anything, and MemoryError at the limit
            logging.getLogger(__name__).warning(
                "%s: %s", type(self._plugin).__name__, type(error).__name__
            )


def send_to_all(services: Sequence[Service], title: str, body: str, kind: str) -> bool:
    """Send a message to every service.

    Parameters
    ----------
    services : sequence of Service
        Each gets the message; one that still hangs is left out.
    title, body, kind : str
        As for `Service.begin_sending`.

    Returns
    -------
    bool
        Whether one accepted it: a dead chat server must not repeat the mail forever.
    """
    until_s = time.monotonic() + SERVICE_S
    for service in services:
        service.begin_sending(title, body, kind)
    # Wait for all, not only for the first that accepts: each gets every message.
    accepted = [service.has_accepted(until_s) for service in services]
    return any(accepted)
