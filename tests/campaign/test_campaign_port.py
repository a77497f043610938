"""A hold whose control port is under attack: it holds, records what it refuses, and still hears a
stop.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import subprocess
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import port_attackers
import pytest
from campaign_bench import make_plant, running

from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.model.errors import Exit

pytestmark = [pytest.mark.real_time, pytest.mark.campaign]

EACH = "3"
ATTACKED_S = 15.0


def stop(socket: Path) -> dict[str, object]:
    with PortClient.unix(socket, lambda notice: None) as client:
        return client.ask(do="stop", why="under attack")


def figures_of(folder: Path) -> dict[str, Any]:
    (summary,) = folder.glob("logs/*/summary.json")
    found: dict[str, Any] = json.loads(summary.read_text())
    return found


@contextlib.asynccontextmanager
async def attackers(socket: Path) -> AsyncIterator[None]:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, port_attackers.__file__, str(socket), EACH), stdout=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.kill()
        await process.wait()


async def test_the_tick_is_not_disturbed_and_a_stop_gets_through(tmp_path: Path) -> None:
    socket = tmp_path / "logs" / "control.sock"
    async with running(tmp_path, make_plant()) as run:
        await run.until(lambda: run.reached("hold"))
        async with attackers(socket):
            await asyncio.sleep(ATTACKED_S)
            assert (await asyncio.to_thread(stop, socket))["ok"]
        assert await run.ended() == Exit.INTERRUPTED
        assert run.faults() == []
        refused = [event for event in run.events if event["kind"] == "refused"]
        assert 10 <= len(refused) <= 100  # recorded, and the record is bounded
        assert any("bytes" in event["reason"] for event in refused)
    figures = figures_of(tmp_path)
    assert figures["fault_count"] == 0
    assert figures["missed_ticks"] <= figures["ticks"] // 100
