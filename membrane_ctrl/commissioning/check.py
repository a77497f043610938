"""`check`: is the configuration valid, do its devices answer, and what would `hold` do with them?

`conformance`: does a pump board keep its specification?
"""

import asyncio
import contextlib
import json
import math
import time
from collections.abc import Awaitable, Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from rich.table import Table

from firmware_iface import conformance, role_bench, roles
from firmware_iface.drivers.pump_board import NO_CLAIM, PumpBoard
from membrane_ctrl.acquisition import driver_check, optical_bench, waiting_clock
from membrane_ctrl.acquisition.figure_mode import choose_figure_mode
from membrane_ctrl.alarms.addresses import require_sendable
from membrane_ctrl.commissioning import interlock_check
from membrane_ctrl.config.alarms import AlarmsConfig
from membrane_ctrl.config.bridge_access import describe_bridges
from membrane_ctrl.config.needed_packages import NeededPackage, list_missing_packages
from membrane_ctrl.config.port import SOCKET_NAME, PortConfig
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.control_port import sockets
from membrane_ctrl.controller.cross_check import cross_check, require_sound
from membrane_ctrl.controller.sample_rate import FRESH_SHARE_LEAST
from membrane_ctrl.geometry.run_geometry import read_configured_geometry
from membrane_ctrl.instruments import (
    bench,
    device_claim,
    device_names,
    driver_loading,
    lock_keys,
    lock_store,
    role_drivers,
)
from membrane_ctrl.model import errors, plain_json, run_status, terminal
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.optional import describe_missing, find_missing_page_library
from membrane_ctrl.processes import machine_grants

_READS = 100
_LONGEST_S = 2.0  # slow devices get fewer reads
_SAMPLES_S = 0.5  # so long is read at least, to measure the rate of samples
_BACK_OFF_S = 0.2  # pause on a bus after a device that could not be opened
_GRABS = 10


@dataclass(frozen=True, slots=True)
class DeviceProbe:
    """Result of probing one device."""

    role: str  # role it fills; "board" for all roles
    device: str  # port and settings
    identity: str = ""  # identity of the device that answered
    reading: str = ""  # one value, with its unit
    latency_p50_ms: float = math.nan  # of a read; NaN without one
    latency_p99_ms: float = math.nan
    problem: str = ""  # what is wrong and what to do; empty if nothing
    notes: str = ""  # information that is not a problem
    facts: roles.BenchIdentity | None = None  # limits of the device that answered
    samples_hz: float = math.nan  # new samples of the displacement a second; NaN if not measured


def check_config(config: Config, source: str, as_json: bool) -> int:
    """Check the configuration, probe the devices and report.

    Parameters
    ----------
    config : Config
        The configuration.
    source : str
        Its file, for messages.
    as_json : bool
        Print the report as JSON.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError
        With one line per bad setting.
    DeviceError
        After the report: a device cannot be used.
    """
    findings = dict.fromkeys(require_sound(config, source))  # before touching any device
    if config.devices is not None:
        bench.require_separate_ports(config.devices)
        driver_check.require_optics(config.devices)
    # Each device is opened alone and identified; facts of several may contradict each other.
    probes, circuits = probe_all_devices(config)
    for probe in probes:
        findings |= dict.fromkeys(cross_check(config, probe.facts))
    missing = list_missing_packages(config)
    # What `hold` would do with this configuration.
    would = _describe_hold(config)
    if samples := _describe_samples(config, probes):
        would["samples"] = samples
    if config.interlocks:
        would["interlocks"] = interlock_check.describe_effect(circuits)
    if as_json:
        listed = [
            {key: value for key, value in asdict(probe).items() if key != "facts"}
            for probe in probes
        ]
        found = [asdict(finding) for finding in findings]
        found += [_describe_package(each) for each in missing]
        report = {
            "schema": "membrane-check/1",
            "source": source,
            "devices": listed,
            "interlocks": [asdict(circuit) for circuit in circuits],
            "findings": found,
            "would": would,
        }
        print(plain_json.dumps(report))
    else:
        warnings = [finding.line(source) for finding in findings if finding.severity == "warning"]
        warnings += [f"{source}: {each.missing_line}" for each in missing]
        _print_probes(source, probes, circuits, would, warnings)
    # The exit code states the worst finding: configuration, then devices, then interlocks.
    refused = [finding.line(source) for finding in findings if finding.severity == "error"]
    if refused:
        raise errors.FindingsError(refused)
    wrong = [probe for probe in probes if probe.problem]
    if wrong:
        raise errors.DeviceError(
            f"{len(wrong)} of {len(probes)} devices cannot be used; {wrong[0].role}: "
            f"{wrong[0].problem}"
        )
    lost = [circuit for circuit in circuits if circuit.problem]
    if lost:
        raise errors.DeviceError(f"interlock {lost[0].name}: {lost[0].problem}")
    return errors.Exit.DONE


