"""`check`: is the configuration right, do its devices answer, and what would `hold` do with them?"""

from __future__ import annotations

import asyncio
import json
from dataclasses import asdict
from typing import Any

from rich.console import Console
from rich.table import Table

from firmware_iface.roles import BenchIdentity, BenchReading, LinkError
from membrane_ctrl.bench import open_bench
from membrane_ctrl.config import Config
from membrane_ctrl.errors import DeviceError, Exit


def check_config(config: Config, source: str, as_json: bool) -> int:
    """Probe and report. Raises DeviceError (one line) if a device does not answer as it should."""
    devices: dict[str, Any] = {}
    if config.devices is not None:
        identity, reading = asyncio.run(_probe(config))
        devices = {"board": config.devices.board, "identity": asdict(identity), "reading": asdict(reading)}
    would = _what_would_happen(config)
    if as_json:
        print(json.dumps({"schema": "membrane-check/1", "source": source, "devices": devices, "would": would}))
        return Exit.DONE
    table = Table(title=f"{source}: valid", title_justify="left", show_header=False)
    for key, value in devices.items():
        rows = value if isinstance(value, dict) else {key: value}
        for name, entry in rows.items():
            table.add_row(name, f"{entry:g}" if isinstance(entry, float) else str(entry))
    for name, line in would.items():
        table.add_row(name, line)
    Console().print(table)
    return Exit.DONE


async def _probe(config: Config) -> tuple[BenchIdentity, BenchReading]:
    assert config.devices is not None
    bench = open_bench(config.devices)
    try:
        identity = await bench.open()
        return identity, await bench.read()
    except LinkError as error:
        raise DeviceError(f"{config.devices.name}: {error}") from None
    finally:
        await bench.close()


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
        "shape loop": f"a cycle every {shape.period_s:g} s" if shape.enabled else "off",
    }
