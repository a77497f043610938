"""A stop by key does not wait for the answer to an earlier key."""

from __future__ import annotations

import json
import socket
from pathlib import Path

from membrane_ctrl.console.requests import request_sender

GREETING = b'{"membrane_ctrl": 1, "run": "the-run", "you": "unix:ann", "role": "tune"}\n'


def test_a_stop_is_sent_while_another_key_waits_for_its_answer(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    with socket.socket(socket.AF_UNIX) as hold:
        hold.bind(str(path))
        hold.listen(8)
        hold.settimeout(5.0)
        send = request_sender(path, "the-run")
        first = send({"do": "hold"})
        waiting, _ = hold.accept()  # and never answered
        stopped = send({"do": "stop"})
        stopping, _ = hold.accept()
        with waiting, stopping:
            stopping.sendall(GREETING)
            request = json.loads(stopping.makefile("rb").readline())
            assert request["do"] == "stop"
            stopping.sendall(json.dumps({"number": request["number"], "ok": True}).encode() + b"\n")
            assert stopped.result(5.0) == "stop: done"
            assert not first.done()