def probe_all_devices(
    config: Config,
) -> tuple[list[DeviceProbe], list[interlock_check.InterlockProbe]]:
    """Probe devices and interlocks, except those (including the
    screen) that another program uses.
    """
    devices = config.devices
    if devices is None:
        return probe_optics(config), []
    # Opening an instrument stops its pump or changes its settings: never while a hold has it.
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(device_claim.claim_devices(device_names.list_device_names(devices)))
        except errors.DeviceError as error:
            return [
                DeviceProbe(
                    "board" if devices.board else "devices", devices.name, problem=str(error)
                )
            ], []
        probes = asyncio.run(_make_probes(devices, not config.by_optics))
        circuits = asyncio.run(interlock_check.probe_interlocks(devices))
        return probes + probe_optics(config), circuits


async def _make_probes(devices: DevicesConfig, laser: bool) -> list[DeviceProbe]:
    if devices.board is not None:
        return [
            await probe_board(bench.make_pump_board(devices, devices.board), devices.board, laser)
        ]
    return await probe_roles(role_drivers.make_role_devices(devices))


def _print_probes(
    source: str,
    probes: list[DeviceProbe],
    circuits: list[interlock_check.InterlockProbe],
    would: dict[str, str],
    warnings: list[str],
) -> None:
    console = terminal.table_console()
    if probes:
        table = Table("role", "device", "identity", "reading", "p50 / p99 ms")
        for probe in probes:
            latency = ""
            if probe.reading:
                latency = f"{probe.latency_p50_ms:.1f} / {probe.latency_p99_ms:.1f}"
            words = (
                probe.role,
                probe.device,
                probe.identity or "not usable",
                probe.reading,
                latency,
            )
            table.add_row(*words)
        console.print(table)
    for probe in probes:
        for word, line in (("wrong", probe.problem), ("note", probe.notes)):
            if line:
                console.print(f"{probe.role}: {word}: {line}", soft_wrap=True)
    if circuits:
        console.print(interlock_check.make_interlock_table(circuits))
        console.print(interlock_check.HOW_TO_TEST, soft_wrap=True)
    for circuit in circuits:
        if circuit.problem:
            console.print(f"interlock {circuit.name}: wrong: {circuit.problem}", soft_wrap=True)
    for warning in warnings:
        console.print(warning, soft_wrap=True)
    table = Table(title=source, title_justify="left", show_header=False)
    for name, line in would.items():
        table.add_row(name, line)
    console.print(table)


def _describe_hold(config: Config) -> dict[str, str]:
    loop, limits, shape = config.loop, config.limits, config.shape
    feedforward = [
        name
        for name, on in (
            ("barometer", loop.feedforward_barometer),
            ("thermometer", loop.feedforward_temperature),
        )
        if on
    ]
    # How figures would be measured, and why.
    shape_loop = "off"
    decided, figure_mode = choose_figure_mode(config)
    if shape.enabled and figure_mode is not None:
        shape_loop = f"{decided.shape.mode}: {figure_mode.reason}"
    elif shape.enabled and shape.mode == "track":
        shape_loop = f"{shape.track_rate_hz:g} figures/s, tracked"
    elif shape.enabled:
        shape_loop = f"a cycle every {shape.period_s:g} s"
    devices = "none: only `hold --twin` can run"
    if config.devices:
        devices = config.devices.name
    return {
        "devices": devices,
        "hold": f"{loop.setpoint_um:g} µm at {loop.rate_hz:g} Hz, limits "
        f"{limits.displacement_min_um:g} .. {limits.displacement_max_um:g} µm and "
        f"{limits.gauge_pressure_max_pa:g} Pa",
        "gains": run_status.gains_words(loop.model_dump(), None),
        "feed-forward": " and ".join(feedforward) or "off",
        "geometry": _describe_geometry(config),
        "shape loop": shape_loop,
        "locks": _describe_locks(config),
        "control port": _describe_port(config.port),
        **_describe_machine(),
        "alarms": _describe_alarms(config.alarms),
        "page": _describe_page(config),
        "bridges": describe_bridges(config.bridges),
    }


