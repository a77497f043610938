"""Peers that are not holds: each greets (or not), then answers what no hold answers."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

GREETING = {"membrane_ctrl": 1, "run": "evil", "you": "unix:x", "role": "tune", "commander": None}
STATUS: dict[str, Any] = {
    "state": "hold",
    "why": "",
    "row": {"error_um": 0.1},
    "fault": None,
    "notices": [],
}
_HUGE = "9" * 4000

# Raw lines, so that a test may send what a JSON library would not write.
GREETINGS: dict[str, bytes] = {
    "no_run": b'{"membrane_ctrl": 1}',
    "path_run": json.dumps(GREETING | {"run": "../../../../etc"}).encode(),
    "dot_run": json.dumps(GREETING | {"run": ".."}).encode(),
    "list_run": json.dumps(GREETING | {"run": ["evil"]}).encode(),
    "role": json.dumps(GREETING | {"role": "root"}).encode(),
    "list": b"[1]",
    "text": b'"hello"',
    "empty": b"",
    "binary": bytes(range(128, 250)),
    "null_bytes": b"\x00" * 100,
    "nested": b"[" * 30_000,
    "long": b"x" * 200_000,
}


def status_line(**changes: Any) -> bytes:
    """The answer to a request for the status, with some of its fields changed."""
    return json.dumps({"number": 1, "ok": True, "status": STATUS | changes}).encode()


# What `status` and `watch` answer; `NUMBER` stands for the request's number.
ANSWERS: dict[str, bytes] = {
    "row_text": status_line(row="text"),
    "row_list": status_line(row=[1, 2]),
    "error_text": status_line(row={"error_um": "<b>1</b>"}),
    "error_list": status_line(row={"error_um": [1]}),
    "error_inf": status_line().replace(b"0.1", b"1e999"),
    "error_nan": status_line().replace(b"0.1", b"NaN"),
    "error_huge": status_line().replace(b"0.1", _HUGE.encode()),
    "error_large": status_line(row={"error_um": 1e300}),
    "error_true": status_line(row={"error_um": True}),
    "row_names": status_line(row={"<img>": 1.0}),
    "row_many": status_line(row={f"a{number}": 1.0 for number in range(5000)}),
    "fault_text": status_line(fault="boom"),
    "fault_part": status_line(fault={"code": 1}),
    "fault_types": status_line(fault={"code": "x", "name": 1, "cause": [], "remedy": {}}),
    "notices_text": status_line(notices="x"),
    "notices_list": status_line(notices=["x"]),
    "notice_part": status_line(notices=[{"topic": "recorder", "text": "x"}]),
    "notice_numbers": status_line(
        notices=[{"topic": "recorder", "subject": 1, "severity": 2, "text": 3}]
    ),
    "recording_text": status_line(recording_ok="x"),
    "paused_text": status_line(paused="no"),
    "state_list": status_line(state=["hold"]),
    "state_html": status_line(state="<img src=x onerror=alert(1)>"),
    "state_escape": status_line(state="hold\x1b[2J"),
    "state_none": status_line(state=None),
    "why_list": status_line(why=[1]),
    "why_long": status_line(why="x" * 10_000),
    "gains_part": status_line(gains={"kp_per_s": 1.0}),
    "geometry_text": status_line(geometry="x"),
    "run_path": status_line(run="../x"),
    "trial_text": status_line(trial_left_s="soon"),
    "later_nested": status_line(later=[[[[[[[[[[[[1]]]]]]]]]]]]),
    "status_list": b'{"number": 1, "ok": true, "status": [1]}',
    "status_missing": b'{"number": 1, "ok": true}',
    "status_null": b'{"number": 1, "ok": true, "status": null}',
    "ok_text": b'{"number": 1, "ok": "yes", "status": {}}',
    "ok_missing": b'{"number": 1}',
    "refused_missing": b'{"number": 1, "ok": false}',
    "refused_list": b'{"number": 1, "ok": false, "refused": [1]}',
    "number_text": b'{"number": "1", "ok": true}',
    "number_true": b'{"number": true, "ok": true}',
    "notice_list": b'{"notice": [1]}',
    "not_json": b"{",
    "list": b"[]",
    "null": b"null",
    "utf16": '{"number": 1}'.encode("utf-16"),
    "deep": b'{"a":' * 10_000,
    "deep_list": b"[" * 60_000,
    "duplicate_bomb": b"{" + b'"a":1,' * 8000 + b'"b":1}',
    "long": b'{"number": 1, "x": "' + b"x" * 300_000 + b'"}',
}

Serve = Callable[[socket.socket], None]


@contextlib.contextmanager
def peer(path: Path, serve: Serve) -> Iterator[Path]:
    """A socket file at which `serve` talks to each client, in a thread of its own."""
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen(16)

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = listener.accept()
                threading.Thread(target=talk, args=(connection,), daemon=True).start()

    def talk(connection: socket.socket) -> None:
        with contextlib.suppress(OSError, ValueError), connection:
            serve(connection)

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield path
    finally:
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)
        listener.close()


def greeting_with(line: bytes) -> Serve:
    """A peer that greets with a line and then waits."""

    def serve(connection: socket.socket) -> None:
        connection.sendall(line + b"\n")
        connection.recv(1)

    return serve


def answering(line: bytes) -> Serve:
    """A peer that greets as a hold and answers every request with a line."""

    def serve(connection: socket.socket) -> None:
        connection.sendall(json.dumps(GREETING).encode() + b"\n")
        for request in connection.makefile("rb"):
            number = json.loads(request)["number"]
            connection.sendall(
                line.replace(b'"number": 1,', f'"number": {number},'.encode(), 1) + b"\n"
            )

    return serve


def streaming(*stream: bytes, pause_s: float = 0.01) -> Serve:
    """A peer that greets and answers as a hold, then repeats these
    lines to a client that watches.
    """

    def serve(connection: socket.socket) -> None:
        connection.sendall(json.dumps(GREETING).encode() + b"\n")
        for line in connection.makefile("rb"):
            request = json.loads(line)
            answer = {"number": request["number"], "ok": True, "status": STATUS}
            connection.sendall(json.dumps(answer).encode() + b"\n")
            while request["do"] == "watch":
                for each in stream:
                    connection.sendall(each + b"\n")
                time.sleep(pause_s)

    return serve


def endless(greets: bool) -> Serve:
    """A peer that sends one line without end, as its greeting or after it."""

    def serve(connection: socket.socket) -> None:
        if greets:
            connection.sendall(json.dumps(GREETING).encode() + b"\n")
        while True:
            connection.sendall(b"x" * 65536)

    return serve


def dribbling(connection: socket.socket) -> None:
    """A peer that sends a byte now and then, and never ends its line."""
    while True:
        connection.sendall(b"x")
        time.sleep(0.02)


def flooding(connection: socket.socket) -> None:
    """A peer that greets, then sends valid notices as fast as it can."""
    connection.sendall(json.dumps(GREETING).encode() + b"\n")
    while True:
        connection.sendall(b'{"notice": "x"}\n' * 1000)
