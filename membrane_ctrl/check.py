"""`check`: is the configuration right, do its devices answer, and what would `hold` do with them?"""

from __future__ import annotations

import asyncio
import json
import math
from dataclasses import asdict

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from membrane_ctrl.alarms.apprise_sender import require_sendable
from membrane_ctrl.bench import open_bench
from membrane_ctrl.calibration.geometry_in_force import geometry_in_force
from membrane_ctrl.config import Config, DevicesConfig
from membrane_ctrl.errors import DeviceError, Exit
from membrane_ctrl.port.tls import server_context
from membrane_ctrl.port.unix import SOCKET_NAME
from membrane_ctrl.port_config import AlarmsConfig, PortConfig
from membrane_ctrl.probe import Probe, probe_board, probe_roles
from membrane_ctrl.probe_optics import probe_optics
from membrane_ctrl.role_devices import role_devices


def check_config(config: Config, source: str, as_json: bool) -> int:
    """Probe and report. Raises DeviceError (one line, after the report) if a device does not answer as it should."""
    probes = asyncio.run(_probes(config.devices)) if config.devices is not None else []
    probes += probe_optics(config)
    would = _what_would_happen(config)
    if as_json:
        listed = [{key: _plain(value) for key, value in asdict(probe).items()} for probe in probes]
        print(json.dumps({"schema": "membrane-check/1", "source": source, "devices": listed, "would": would}))
    else:
        _show(source, probes, would)
    wrong = [probe for probe in probes if probe.problem]
    if wrong:
        raise DeviceError(
            f"{len(wrong)} of {len(probes)} devices cannot be used; {wrong[0].role}: {wrong[0].problem}"
        )
    return Exit.DONE


def _plain(value: object) -> object:
    """A value that JSON has: None for NaN."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


async def _probes(devices: DevicesConfig) -> list[Probe]:
    if devices.board is not None:
        return [await probe_board(open_bench(devices), devices.board)]
    return await probe_roles(role_devices(devices))


def _show(source: str, probes: list[Probe], would: dict[str, str]) -> None:
    console = Console()
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
    table = Table(title=f"{source}: valid", title_justify="left", show_header=False)
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
    ways = [port.socket or f"{SOCKET_NAME} beside the run folders"]
    if port.tls is not None:
        server_context(port.tls)
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
