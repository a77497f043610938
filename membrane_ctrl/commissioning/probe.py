"""Talks to each device of a configuration once: identity, reading, latency, problems."""

import asyncio
import math
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from firmware_iface import role_bench, roles
from firmware_iface.drivers.pump_board import NO_CLAIM, PumpBoard
from membrane_ctrl.acquisition import optical_bench, session
from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.clock import RunClock

_READS = 100
_LONGEST_S = 2.0  # a slow device gets fewer reads
_BACK_OFF_S = 0.2  # rest for a bus after a device that could not be opened


@dataclass(frozen=True, slots=True)
class DeviceProbe:
    """What one device said."""

    role: str  # what it fills; "board" for all of them
    device: str  # port and settings
    identity: str = ""  # who answered
    reading: str = ""  # one value, with its unit
    latency_p50_ms: float = math.nan  # of a read; NaN without one
    latency_p99_ms: float = math.nan
    problem: str = ""  # what is wrong and what to do; empty when nothing is
    notes: str = ""  # information that is not a problem
    facts: roles.BenchIdentity | None = None  # the limits of what answered


async def probe_board(board: PumpBoard, name: str) -> DeviceProbe:
    """Probe the board, whoever controls it: nothing is written, claim and watchdog stay as they are."""
    try:
        identity = await board.identify()
        reading, p50_ms, p99_ms = await _timed(board.read)
    except roles.LinkError as error:
        return DeviceProbe("board", name, problem=str(error))
    finally:
        await board.close()
    who = f"{identity.kind} {identity.firmware}, map {identity.map_version}"
    said, problem = _board_reading(reading), _board_problem(reading)
    notes = NO_CLAIM if identity.map_version == 1 else ""
    return DeviceProbe("board", name, who, said, p50_ms, p99_ms, problem, notes, identity)


def _board_reading(reading: roles.BenchReading) -> str:
    return (
        f"{reading.displacement_um:.2f} um, {reading.gauge_pressure_pa:.1f} Pa gauge, "
        f"{reading.ambient_pressure_pa:.1f} Pa ambient, {reading.air_temperature_c:.2f} degC"
    )


def _board_problem(reading: roles.BenchReading) -> str:
    if reading.latched_faults:
        return f"faults {reading.latched_faults:#x} are latched (docs/registers.md); find out why"
    if not math.isfinite(reading.displacement_um):
        return f"the laser has no value (code {reading.displacement_quality}); check its aim"
    return "" if math.isfinite(reading.gauge_pressure_pa) else "no gauge pressure; check the sensor"


async def probe_roles(devices: role_bench.RoleDevices) -> list[DeviceProbe]:
    """Open, read and close each device in turn; a failed one does not hide the next."""
    reads: dict[str, tuple[Callable[[Any], Callable[[], Awaitable[Any]]], str]] = {
        "displacement": (lambda device: device.displacement, "um"),
        "gauge_pressure": (lambda device: device.gauge_pressure_pa, "Pa"),
        "barometer": (lambda device: device.ambient_pressure_pa, "Pa"),
        "thermometer": (lambda device: device.air_temperature_c, "degC"),
        "pump": (lambda device: device.pump_fraction, "of full scale"),
        "vent": (lambda device: device.vent_fraction, "of full scale"),
    }
    probes = []
    for role, device in devices.by_role().items():
        read, unit = reads[role]
        probes.append(await _probe(role, device, read(device), unit))
        if probes[-1].problem:
            await asyncio.sleep(_BACK_OFF_S)
    return probes


async def _probe(role: str, device: roles.Device, read: Callable[[], Awaitable[Any]], unit: str) -> DeviceProbe:
    where = device.describe()
    name, notes = where.get("port", ""), where.get("watchdog", "")
    try:
        found = await device.open()
        value, p50_ms, p99_ms = await _timed(read)
    except roles.LinkError as error:
        return DeviceProbe(role, name, problem=str(error), notes=notes)
    finally:
        await device.close()
    identity = " ".join(part for part in (found.kind, found.serial, found.firmware, found.detail) if part)
    problem = ""
    if isinstance(value, roles.DisplacementSample):
        problem = "" if value.quality == 0 else f"no value, error code {value.quality}; check its aim and its manual"
        value = value.displacement_um
    if not problem and not math.isfinite(value):
        problem = "it answers, but has no value"
    facts = roles.BenchIdentity(found.kind, 0, found.firmware, math.nan)
    if role == "displacement":
        facts = replace(facts, displacement_range_um=found.shows)
    elif role == "gauge_pressure":
        facts = replace(facts, gauge_range_pa=found.shows)
    return DeviceProbe(role, name, identity, f"{value:.6g} {unit}", p50_ms, p99_ms, problem, notes, facts)


async def _timed(read: Callable[[], Awaitable[Any]]) -> tuple[Any, float, float]:
    """The last value of many reads, and how long they took (p50, p99) in ms."""
    took_ms: list[float] = []
    give_up_s = time.monotonic() + _LONGEST_S
    while len(took_ms) < _READS and time.monotonic() < give_up_s:
        begin_s = time.monotonic()
        value = await read()
        took_ms.append(1e3 * (time.monotonic() - begin_s))
        await asyncio.sleep(0)
    return value, float(np.percentile(took_ms, 50)), float(np.percentile(took_ms, 99))


_GRABS = 10


def probe_optics(config: Config) -> list[DeviceProbe]:
    """One probe for camera and screen, which are tested together; none without a camera. For the main thread only."""
    if config.devices is None or config.devices.camera is None:
        return []
    clock = session.WaitingClock(RunClock.start())
    try:
        bench = optical_bench.configured_bench(config, clock)
    except roles.LinkError as error:
        return [DeviceProbe("camera", config.devices.camera.driver, problem=str(error))]
    name = _where(bench)
    try:
        found = optical_bench.open_bench(bench, config, clock)
        p50_ms, p99_ms, median_adu = _grab(bench)
    except roles.LinkError as error:
        return [DeviceProbe("camera", name, problem=str(error))]
    finally:
        bench.close()
    reading = f"{median_adu:.0f} counts"
    problems, notes = "; ".join(found.problems), "; ".join(found.measured)
    return [DeviceProbe("camera", name, found.camera, reading, p50_ms, p99_ms, problems, notes)]


def _where(bench: optical_bench.OpticalBench) -> str:
    parts = [device.describe()["port"] for device in (bench.camera, bench.screen)]
    return ", ".join(dict.fromkeys(parts))


def _grab(bench: optical_bench.OpticalBench) -> tuple[float, float, float]:
    """Times of some exposures (p50, p99) in ms, and the median count of the last."""
    took_ms, median_adu = [], math.nan
    for _ in range(_GRABS):
        begin_s = time.monotonic()
        pixels = bench.camera.grab().pixels
        took_ms.append(1e3 * (time.monotonic() - begin_s))
        median_adu = float(np.median(pixels))
    return float(np.percentile(took_ms, 50)), float(np.percentile(took_ms, 99)), median_adu