def _describe_machine() -> dict[str, str]:
    """What this machine would grant the ticks of a hold."""
    found = machine_grants.find_grants()
    return {
        "ticks run with": found.scheduling,
        "memory": found.memory_words,
        "processors": found.processor_words,
        "clock": found.clock_source or "unknown",
    }


def _describe_port(port: PortConfig) -> str:
    """Where the control port would listen. Raises InputError for an unknown group."""
    if not port.enabled:
        return "off"
    if port.group is not None:
        sockets.group_id(port.group)
    return port.socket or f"{SOCKET_NAME} beside the run folders"


def _describe_package(needed: NeededPackage) -> dict[str, str]:
    """A package that is missing, as the other findings are described."""
    return {
        "severity": "warning",
        "field": needed.table,
        "value": "",
        "why": f"needs {needed.package}, which is not installed",
        "remedy": needed.missing_line.partition(": ")[2],
    }


def _describe_page(config: Config) -> str:
    """Where the page would be."""
    if not config.port.enabled:
        return "none: port.enabled = false"
    if (missing := find_missing_page_library()) is not None:
        return f"none: {describe_missing('it', missing, 'web')}"
    return "of the service, which the hold starts if none follows its runs"


def _describe_locks(config: Config) -> str:
    """The locks that keep a hold down."""
    if config.devices is None:
        return "none"
    found = lock_store.LockStore.of_machine().find_locks(lock_keys.list_device_keys(config.devices))
    if not found:
        return "none"
    return lock_store.format_locked_line([each.lock for each in found])


def _describe_alarms(alarms: AlarmsConfig) -> str:
    """Who would get alarms. Raises InputError or DeviceError if they cannot be sent."""
    require_sendable(alarms)
    if alarms.urls_file is None:
        return "not sent: no alarms.urls_file"
    return f"{len(alarms.rules)} rules besides faults, to those in {alarms.urls_file}"


def _describe_geometry(config: Config) -> str:
    """The geometry that cycles would use. Raises InputError for an unusable file."""
    there = read_configured_geometry(config)
    origin = there.origin
    if there.note or not origin.file:
        return there.note or "as stated in [optics.geometry]"
    made = ""
    if origin.calibrated_utc:
        made = f", calibrated {origin.calibrated_utc}"
    return f"{origin.file} (hash {origin.hash}{made})"


def _describe_samples(config: Config, probes: list[DeviceProbe]) -> str:
    """How many new samples of the displacement a tick has; empty if that was not measured."""
    measured = [probe.samples_hz for probe in probes if math.isfinite(probe.samples_hz)]
    if not measured or config.by_optics:
        return ""
    samples_hz, rate_hz = measured[0], config.loop.rate_hz
    found = f"{samples_hz:.0f} of the displacement a second, for {rate_hz:g} ticks"
    if samples_hz >= FRESH_SHARE_LEAST * rate_hz:
        return found
    return (
        f"{found}: the loop acts on new samples only, {samples_hz / rate_hz:.0%} of its ticks. "
        f"Lower loop.rate_hz to {samples_hz:.0f}, or raise the rate of the sensor"
    )


def _measure_samples_hz(
    first: roles.BenchReading | roles.DisplacementSample,
    last: roles.BenchReading | roles.DisplacementSample,
) -> float:
    """New samples a second between two reads, by the device's own counter and time; NaN if these
    do not advance.
    """
    duration_s = last.device_time_s - first.device_time_s
    if duration_s > 0:
        return (last.sample_counter - first.sample_counter) / duration_s
    return math.nan


