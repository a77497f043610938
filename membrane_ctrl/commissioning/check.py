"""`check`: is the configuration right, do its devices answer, and what would `hold` do with them?"""

import asyncio
import contextlib
import json
import math
from dataclasses import asdict

from rich.markup import escape
from rich.table import Table

from membrane_ctrl.alarms.senders import require_sendable
from membrane_ctrl.commissioning.probe import DeviceProbe, probe_board, probe_optics, probe_roles
from membrane_ctrl.config.devices import DevicesConfig
from membrane_ctrl.config.port import AlarmsConfig, PortConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port import sockets
from membrane_ctrl.controller.cross_check import cross_check, require_sound
from membrane_ctrl.geometry.file import geometry_in_force
from membrane_ctrl.instruments import bench
from membrane_ctrl.model import errors, terminal


def check_config(config: Config, source: str, as_json: bool) -> int:
    """Judge the configuration, probe the devices, and report.

    Raises
    ------
    InputError
        A line for each setting that is refused.
    DeviceError
        A device does not answer as it should; after the report.
    """
    findings = dict.fromkeys(require_sound(config, source))  # before a device is touched
    probes = _probed(config)
    for probe in probes:
        findings |= dict.fromkeys(cross_check(config, probe.facts))
    would = _what_would_happen(config)
    if as_json:
        listed = [{key: _plain(value) for key, value in asdict(probe).items() if key != "facts"} for probe in probes]
        found = [asdict(finding) for finding in findings]
        report = {
            "schema": "membrane-check/1",
            "source": source,
            "devices": listed,
            "findings": found,
            "would": would,
        }
        print(json.dumps(report))
    else:
        _show(source, probes, would, [finding.line(source) for finding in findings if finding.severity == "warning"])
    refused = [finding.line(source) for finding in findings if finding.severity == "error"]
    if refused:
        raise errors.FindingsError(refused)
    wrong = [probe for probe in probes if probe.problem]
    if wrong:
        raise errors.DeviceError(
            f"{len(wrong)} of {len(probes)} devices cannot be used; {wrong[0].role}: {wrong[0].problem}"
        )
    return errors.Exit.DONE


def _plain(value: object) -> object:
    """A value that JSON has: None for NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _probed(config: Config) -> list[DeviceProbe]:
    """What the devices say; those that another program uses are left alone, and so is the screen it may show on."""
    devices = config.devices
    if devices is None:
        return probe_optics(config)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(bench.locked(bench.device_names(devices)))
        except errors.DeviceError as error:
            return [DeviceProbe("board" if devices.board else "devices", devices.name, problem=str(error))]
        return asyncio.run(_probes(devices)) + probe_optics(config)


async def _probes(devices: DevicesConfig) -> list[DeviceProbe]:
    if devices.board is not None:
        return [await probe_board(bench.pump_board(devices, devices.board), devices.board)]
    return await probe_roles(bench.role_devices(devices))


def _show(source: str, probes: list[DeviceProbe], would: dict[str, str], warnings: list[str]) -> None:
    console = terminal.table_console()
    if probes:
        table = Table("role", "device", "identity", "reading", "p50 / p99 ms")
        for probe in probes:
            latency = f"{probe.latency_p50_ms:.1f} / {probe.latency_p99_ms:.1f}" if probe.reading else ""
            words = (probe.role, probe.device, probe.identity or "not usable", probe.reading, latency)
            table.add_row(*(escape(word) for word in words))
        console.print(table)
    for probe in probes:
        for word, line in (("wrong", probe.problem), ("note", probe.notes)):
            if line:
                console.print(escape(f"{probe.role}: {word}: {line}"), soft_wrap=True)
    for warning in warnings:
        console.print(escape(warning), soft_wrap=True)
    table = Table(title=f"{source}", title_justify="left", show_header=False)
    for name, line in would.items():
        table.add_row(name, escape(line))
    console.print(table)


def _what_would_happen(config: Config) -> dict[str, str]:
    loop, limits, shape = config.loop, config.limits, config.shape
    feedforward = [
        name
        for name, on in (("barometer", loop.feedforward_barometer), ("thermometer", loop.feedforward_temperature))
        if on
    ]
    return {
        "devices": config.devices.name if config.devices else "none: only `hold --twin` would run",
        "hold": f"{loop.setpoint_um:g} um at {loop.rate_hz:g} Hz, limits {limits.displacement_min_um:g} .. "
        f"{limits.displacement_max_um:g} um and {limits.gauge_pressure_max_pa:g} Pa",
        "gains": f"Kp {loop.kp_per_s:g} 1/s, Ti {loop.ti_s:g} s, Td {loop.td_s:g} s",
        "feed-forward": " and ".join(feedforward) or "off",
        "geometry": _geometry(config),
        "shape loop": f"a cycle every {shape.period_s:g} s" if shape.enabled else "off",
        "control port": _port(config.port),
        "alarms": _alarms(config.alarms),
    }


def _port(port: PortConfig) -> str:
    """Where a hold could be asked. Raises InputError for certificates that cannot be used."""
    if not port.enabled:
        return "off"
    ways = [port.socket or f"{sockets.SOCKET_NAME} beside the run folders"]
    if port.tls is not None:
        sockets.server_context(port.tls)
        ways.append(f"TLS on {port.tls.host}:{port.tls.port}")
    if port.metrics_port is not None:
        ways.append(f"metrics on 127.0.0.1:{port.metrics_port}")
    return ", ".join(ways)


def _alarms(alarms: AlarmsConfig) -> str:
    """Who would be told. Raises InputError or DeviceError for what could not be sent."""
    require_sendable(alarms)
    if alarms.urls_file is None:
        return "nobody is told: no alarms.urls_file"
    return f"{len(alarms.rules)} rules besides faults, to those in {alarms.urls_file}"


def _geometry(config: Config) -> str:
    """What the cycles would measure with. Raises InputError for a file that cannot be used."""
    there = geometry_in_force(config)
    origin = there.origin
    if there.note or not origin.file:
        return there.note or "as [optics.geometry] states it"
    made = f", calibrated {origin.calibrated_utc}" if origin.calibrated_utc else ""
    return f"{origin.file} (hash {origin.hash}{made})"
