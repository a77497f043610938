"""The trials on a Dask cluster of two workers (extra `dask`): the same figures to the last digit."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from membrane_ctrl.cli import run

pytestmark = pytest.mark.campaign
CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    local = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=2, threads_per_worker=1, **local) as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


def figures(folder: Path, out: Path, *options: str) -> dict[str, Any]:
    """uncertainty.json without its times, from a process of its own."""
    command = [sys.executable, "-m", "membrane_ctrl", "uncertainty", str(folder), "--trials", "300", "--seed", "4"]
    subprocess.run([*command, "--out", str(out), *options], check=True, capture_output=True, timeout=1500)
    table: dict[str, Any] = json.loads((out / "uncertainty.json").read_text())
    return table | {"timing_s": None}


def test_two_workers_give_the_same_figures(tmp_path: Path) -> None:
    pytest.importorskip("distributed", exc_type=ImportError)
    folder, script = tmp_path / "set", tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    assert run(["simulate", str(folder), "--shrink", "12"]) == 0
    with subprocess.Popen(
        [sys.executable, script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as cluster:
        assert cluster.stdout is not None
        address = cluster.stdout.readline().strip()
        there = figures(folder, tmp_path / "there", "--scheduler", address)
        assert cluster.stdin is not None
        cluster.stdin.close()
    here = figures(folder, tmp_path / "here", "--workers", "1")
    assert there == here
    maps = [np.load(tmp_path / where / "rmse.npz")["rmse_um"] for where in ("here", "there")]
    np.testing.assert_array_equal(*maps)
