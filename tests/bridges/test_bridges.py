"""One table for all bridges: names and units, what is shown without contact, and who may act."""

from __future__ import annotations

import dataclasses
import json
import math
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from membrane_ctrl.bridges import mqtt
from membrane_ctrl.bridges.bridge import COMMANDS, TABLE, Bridge
from membrane_ctrl.bridges.cli import app
from membrane_ctrl.config.bridges import BridgesConfig, EpicsConfig, MqttConfig, OpcuaConfig
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.model.columns import PUBLISHED
from membrane_ctrl.model.errors import DeviceError, InputError
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.telemetry import FIELDS
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_seen import HoldSeen
from membrane_ctrl.service.published_signals import signal_values
from tests.worlds.port_run import port_run

pytestmark = pytest.mark.usefixtures("slow_answers_allowed")

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "bridges.md"
STRANGE_NUMBERS = (
    "1,000",
    "1_0",
    "٣",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "0x10",
    "",
    " ",
    "1 ",
    "1 2",
    "1;2",
    "--1",
    "½",
)
FAULT = {"code": 7, "name": "laser_lost", "cause": "no light", "remedy": "clean it"}


def seen_hold(**row: float | None) -> HoldSeen:
    status = {"state": "hold", "why": "", "fault": None, "row": {"mono_s": 100.0, **row}}
    return HoldSeen("run-1", "tune", status, time.monotonic(), "")


def figure(**changed: object) -> ShapeEstimate:
    coeffs_um = np.arange(1.0, ZERNIKE_TERMS + 1.0)
    made = ShapeEstimate(
        97.5,
        "full",
        coeffs_um,
        0.0,
        np.eye(ZERNIKE_TERMS),
        500.0,
        0.1,
        0.0,
        1.0,
        1.0,
        80.0,
        0.0,
        "ok",
    )
    return dataclasses.replace(made, **changed)  # type: ignore[arg-type]


def bridge_with(
    role: str = "read",
    seen: HoldSeen | None = None,
    port: Path | None = None,
    name: str = "mirror",
) -> Bridge:
    where = Where(socket=port)
    feed = HoldFeed(where)
    feed.seen = seen or seen_hold()
    return Bridge(feed, Config(bridges=BridgesConfig(role=role, name=name)))  # type: ignore[arg-type]


def test_names_are_unique_and_short_enough() -> None:
    names = [each.name for each in TABLE]
    assert len(set(names)) == len(names)
    for each in TABLE:
        assert len(f"do:{each.name}") <= 60 - 31, (
            "an EPICS name has room for 60 letters with that of the mirror"
        )


def test_the_page_has_the_table() -> None:
    printed = CliRunner().invoke(app, ["names"])
    assert printed.exit_code == 0
    assert printed.stdout in PAGE.read_text(encoding="utf-8")
    assert all(f"`{name}`" in PAGE.read_text(encoding="utf-8") for name in COMMANDS)


def test_each_tick_value_is_that_of_the_tick() -> None:
    row = {name: float(place) for place, name in enumerate(FIELDS)}
    found = signal_values(seen_hold(**row))
    shared = [each.name for each in TABLE if each.name in FIELDS and not each.is_text]
    assert shared == [each.name for each in PUBLISHED]
    assert [found[name] for name in shared] == [row[name] for name in shared]
    assert found["state"] == "hold"
    assert found["why"] == "as it should be"
    assert set(found) == {each.name for each in TABLE} - {"answer"}


def test_without_contact_no_number_is_shown() -> None:
    live = dataclasses.replace(seen_hold(error_um=3.0), figure=figure())
    for seen in (
        dataclasses.replace(live, problem="the run has ended"),
        dataclasses.replace(live, seen_s=time.monotonic() - 60.0),
    ):
        found = signal_values(seen)
        assert found["state"] == "no contact"
        assert "run has ended" in str(found["why"]) or "no status for 60 s" in str(found["why"])
        assert [name for name, value in found.items() if value is not None] == [
            "state",
            "why",
            "run",
        ]