async def probe_board(board: PumpBoard, name: str, laser: bool = True) -> DeviceProbe:
    """Probe the board without writing, also while another program controls it. Claim and watchdog
    are unaffected.

    Parameters
    ----------
    board : PumpBoard
        Not yet connected.
    name : str
        For the report.
    laser : bool
        Whether the bench must have one.

    Returns
    -------
    DeviceProbe
    """
    try:
        identity = await board.identify()
        timed = await _time_reads(board.read)
    except roles.LinkError as error:
        return DeviceProbe("board", name, problem=str(error))
    finally:
        await board.close()
    reading = timed.last
    who = f"{identity.kind} {identity.firmware}, map {identity.map_version}"
    shown = _describe_board_reading(reading)
    problem = _find_board_problem(reading, laser)
    notes = NO_CLAIM if identity.map_version == 1 else ""
    return DeviceProbe(
        role="board",
        device=name,
        identity=who,
        reading=shown,
        latency_p50_ms=timed.p50_ms,
        latency_p99_ms=timed.p99_ms,
        samples_hz=_measure_samples_hz(timed.first, reading),
        problem=problem,
        notes=notes,
        facts=identity,
    )


def _describe_board_reading(reading: roles.BenchReading) -> str:
    return (
        f"{reading.displacement_um:.2f} µm, {reading.gauge_pressure_pa:.1f} Pa gauge, "
        f"{reading.ambient_pressure_pa:.1f} Pa ambient, {reading.air_temperature_c:.2f} degC"
    )


def _find_board_problem(reading: roles.BenchReading, laser: bool) -> str:
    if reading.latched_faults:
        return (
            f"faults {reading.latched_faults:#x} are latched (docs/reference/registers.md); "
            "find the cause"
        )
    if laser and not math.isfinite(reading.displacement_um):
        return f"no laser reading (code {reading.displacement_quality}); check its aim"
    if math.isfinite(reading.gauge_pressure_pa):
        return ""
    return "no gauge pressure reading; check the sensor"


async def probe_roles(devices: role_bench.RoleDevices) -> list[DeviceProbe]:
    """Open, read and close each device in turn; a failure does not stop the others."""
    probes = []
    for role, device in devices.by_role().items():
        read, unit = roles.ROLES[role].reads, roles.ROLES[role].unit
        probes.append(await _probe_role(role, device, getattr(device, read), unit))
        if probes[-1].problem:
            await asyncio.sleep(_BACK_OFF_S)
    return probes


async def _probe_role(
    role: str, device: roles.Device, read: Callable[[], Awaitable[Any]], unit: str
) -> DeviceProbe:
    where = device.describe()
    name, notes = where.get("port", ""), where.get("watchdog", "")
    # Open and identify it, time its reads, and close it: then a hold can have it again.
    try:
        found = await role_bench.answer(role, device.open())
        timed = await _time_reads(lambda: role_bench.answer(role, read()))
    except roles.LinkError as error:
        return DeviceProbe(role, name, problem=str(error), notes=notes)
    finally:
        with contextlib.suppress(Exception):
            await device.close()
    identity = " ".join(
        part for part in (found.kind, found.serial, found.firmware, found.detail) if part
    )
    # The last reading decides: a laser has error codes of its own, and a rate of samples.
    problem = ""
    samples_hz = math.nan
    value = timed.last
    if isinstance(value, roles.DisplacementSample):
        if value.quality != 0:
            problem = f"no reading, error code {value.quality}; check aim and manual"
        samples_hz = _measure_samples_hz(timed.first, value)
        value = value.displacement_um
    if not problem and not math.isfinite(value):
        problem = "answers without a reading"
    # Ranges of the sensors, which the configuration must not contradict.
    facts = roles.BenchIdentity(found.kind, 0, found.firmware, math.nan)
    if role == "displacement":
        facts = replace(facts, displacement_range_um=found.shows)
    elif role == "gauge_pressure":
        facts = replace(facts, gauge_range_pa=found.shows)
    return DeviceProbe(
        role=role,
        device=name,
        identity=identity,
        reading=f"{value:.6g} {unit}",
        latency_p50_ms=timed.p50_ms,
        latency_p99_ms=timed.p99_ms,
        samples_hz=samples_hz,
        problem=problem,
        notes=notes,
        facts=facts,
    )


@dataclass(frozen=True, slots=True)
class TimedReads:
    """First and last value of many reads, and percentiles of their duration."""

    first: Any
    last: Any
    p50_ms: float
    p99_ms: float


