"""`hold` holds the twin's film through the C firmware on an emulated Cortex-M3, as well as through
the Python board.

BOARD_HOLD_S says how long; `make board-hold` takes ten minutes each. Times are generous, as a busy
machine takes the processor away from the emulator.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
from pathlib import Path
from statistics import pstdev
from typing import Any

import pytest

from tests.board.qemu_board import built_image

pytestmark = [pytest.mark.campaign, pytest.mark.real_time]

_HOLD_S = float(os.environ.get("BOARD_HOLD_S", "45"))
_LONG_S = 300.0  # from here on the two are compared
_SETTLE_S = 60.0
_CONFIG = """
[devices]
board = "{url}"
timeout_s = 0.9
watchdog_s = 2.0
[limits]
stale_s = 2.0
lateness_max_ms = 1900.0
"""


async def _held(kind: str, folder: Path) -> tuple[dict[str, Any], list[float]]:
    """The summary of a hold, and the true displacements once settled (µm)."""
    (folder / kind).mkdir()
    bench = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "tests.board.film_bench",
        kind,
        str(folder / kind),
        stdout=asyncio.subprocess.PIPE,
    )
    assert bench.stdout is not None
    url = (await bench.stdout.readline()).decode().strip()
    config = folder / f"{kind}.toml"
    config.write_text(_CONFIG.format(url=url))
    hold = await asyncio.create_subprocess_exec(
        sys.executable,
        "-m",
        "membrane_ctrl",
        "hold",
        "--config",
        str(config),
        "--duration",
        f"{_HOLD_S:g}s",
        "--logs",
        str(folder / f"logs-{kind}"),
        "--json",
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )
    output, errors = await hold.communicate()
    bench.terminate()
    await bench.wait()
    assert hold.returncode == 0, errors.decode()[-2000:]
    rows = [line.split() for line in (folder / kind / "truth.txt").read_text().splitlines()]
    last_s = float(rows[-1][0])
    return json.loads(output), [float(um) for s, um in rows if _SETTLE_S < float(s) < last_s - 15]


@pytest.mark.timeout(3600)
async def test_the_mirror_is_held_as_well_as_through_the_python_board(tmp_path: Path) -> None:
    built_image(tmp_path)
    summary, truth_um = await _held("qemu", tmp_path)
    assert "hold" in [state["state"] for state in summary["states"]]
    assert summary["faults"] == []
    if _HOLD_S < _LONG_S:
        return
    other, other_um = await _held("python", tmp_path)
    found, wanted = pstdev(truth_um), pstdev(other_um)
    print(f"true standard deviation: C board {found:.4f} µm, Python board {wanted:.4f} µm")
    print(f"readings: {summary['held']} and {other['held']}")
    assert abs(found - wanted) < 0.1 * wanted
