"""Every configuration in membrane_ctrl/examples/ passes `check` against emulators of the devices
that it names.
"""

from __future__ import annotations

import asyncio
import json
import math
import re
from pathlib import Path

import pytest
from patience import patient_check

from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.config.toml_file import dump_toml, load_toml
from membrane_ctrl.control_port.status import status_table
from membrane_ctrl.model.run_status import RunStatus
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow
from membrane_ctrl.service.hold_seen import HoldSeen
from membrane_ctrl.service.metrics import render_metrics
from membrane_ctrl.sim.lab import Lab
from tests.worlds.still_plant import StillPlant

EXAMPLES = sorted(Path(__file__).parents[1].glob("membrane_ctrl/examples/*.toml"))


def test_there_are_examples() -> None:
    assert {"paper-bench", "all-serial", "all-modbus-tcp", "twin"} <= {
        path.stem for path in EXAMPLES
    }


def test_an_example_is_printed_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["examples"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert set(listed) >= {path.name for path in EXAMPLES} | {
        "membrane-hold@.service",
        "membrane-service.service",
    }
    assert run(["examples", "paper-bench.toml"]) == 0
    assert capsys.readouterr().out == EXAMPLES[0].with_name("paper-bench.toml").read_text()
    assert run(["examples", "../__init__.py"]) == 2
    refusal = capsys.readouterr().err
    assert "no such example; known: " in refusal
    assert "all-modbus-tcp.toml" in refusal


def _without_optics(devices: DevicesConfig) -> DevicesConfig:
    return devices.model_copy(update={"camera": None, "screen": None})


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
async def test_the_example_passes_check(
    example: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load_toml(example, Config)
    plant = StillPlant()
    if config.devices is None:
        assert await asyncio.to_thread(run, ["check", str(example), "--json"]) == 0
        return
    lab = Lab(plant, config.devices)
    try:
        devices = _without_optics(
            await lab.start()
        )  # those: tests/acquisition/test_example_optics.py
        path = tmp_path / "moved.toml"
        path.write_text(dump_toml(config.model_copy(update={"devices": devices})))
        with patient_check():
            code = await asyncio.to_thread(run, ["check", str(path), "--json"])
    finally:
        await lab.stop()
    printed = capsys.readouterr()
    assert code == 0, printed.err
    probes = {probe["role"]: probe for probe in json.loads(printed.out)["devices"]}
    assert set(probes) == (set(devices.roles()) or {"board"})
    assert all(probe["identity"] and probe["latency_p99_ms"] > 0 for probe in probes.values())
    displacement = (probes.get("displacement") or probes["board"])["reading"]
    assert float(displacement.split()[0]) == pytest.approx(12.5, abs=1.0)
    assert all(outputs[0] == 0.0 for outputs in plant.outputs)  # checking moves no gas


async def test_check_names_every_broken_device_and_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    config = load_toml(EXAMPLES[0].with_name("all-serial.toml"), Config)
    assert config.devices is not None
    assert config.devices.barometer is not None
    lab = Lab(StillPlant(), config.devices)
    try:
        devices = await lab.start()
        lab.wires[config.devices.barometer.port].unplug()  # type: ignore[union-attr]
        path = tmp_path / "moved.toml"
        path.write_text(dump_toml(config.model_copy(update={"devices": devices})))
        with patient_check():
            code = await asyncio.to_thread(run, ["check", str(path)])
    finally:
        await lab.stop()
    printed = capsys.readouterr()
    assert code == 4
    assert "1 of 4 devices cannot be used; barometer" in printed.err
    assert "is the adapter plugged in?" in printed.out
    assert "Bronkhorst DMFC" in printed.out  # the others are shown all the same


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            '[devices.displacement]\ndriver = "optoncdt1421"\nport = "/dev/x"\n',
            ["devices.displacement", "optoncdt1420"],
        ),
        (
            '[devices.displacement]\ndriver = "optoncdt1420"\nprot = "/dev/x"\n',
            ["devices.displacement", "port"],
        ),
        (
            '[devices]\nboard = "tcp://h"\n[devices.pump]\ndriver = "ventus"\nport = "/dev/x"\n',
            ["not board and pump"],
        ),
        ('[devices.pump]\ndriver = "ventus"\nport = "/dev/x"\n', ["no device for displacement"]),
        (
            '[devices.displacement]\ndriver = "optoncdt1420"\nport = "/dev/x"\n'
            '[devices.pump]\ndriver = "bronkhorst_modbus"\nlink = '
            '"rtu:///dev/x?baud=19200"\nunit_id = 3\n'
            '[devices.gauge_pressure]\ndriver = "bronkhorst_modbus"\nlink = '
            '"rtu:///dev/y"\nunit_id = 5\n',
            ["displacement and pump name the same port, /dev/x"],
        ),
        (
            '[devices.displacement]\ndriver = "optoncdt1420"\nport = "/dev/x"\n'
            '[devices.pump]\ndriver = "bronkhorst_modbus"\nlink = '
            '"rtu:///dev/y?baud=19200"\nunit_id = 3\n'
            '[devices.gauge_pressure]\ndriver = "bronkhorst_modbus"\nlink = '
            '"rtu:///dev/y"\nunit_id = 5\n',
            ["pump and gauge_pressure name the same port, /dev/y"],
        ),
        ("[devices]\n", ["name the pump board"]),
        ('[devices]\nboard = "serial:1"\n', ["devices.board", "tcp://HOST:PORT"]),
    ],
)
def test_a_wrong_devices_table_is_one_line(
    text: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(text)
    assert run(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"preset": "waveshare"}, "the presets are waveshare_ao8"),
        ({"address": 8}, "waveshare_ao8 has 0 .. 7"),
        ({"raw": (0.0, 30_000.0)}, "the device takes 0 .. 20000"),
    ],
)
def test_a_preset_refuses_what_its_device_does_not_have(
    change: dict[str, object], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = load_toml(EXAMPLES[0].with_name("all-modbus-tcp.toml"), Config)
    assert config.devices is not None
    assert config.devices.pump is not None
    pump = config.devices.pump.model_copy(update=change)
    path = tmp_path / "lab.toml"
    path.write_text(
        dump_toml(
            config.model_copy(update={"devices": config.devices.model_copy(update={"pump": pump})})
        )
    )
    assert run(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert "devices.pump" in line


def test_the_dashboard_queries_metrics_that_exist() -> None:
    dashboard = json.loads(EXAMPLES[0].with_name("grafana.json").read_text())
    status = RunStatus(TelemetryRow(*(0.0 for _ in FIELDS)))
    seen = HoldSeen("run", status=status_table(status), seen_s=math.inf, problem="")
    text = render_metrics({"": seen}).decode()
    served = set(re.findall(r"^(membrane_\w+)", text, re.MULTILINE))
    panels = dashboard["panels"]
    asked = [target["expr"] for panel in panels for target in panel["targets"]]
    asked.append(dashboard["templating"]["list"][1]["query"]["query"])
    for expression in asked:
        names = set(re.findall(r"membrane_\w+", expression))
        assert names, expression
        assert names <= served, expression
    places = [panel["gridPos"] for panel in panels]
    cells = [
        (x, y)
        for p in places
        for x in range(p["x"], p["x"] + p["w"])
        for y in range(p["y"], p["y"] + p["h"])
    ]
    assert len(set(cells)) == len(cells), "no panel covers another"
    assert max(x for x, _ in cells) < 24
    assert len({panel["id"] for panel in panels}) == len(panels)
