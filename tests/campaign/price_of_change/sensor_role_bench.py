"""Shows one sensor role wherever a bench has roles: a program that a changed copy of the source
runs; prints JSON.

python sensor_role_bench.py ROLE FIELD CONFIG
"""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import sys
from dataclasses import replace
from pathlib import Path

from firmware_iface.roles import NO_READING
from membrane_ctrl.cli import run
from membrane_ctrl.commissioning import first_config as wizard
from membrane_ctrl.config.schema import Config, DevicesConfig, LimitsConfig
from membrane_ctrl.config.toml_file import dump_toml, load_toml
from membrane_ctrl.controller.safety import SafetyTable
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.lab import Lab
from tests.worlds.quiet_observation import GOOD
from tests.worlds.still_plant import StillPlant

TICKS = 10


async def checked(path: Path) -> dict[str, str]:
    """Readings of the devices of a configuration, by role, as `check` finds them at emulated
    instruments.
    """
    config = load_toml(path, Config)
    assert config.devices is not None
    lab = Lab(StillPlant(), config.devices)
    printed = io.StringIO()
    try:
        moved = path.with_name("moved.toml")
        moved.write_text(dump_toml(config.model_copy(update={"devices": await lab.start()})))
        with contextlib.redirect_stdout(printed):
            await asyncio.to_thread(run, ["check", str(moved), "--json"])
    finally:
        await lab.stop()
    return {probe["role"]: probe["reading"] for probe in json.loads(printed.getvalue())["devices"]}


def questions() -> list[str]:
    """What the wizard asks somebody who answers no optional question."""
    asked: list[str] = []
    needed = {
        "devices.kind": "instruments",
        "displacement.driver": "keyence_dl_rs1a",
        "pump.driver": "ventus",
        "gauge_pressure.driver": "mks_937b",
    }

    def read_answer(key: str, prompt: str) -> str:
        asked.append(key)
        return needed.get(key, f"/dev/tty{len(asked)}" if key.endswith(".port") else "")

    wizard._read_answer = read_answer
    path = Path("first.toml")
    wizard.write_first_config(path, twin=False, ask=True)
    return asked


def tripped(field: str, value: float) -> str:
    """Name of the rule that a reading trips, empty without one."""
    table = SafetyTable(LimitsConfig())
    observation = replace(GOOD, reading=replace(NO_READING, **{field: value}))
    for _ in range(TICKS):
        rule = table.judge(State.HOLD, observation).rule
    return rule.name if rule else ""


def main() -> None:
    """Print everything as JSON."""
    role, field, config = sys.argv[1:]
    found = {
        "key": role in DevicesConfig.model_fields,
        "checked": asyncio.run(checked(Path(config))),
        "questions": questions(),
        "same": tripped(field, GOOD.gauge_pressure_pa),
        "other": tripped(field, GOOD.gauge_pressure_pa + 100.0),
        "missing": tripped(field, float("nan")),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
