"""Opens camera and screen of a configuration once: who they are, how fast, and what the camera finds wrong."""

from __future__ import annotations

import math
import time

import numpy as np

from firmware_iface.roles import LinkError
from membrane_ctrl.acquisition.optical_bench import OpticalBench, configured_bench, open_bench
from membrane_ctrl.acquisition.session import WaitingClock
from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config
from membrane_ctrl.probe import Probe

_GRABS = 10


def probe_optics(config: Config) -> list[Probe]:
    """One probe for camera and screen together, since each is tested with the other; none if none is configured.

    For the main thread only (the screen).
    """
    if config.devices is None or config.devices.camera is None:
        return []
    clock = WaitingClock(RunClock.start())
    try:
        bench = configured_bench(config, clock)
    except LinkError as error:
        return [Probe("camera", config.devices.camera.driver, problem=str(error))]
    name = _where(bench)
    try:
        found = open_bench(bench, config, clock)
        p50_ms, p99_ms, median_adu = _grab(bench)
    except LinkError as error:
        return [Probe("camera", name, problem=str(error))]
    finally:
        bench.close()
    reading = f"{median_adu:.0f} counts"
    problems, notes = "; ".join(found.problems), "; ".join(found.measured)
    return [Probe("camera", name, found.camera, reading, p50_ms, p99_ms, problems, notes)]


def _where(bench: OpticalBench) -> str:
    parts = [device.describe()["port"] for device in (bench.camera, bench.screen)]
    return ", ".join(dict.fromkeys(parts))


def _grab(bench: OpticalBench) -> tuple[float, float, float]:
    """Times of a few exposures (p50, p99) in ms, and the median count of the last."""
    took_ms, median_adu = [], math.nan
    for _ in range(_GRABS):
        begin_s = time.monotonic()
        pixels = bench.camera.grab().pixels
        took_ms.append(1e3 * (time.monotonic() - begin_s))
        median_adu = float(np.median(pixels))
    return float(np.percentile(took_ms, 50)), float(np.percentile(took_ms, 99)), median_adu
