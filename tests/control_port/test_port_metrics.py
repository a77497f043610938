from __future__ import annotations

import asyncio
import re
import socket
from dataclasses import replace
from math import nan
from pathlib import Path

from membrane_ctrl.config.port import PortConfig
from membrane_ctrl.control_port.server import metrics_text
from membrane_ctrl.model.recorder_events import DiskLow
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import FIELDS
from tests.worlds.port_run import ROW, port_run

SAMPLE = re.compile(r'[a-z_][a-z0-9_]*(\{state="[a-z]+"\})? (NaN|-?[0-9.e+-]+)')


def test_every_line_is_one_that_prometheus_reads() -> None:
    text = metrics_text(RunStatus(row=replace(ROW, trim_um=nan)), 2, 7)
    samples = [
        line
        for line in text.splitlines()
        if not line.startswith(("# TYPE membrane_", "# HELP membrane_"))
    ]
    assert all(SAMPLE.fullmatch(line) for line in samples)
    assert "membrane_error_um 0.25" in samples
    assert "membrane_trim_um NaN" in samples
    assert 'membrane_in_state{state="hold"} 1.0' in samples
    assert "membrane_port_refused_total 7.0" in samples
    assert "membrane_ticks_total 600.0" in samples
    assert (
        sum(line.startswith("membrane_in_state") and line.endswith(" 1.0") for line in samples) == 1
    )
    assert len(samples) >= len(FIELDS)


def test_before_the_first_tick_there_are_the_ports_own() -> None:
    assert "error_um" not in metrics_text(RunStatus(), 0, 0)


def test_trouble_with_the_recording_is_a_gauge() -> None:
    failing = RunStatus().after_event(DiskLow("disk", "full"))
    assert "membrane_recording_ok 1.0" in metrics_text(RunStatus(), 0, 0).splitlines()
    assert "membrane_recording_ok 0.0" in metrics_text(failing, 0, 0).splitlines()


async def fetch(port: int, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(request)
    answer = await asyncio.wait_for(reader.read(), 10)
    writer.close()
    await writer.wait_closed()
    return answer


async def test_http(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    async with port_run(tmp_path, PortConfig(metrics_port=port)):
        answer = await fetch(port, b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
        head, body = answer.split(b"\r\n\r\n", 1)
        assert head.startswith(b"HTTP/1.1 200 OK")
        assert f"Content-Length: {len(body)}".encode() in head
        assert b"membrane_error_um 0.25" in body
        assert (await fetch(port, b"GET / HTTP/1.1\r\n\r\n")).startswith(b"HTTP/1.1 404")
        assert (await fetch(port, b"POST /metrics HTTP/1.1\r\n\r\n")).startswith(b"HTTP/1.1 404")
        assert await fetch(port, b"x" * 50_000) == b"", "no end of a head: no answer"