def test_a_figure_has_its_age_and_terms() -> None:
    found = signal_values(
        dataclasses.replace(seen_hold(), figure=figure(sag_change_sigma_um=math.nan))
    )
    assert found["figure_age_s"] == 2.5
    assert [found[f"z{j}_um"] for j in range(4, 12)] == [float(j) for j in range(4, 12)]
    assert found["sag_change_sigma_um"] is None, "JSON has no NaN"


def test_faults_and_notices_are_in_words() -> None:
    seen = seen_hold()
    notices = [
        {"topic": "interlock", "text": "door open"},
        {"topic": "recorder", "text": "disk full"},
    ]
    seen.status.update(fault=FAULT, notices=notices)
    found = signal_values(seen)
    assert found["fault"] == "7 laser_lost: no light; clean it"
    assert found["interlocks"] == "door open"
    assert found["notices"] == "door open; disk full"


@pytest.mark.parametrize(
    ("role", "command", "refused"),
    [
        ("read", "stop", True),
        ("operate", "stop", False),
        ("operate", "keep", True),
        ("tune", "keep", False),
    ],
)
async def test_a_bridge_sends_commands_with_its_role(
    tmp_path: Path, role: str, command: str, refused: bool
) -> None:
    async with port_run(tmp_path) as run:
        bridge = bridge_with(
            role, dataclasses.replace(seen_hold(), name="the-run"), tmp_path / "control.sock"
        )
        answer = await bridge.ask("mqtt", command)
        assert ("needs the role" in answer) is refused
        assert [asked.kind for asked in run.asked] == ([] if refused else [command])
        assert bridge.values()["answer"] == answer
        assert (command in bridge.commands) is not refused


async def test_a_bridge_sets_and_removes_no_lock(tmp_path: Path) -> None:
    async with port_run(tmp_path) as run:
        bridge = bridge_with(
            "tune", dataclasses.replace(seen_hold(), name="the-run"), tmp_path / "control.sock"
        )
        assert "done" in await bridge.ask("mqtt", "latch", "hands inside")
        (command,) = run.asked
        assert command.lock is not None
        assert (command.lock.text, command.lock.author, command.lock.account) == (
            "hands inside",
            "bridge:mqtt",
            "",
        )
        assert not command.from_person
        assert "no such command" in await bridge.ask("mqtt", "unlock", command.lock.word)
        assert run.asked == [command]


def test_the_locks_are_published() -> None:
    seen = seen_hold()
    lock = {"word": "bofak", "text": "hands inside", "author": "unix:ann", "set_utc": "2026-01-02"}
    assert signal_values(seen)["locks"] == ""
    seen = dataclasses.replace(seen, status={**seen.status, "locks": [lock, lock]})
    assert (
        str(signal_values(seen)["locks"]).count(
            '"hands inside" by unix:ann, 2026-01-02, word bofak'
        )
        == 2
    )


async def test_a_hold_that_grants_less_is_not_asked(tmp_path: Path) -> None:
    bridge = bridge_with("tune", dataclasses.replace(seen_hold(), role="read"))
    assert "setpoint refused: needs the role operate" in await bridge.ask("epics", "setpoint", "1")


async def test_a_safety_command_is_sent_before_the_first_contact(tmp_path: Path) -> None:
    """The role at the port is not known yet; the port itself judges."""
    async with port_run(tmp_path) as run:
        bridge = bridge_with("operate", HoldSeen(""), tmp_path / "control.sock")
        assert (await bridge.ask("epics", "stop")).endswith("stop: done")
        assert [asked.kind for asked in run.asked] == ["stop"]


