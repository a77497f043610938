"""The state of the run as the port tells it, for people and programs, and as metrics; made when somebody asks."""

import asyncio
import contextlib
import math
import socket
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from membrane_ctrl.control_port.protocol import Wire
from membrane_ctrl.model import states
from membrane_ctrl.model.run_status import RunStatus

# Prometheus text on localhost: every field of the newest tick as a gauge, and a few counts.
#
# Names keep the project's units (`membrane_error_um`): the scale a person reads in alarms and telemetry is the one
# they find here.


_REQUEST_S = 2.0
_COUNTERS = {"tick": "ticks_total", "missed_ticks": "missed_ticks_total"}


def metrics_text(status: RunStatus, clients: int, refused: int) -> str:
    """Prometheus' text format, version 0.0.4.

    Parameters
    ----------
    status : RunStatus
        Of the run.
    clients, refused : int
        Of the control port.
    """
    lines: list[str] = []

    def add(name: str, kind: str, *samples: tuple[str, float]) -> None:
        lines.append(f"# TYPE membrane_{name} {kind}")
        lines.extend(f"membrane_{name}{labels} {_number(value)}" for labels, value in samples)

    add("port_clients", "gauge", ("", clients))
    add("port_refused_total", "counter", ("", refused))
    add("recording_ok", "gauge", ("", not status.recording))
    row = status.row
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


def status_table(status: RunStatus) -> dict[str, Any]:
    """For people and programs: names for codes, None for what is not there."""
    row = status.row
    if row is None:
        return {"state": "starting", "why": "no tick has run yet"}
    fault, geometry = status.fault, status.geometry
    return {
        "state": states.State(int(row.state)).name.lower(),
        "state_age_s": round(row.mono_s - status.since_s, 3),
        "why": status.why,
        "fault": {key: getattr(fault, key) for key in ("code", "name", "cause", "remedy")} if fault else None,
        "rung": states.Rung(int(row.rung)).name.lower(),
        "shape": states.ShapeState(int(row.shape_state)).name.lower(),
        "shape_reason": status.shape_reason,
        "geometry": asdict(geometry) if geometry else None,
        "maintenance": dict(status.maintenance),
        "recording": dict(status.recording),
        "row": {key: value if math.isfinite(value) else None for key, value in asdict(row).items()},
    }
