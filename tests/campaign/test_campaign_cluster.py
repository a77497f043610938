"""The trials on a Dask cluster of two workers (extra `dask`): the same figures to twelve digits.

The last digits depend on where an array lies in memory, which differs for one that came over a
wire.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.cli import run
from tests.support.dask_cluster import PATIENT, cluster

pytestmark = pytest.mark.campaign
SAME = 1e-12
QUIET_S = 120.0  # a process that used no processor for so long hangs


def processor_s(process: subprocess.Popen[str]) -> int:
    """Ticks of the processor that a process has used."""
    numbers = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return int(numbers[11]) + int(numbers[12])


def finished(process: subprocess.Popen[str]) -> None:
    """Wait as long as it gets on, however slow the machine is."""
    used = -1
    while process.poll() is None:
        try:
            process.wait(QUIET_S)
        except subprocess.TimeoutExpired:
            now = processor_s(process)
            if now == used:
                process.kill()
                raise AssertionError("the command does not get on") from None
            used = now
    assert process.returncode == 0


def figures(folder: Path, out: Path, *options: str) -> dict[str, Any]:
    """uncertainty.json without its times, from a process of its own."""
    command = [
        sys.executable,
        "-m",
        "membrane_ctrl",
        "uncertainty",
        str(folder),
        "--trials",
        "300",
        "--seed",
        "4",
    ]
    with subprocess.Popen(
        [*command, "--out", str(out), *options], text=True, env=os.environ | PATIENT
    ) as process:
        finished(process)
    table: dict[str, Any] = json.loads((out / "uncertainty.json").read_text())
    return {name: value for name, value in table.items() if name != "timing_s"}


def numbers(table: Any) -> list[float]:
    """All numbers of a table, in order."""
    if isinstance(table, dict):
        table = list(table.values())
    if isinstance(table, list):
        return [number for each in table for number in numbers(each)]
    return [float(table)] if isinstance(table, float) else []


def test_two_workers_give_the_same_figures(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    assert run(["simulate", str(folder), "--shrink", "12"]) == 0
    with cluster(tmp_path) as address:
        there = figures(folder, tmp_path / "there", "--scheduler", address)
    here = figures(folder, tmp_path / "here", "--workers", "1")
    assert there.keys() == here.keys()
    assert numbers(there) == pytest.approx(numbers(here), rel=SAME)
    assert len(numbers(here)) > 36
    maps = [np.load(tmp_path / where / "rmse.npz")["rmse_um"] for where in ("here", "there")]
    np.testing.assert_allclose(*maps, rtol=SAME, atol=1e-9)
