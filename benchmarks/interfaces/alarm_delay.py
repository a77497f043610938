"""Time from a fault of a hold to the request that an alarm's service gets, on this machine: what a
phone's own service adds is not part of it.

A person latches a hold of the twin; the alarm goes to an address of Apprise's form `json://`. Needs
the extra `alarms`.
"""

from __future__ import annotations

import importlib.util
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory

import httpx

from tests.studies.viewers import hold_with_page
from tests.support.figures import Figure, at_most

_WAIT_S = 60.0


class Receiver(ThreadingHTTPServer):
    """Stands for the service that forwards to a phone."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Request)
        self.has_alarm = threading.Event()
        self.alarm_s = 0.0


class _Request(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        """Note the time of the first request."""
        assert isinstance(self.server, Receiver)
        self.rfile.read(int(self.headers["Content-Length"]))
        if not self.server.has_alarm.is_set():
            self.server.alarm_s = time.monotonic()
            self.server.has_alarm.set()
        self.send_response(200)
        self.end_headers()

    def log_message(self, *args: object) -> None:
        """Print nothing."""


@contextmanager
def receive_alarms() -> Iterator[Receiver]:
    """A receiver that listens."""
    with Receiver() as receiver:
        thread = threading.Thread(target=receiver.serve_forever)
        thread.start()
        try:
            yield receiver
        finally:
            receiver.shutdown()
            thread.join()


def run() -> list[Figure]:
    """Figures of one hold of the twin, in real time."""
    if importlib.util.find_spec("apprise") is None:
        sys.exit("alarm_delay: Apprise is missing: pip install 'membrane-ctrl[alarms]'")
    with TemporaryDirectory() as name, receive_alarms() as receiver:
        urls = Path(name) / "urls"
        urls.write_text(f"json://127.0.0.1:{receiver.server_port}/\n")
        urls.chmod(0o600)
        tables = f'[alarms]\nurls_file = "{urls}"\n'
        with hold_with_page(Path(name), tables) as (_, _, link, _):
            receiver.has_alarm.clear()  # of the start
            with httpx.Client(base_url=link.partition("?")[0], timeout=_WAIT_S) as client:
                client.get(link)  # gives the cookie
                begin_s = time.monotonic()
                latch = {"do": "latch", "text": "benchmark"}
                client.post("api/commands?hold=", json=latch).raise_for_status()
            assert receiver.has_alarm.wait(_WAIT_S), "no alarm was sent"
            delay_s = receiver.alarm_s - begin_s
    return [at_most("from the command that latches a fault to the request", delay_s, "s", 5.0)]
