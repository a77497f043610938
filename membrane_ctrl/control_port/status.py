"""What the port knows of the run: put together from what every tick decided, and only when somebody asks."""

import asyncio
import contextlib
import math
import socket
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from membrane_ctrl.control_port.protocol import Wire
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.model import events, states, telemetry

# Prometheus text on localhost: every field of the newest tick as a gauge, and a few counts.
#
# Names keep the project's units (`membrane_error_um`): the scale a person reads in alarms and telemetry is the one
# they find here.


_REQUEST_S = 2.0
_COUNTERS = {"tick": "ticks_total", "missed_ticks": "missed_ticks_total"}


def metrics_text(row: telemetry.TelemetryRow | None, clients: int, refused: int, recording_ok: bool = True) -> str:
    """Prometheus' text format, version 0.0.4.

    Parameters
    ----------
    row : TelemetryRow or None
        The newest tick; None before the first.
    clients, refused : int
        Of the control port.
    recording_ok : bool
        No trouble with recorder or disk stands.
    """
    lines: list[str] = []

    def add(name: str, kind: str, *samples: tuple[str, float]) -> None:
        lines.append(f"# TYPE membrane_{name} {kind}")
        lines.extend(f"membrane_{name}{labels} {_number(value)}" for labels, value in samples)

    add("port_clients", "gauge", ("", clients))
    add("port_refused_total", "counter", ("", refused))
    add("recording_ok", "gauge", ("", recording_ok))
    if row is not None:
        add("in_state", "gauge", *((f'{{state="{s.name.lower()}"}}', float(row.state == s)) for s in states.State))
        for field, value in asdict(row).items():
            counter = _COUNTERS.get(field)
            add(counter or field, "counter" if counter else "gauge", ("", value))
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return "NaN" if math.isnan(value) else repr(float(value))


async def serve_metrics(connection: socket.socket, text: Callable[[], str]) -> None:
    """Answer one HTTP request: `GET /metrics`, or 404."""
    wire = await Wire.on(connection)
    try:
        with contextlib.suppress(TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, OSError):
            async with asyncio.timeout(_REQUEST_S):
                head = await wire.until(b"\r\n\r\n")
            found = head.split(b"\r\n")[0].split(b" ")[:2] == [b"GET", b"/metrics"]
            body = (text() if found else "only /metrics is here\n").encode()
            kind = "text/plain; version=0.0.4; charset=utf-8"
            wire.send_bytes(
                f"HTTP/1.1 {'200 OK' if found else '404 Not Found'}\r\nContent-Type: {kind}\r\n"
                f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode()
                + body
            )
    finally:
        await wire.close()


# What keeps the run from being recorded, as its events tell: for everyone who shows the state of the run.
#
# A full disk is the one trouble that `events.jsonl` may not be able to tell of.


_GONE = "no recorder runs"
# Of one trouble: it goes into one line of a screen and of a log, each second; the event has all of it
_LONGEST = 300


class RecorderTrouble:
    """The trouble that stands.

    Attributes
    ----------
    standing : dict of str to str
        What has trouble, and the newest words about it; empty when all is recorded.
    """

    def __init__(self) -> None:
        self.standing: dict[str, str] = {}

    def take(self, event: events.Event) -> None:
        """Take in an event of the run; most change nothing."""
        about = str(event.get("what", ""))
        match event.get("kind"):
            case "recorder_error" | "disk_low":
                self.standing[about] = " ".join(str(event.get("message", "")).split())[:_LONGEST]
            case "recorder_recovered":
                self.standing.pop(about, None)
            case "child_ended" | "child_given_up" if event.get("child") == "recorder":
                self.standing["recorder"] = _GONE
            case "child_restarted" if event.get("child") == "recorder":
                self.standing.clear()  # the next one says anew what still stands

    @property
    def words(self) -> str:
        """All of it in one line; empty when all is recorded."""
        return "; ".join(self.standing.values())


class Picture:
    """The newest tick, and what the events since the start leave standing.

    Attributes
    ----------
    row : TelemetryRow or None
        Of the newest tick.
    recorder : RecorderTrouble
        What keeps the run from being recorded.
    """

    def __init__(self) -> None:
        self.row: telemetry.TelemetryRow | None = None
        self.recorder = RecorderTrouble()
        self._since_s = 0.0
        self._why = self._shape_reason = ""
        self._fault: events.Event | None = None
        self._maintenance: dict[str, str] = {}
        self._geometry: events.Event = {}

    def take(self, outputs: TickOutputs) -> None:
        """Remember a tick; this is all the port costs the tick when nobody asks."""
        self.row = outputs.row
        for event in outputs.events:
            self.note(event)
            match event["kind"]:
                case "why":
                    self._why = event["why"]
                case "state":
                    self._since_s, self._why = outputs.row.mono_s, event["why"]
                case "shape":
                    self._shape_reason = event["reason"]
                case "fault":
                    self._fault = event

    def note(self, event: events.Event) -> None:
        """Remember what stands until it is over: what a person should look at, and which geometry is used."""
        self.recorder.take(event)
        match event["kind"]:
            case "maintenance":
                self._maintenance[event["name"]] = event["message"]
            case "maintenance_over":
                self._maintenance.pop(event["name"], None)
            case "geometry":
                self._geometry = event

    def status(self) -> dict[str, Any]:
        """For people and programs: names for codes, None for what is not there."""
        row = self.row
        if row is None:
            return {"state": "starting", "why": "no tick has run yet"}
        fault = self._fault if row.fault else None
        return {
            "state": states.State(int(row.state)).name.lower(),
            "state_age_s": round(row.mono_s - self._since_s, 3),
            "why": self._why,
            "fault": {key: fault[key] for key in ("code", "name", "cause", "remedy")} if fault else None,
            "rung": states.Rung(int(row.rung)).name.lower(),
            "shape": states.ShapeState(int(row.shape_state)).name.lower(),
            "shape_reason": self._shape_reason,
            "geometry": {key: value for key, value in self._geometry.items() if key != "kind"} or None,
            "maintenance": self._maintenance,
            "recording": dict(self.recorder.standing),
            "row": {key: value if math.isfinite(value) else None for key, value in asdict(row).items()},
        }