async def _time_reads(read: Callable[[], Awaitable[Any]]) -> TimedReads:
    """Read many times, and long enough to measure the rate of samples."""
    # Of the values only the first and the last are kept: their counters give the rate of samples.
    took_ms: list[float] = []
    values: list[Any] = []
    started_s = time.monotonic()
    while True:
        begin_s = time.monotonic()
        values = [*values[:1], await read()]
        took_ms.append(1e3 * (time.monotonic() - begin_s))
        await asyncio.sleep(0)
        since_s = time.monotonic() - started_s
        enough = len(took_ms) >= _READS and since_s >= _SAMPLES_S
        if enough or since_s >= _LONGEST_S:
            break
    p50_ms, p99_ms = (float(np.percentile(took_ms, share)) for share in (50, 99))
    return TimedReads(values[0], values[-1], p50_ms, p99_ms)


def probe_optics(config: Config) -> list[DeviceProbe]:
    """Probe camera and screen together; no probe without a camera.
    Call from the main thread only.
    """
    if config.devices is None or config.devices.camera is None:
        return []
    clock = waiting_clock.WaitingClock(RunClock.start())
    name = driver_loading.name_of(config.devices.camera)
    try:
        optics = optical_bench.configured_bench(config, clock)
    except roles.LinkError as error:
        return [DeviceProbe("camera", name, problem=str(error))]
    try:
        name = _find_optics_ports(optics)
        found = optical_bench.open_bench(optics, config, clock)
        p50_ms, p99_ms, median_adu = _time_exposures(optics)
    except roles.LinkError as error:
        return [DeviceProbe("camera", name, problem=str(error))]
    finally:
        optics.close()
    reading = f"{median_adu:.0f} counts"
    problems, notes = "; ".join(found.problems), "; ".join(found.measured)
    return [DeviceProbe("camera", name, found.camera, reading, p50_ms, p99_ms, problems, notes)]


def _find_optics_ports(optics: optical_bench.OpticalBench) -> str:
    parts = [device.describe()["port"] for device in (optics.camera, optics.screen)]
    return ", ".join(dict.fromkeys(parts))


def _time_exposures(optics: optical_bench.OpticalBench) -> tuple[float, float, float]:
    """Duration of some exposures (p50, p99) in ms, and median count of the last."""
    took_ms, median_adu = [], math.nan
    for _ in range(_GRABS):
        begin_s = time.monotonic()
        pixels = optics.camera.grab().pixels
        took_ms.append(1e3 * (time.monotonic() - begin_s))
        median_adu = float(np.median(pixels))
    return float(np.percentile(took_ms, 50)), float(np.percentile(took_ms, 99)), median_adu


def run_conformance(url: str, unit_id: int, as_json: bool) -> int:
    """Test a board, print the findings; the command `conformance`.

    Parameters
    ----------
    url : str
        Of the board.
    unit_id : int
        Modbus unit.
    as_json : bool
        Print them as JSON.

    Returns
    -------
    int
        The exit code, REJECTED if the board fails.

    Raises
    ------
    InputError
        The URL is wrong.
    DeviceError
        The board is locked, does not answer, or another program uses it.
    """
    try:
        with device_claim.claim_devices(device_names.modbus_names(url, unit_id)):
            lock_store.require_unlocked(
                lock_store.LockStore.of_machine(), lock_keys.modbus_keys(url, unit_id)
            )
            findings = asyncio.run(conformance.examine(url, unit_id))
    except ValueError as error:
        raise errors.InputError(str(error)) from None
    except roles.LinkError as error:
        raise errors.DeviceError(str(error)) from None
    passed = not any(finding.problem for finding in findings)
    if as_json:
        checks = [asdict(finding) for finding in findings]
        print(
            json.dumps(
                {
                    "schema": "membrane-conformance/1",
                    "board": url,
                    "passed": passed,
                    "checks": checks,
                }
            )
        )
    else:
        table = Table("check", "result", "docs/reference/firmware.md")
        for finding in findings:
            table.add_row(finding.check, finding.problem or "passed", finding.section)
        terminal.table_console().print(table)
        terminal.table_console().print(
            "conforms" if passed else "does not conform: do not use it to run a pump"
        )
    if passed:
        return errors.Exit.DONE
    return errors.Exit.REJECTED
