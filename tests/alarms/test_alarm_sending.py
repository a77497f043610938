"""Services that answer without end cost neither the alarms of the others, nor memory, nor more than
a minute.
"""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest

from membrane_ctrl.alarms import sending
from membrane_ctrl.alarms.memory_limit import limited_memory
from membrane_ctrl.alarms.sending import Service, send_to_all


class Plugin:
    """A plug-in that does what the test says."""

    def __init__(self, accepts: bool = True, waits: threading.Event | None = None) -> None:
        self.accepts, self.waits = accepts, waits
        self.calls = 0

    def notify(self, title: str, body: str, notify_type: str) -> bool:
        self.calls += 1
        if self.waits is not None:
            self.waits.wait(60.0)
        return self.accepts


class Broken:
    """A plug-in that raises."""

    def notify(self, **_: str) -> bool:
        raise RuntimeError("no")


def test_one_success_suffices_and_all_are_asked() -> None:
    plugins = [Plugin(False), Plugin(True), Plugin(False)]
    assert send_to_all([Service(Broken()), *map(Service, plugins)], "t", "b", "warning")
    assert [plugin.calls for plugin in plugins] == [1, 1, 1]
    assert not send_to_all([Service(Broken()), Service(Plugin(False))], "t", "b", "warning")


@pytest.mark.real_time
def test_a_service_that_hangs_delays_no_other_and_is_not_asked_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sending, "SERVICE_S", 0.3)
    release = threading.Event()
    hanging, good = Plugin(waits=release), Plugin()
    services = [Service(hanging), Service(good)]
    began_s = time.monotonic()
    for count in (1, 2, 3):
        assert send_to_all(services, "t", "b", "warning")
        assert (hanging.calls, good.calls) == (1, count)
    assert not send_to_all(services[:1], "t", "b", "warning")
    assert time.monotonic() - began_s < 30.0  # without the limit it would hang
    release.set()
    deadline_s = time.monotonic() + 30.0
    while not send_to_all(services[:1], "t", "b", "warning"):
        assert time.monotonic() < deadline_s
    assert hanging.calls >= 2, "it is asked again once it has returned"


_ENDLESS = """
import http.server, threading, urllib.request
from membrane_ctrl.alarms.memory_limit import limited_memory
from membrane_ctrl.alarms.sending import Service, send_to_all
from tests.support.peak_memory import peak_mb

class Endless(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.end_headers()
        try:
            while True:
                self.wfile.write(b"x" * 65536)
        except OSError:
            pass
    def log_message(self, *_):
        pass

class Reads:
    def notify(self, **_):
        return bool(urllib.request.urlopen(f"http://127.0.0.1:{server.server_port}/").read())

class Good:
    def notify(self, **_):
        return True

server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Endless)
threading.Thread(target=server.serve_forever, daemon=True).start()
with limited_memory():
    print(send_to_all([Service(Reads())], "t", "b", "warning"), send_to_all([Service(Good())], "t", "b", "warning"))
print(peak_mb())
"""  # noqa: E501


def test_an_answer_without_end_is_given_up_at_the_limit_of_memory() -> None:
    done = subprocess.run(
        [sys.executable, "-c", _ENDLESS], capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
    outcome, memory_mb = done.stdout.splitlines()
    assert outcome == "False True"
    assert float(memory_mb) < 1000


def test_the_limit_ends_with_its_context() -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    with limited_memory():
        assert resource.getrlimit(resource.RLIMIT_DATA)[0] != resource.RLIM_INFINITY
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