@pytest.mark.parametrize(
    ("command", "given", "message"),
    [
        ("setpoint", "", "enter a number"),
        *(("setpoint", text, "Setpoint: enter a number in µm") for text in STRANGE_NUMBERS),
        *(
            ("setpoint", number, "enter a finite number")
            for number in (math.nan, math.inf, 10**400)
        ),
        ("setpoint", True, "enter a number"),
        ("setpoint", b"\xff\xfe", "setpoint refused: the payload is not text in UTF-8"),
        ("mark", b"\xff\xfe", "mark refused: the payload is not text in UTF-8"),
        ("setpoint", "1e9", "outside the limits"),
        ("mark", "a\nb", "printable"),
        ("mark", "x" * 501, "longer than 500 bytes"),
        ("mark", "ü" * 251, "longer than 500 bytes"),
        ("mark", "x" * 9000, "mark refused: longer than 500 bytes"),
        ("setpoint", "1" * 9000, "longer than 500 bytes"),
        ("gains", "", "no such command"),
        ("__class__", "", "no such command"),
    ],
)
async def test_nonsense_gets_an_answer(
    tmp_path: Path, command: str, given: object, message: str
) -> None:
    async with port_run(tmp_path) as run:
        bridge = bridge_with(
            "tune", dataclasses.replace(seen_hold(), name="the-run"), tmp_path / "control.sock"
        )
        assert message in await bridge.ask("opcua", command, given)
        assert run.asked == [] or given == "1e9", "the tick judges limits"


def test_home_assistant_finds_every_name_and_only_the_allowed_commands() -> None:
    reader = mqtt.discovery(bridge_with(), "membrane/mirror")["components"]
    assert set(reader) == {each.name for each in TABLE}
    assert reader["error_um"]["unit_of_measurement"] == "µm"
    assert "[:255]" in reader["why"]["value_template"]
    found = mqtt.discovery(bridge_with("operate"), "membrane/mirror")
    json.dumps(found, allow_nan=False)
    commands = {name: each for name, each in found["components"].items() if name.startswith("do_")}
    assert "do_keep" not in commands
    assert commands["do_stop"]["platform"] == "button"
    limits = Config().limits
    setpoint = commands["do_setpoint"]
    assert (setpoint["min"], setpoint["max"]) == (
        limits.displacement_min_um,
        limits.displacement_max_um,
    )
    ids = [each["unique_id"] for each in found["components"].values()]
    assert len(set(ids)) == len(ids)


@pytest.mark.parametrize(
    "bridge", [{"opcua": OpcuaConfig(host="0.0.0.0")}, {"epics": EpicsConfig(host="::")}], ids=str
)
def test_no_unknown_client_acts_from_another_machine(bridge: dict[str, object]) -> None:
    BridgesConfig(**bridge)  # type: ignore[arg-type]
    with pytest.raises(ValidationError, match="does not know who acts from another machine"):
        BridgesConfig(role="operate", **bridge)  # type: ignore[arg-type]
    BridgesConfig(role="operate", mqtt=MqttConfig(host="broker.lab"))  # the broker knows its users


def test_no_bridge_is_reported(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["--logs", str(tmp_path)])
    assert isinstance(done.exception, InputError)
    assert "add [bridges.mqtt], [bridges.opcua] or [bridges.epics]" in str(done.exception)


@pytest.mark.parametrize("name", ["mqtt", "opcua", "epics"])
def test_a_missing_library_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda library: None)
    (tmp_path / "lab.toml").write_text(f"[bridges.{name}]\n")
    done = CliRunner().invoke(
        app, ["--logs", str(tmp_path), "--config", str(tmp_path / "lab.toml")]
    )
    assert isinstance(done.exception, InputError)
    assert f"pip install 'membrane-ctrl[{name}]'" in str(done.exception)


def test_a_taken_port_is_named(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        bridges = f'bridges.name = "taken_port"\nbridges.epics.ca_port = {port}\n'
        (tmp_path / "lab.toml").write_text(bridges)
        done = CliRunner().invoke(
            app, ["--logs", str(tmp_path), "--config", str(tmp_path / "lab.toml")]
        )
    assert isinstance(done.exception, DeviceError)
    assert f"epics: 127.0.0.1:{port}: address already in use" in str(done.exception)


async def test_a_missing_password_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"bridges.mqtt.password_file: .*none"):
        await mqtt.serve(MqttConfig(password_file=str(tmp_path / "none")), bridge_with())
