"""The main job for two minutes in real time: lateness with the metrology busy, cycles, and the true
centre.

The reference for lateness is a bare asyncio loop of the same rate on the same machine, measured
just before.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.support.figures import Figure, at_least, at_most

DURATION_S = 120
RATE_HZ = 50.0


async def _bare_loop(seconds: float) -> list[float]:
    deadline, late = time.monotonic(), []
    for _ in range(int(seconds * RATE_HZ)):
        deadline += 1 / RATE_HZ
        await asyncio.sleep(max(0.0, deadline - time.monotonic()))
        late.append(1e3 * (time.monotonic() - deadline))
    return late


def hold_twin(duration_s: float, config: str = "") -> dict[str, Any]:
    """Summary of a real `hold --twin`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bench.toml"
        path.write_text(f"[twin]\nport = 0\n{config}")
        command = [sys.executable, "-m", "membrane_ctrl", "hold", "--twin", "--config", str(path)]
        command += ["--duration", f"{duration_s}s", "--logs", folder, "--json"]
        done = subprocess.run(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, check=True
        )
        summary: dict[str, Any] = json.loads(done.stdout)
        return summary


def run() -> list[Figure]:
    """Figures of one run with everything on."""
    hold_twin(8)  # compiles the kernels before anything is measured
    bare_p99_ms = float(np.percentile(asyncio.run(_bare_loop(10.0)), 99))
    s = hold_twin(DURATION_S)
    late, latency = s["lateness_ms"], s["cycle_latency_ms"]
    entered_s = {x["state"]: x["mono_s"] for x in s["states"]}
    return [
        at_most("true centre, standard deviation", s["true_std_um"], "um", 0.15),
        at_most("true centre, |bias|", abs(s["true_bias_um"]), "um", 0.1),
        at_least("1 s means within +-2 µm", s["in_band_1s_fraction"], "", 1.0),
        at_most(
            "tick lateness p99, metrology busy",
            late["p99"],
            "ms",
            5.0,
            "bare asyncio loop",
            bare_p99_ms,
        ),
        at_most("ticks lost", s["missed_ticks"], "", 0, "ticks", s["ticks"]),
        at_most("standby to hold", entered_s["hold"] - entered_s["check"], "s", 15.0),
        at_least("shape cycles", s["cycles"], "", 1),
        at_most("shape cycles rejected", s["cycles_rejected"], "", 0),
        at_most("last frame to Zernike vector p50", latency["p50"], "ms", 150.0),
        at_most("last frame to Zernike vector p99", latency["p99"], "ms", 150.0),
    ]
