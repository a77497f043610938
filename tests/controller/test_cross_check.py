"""Cross-check of the configuration and the board: dangerous values are named, safe ones pass."""

from __future__ import annotations

import asyncio
import math
import os
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from patience import slow_machine

from firmware_iface.emulators.pump_board import BoardSample
from firmware_iface.roles import BenchIdentity
from membrane_ctrl.cli import run
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import load_toml, parse_tables
from membrane_ctrl.controller.cross_check import cross_check
from membrane_ctrl.controller.safety import TABLE
from membrane_ctrl.model.errors import InputError
from tests.worlds.faulty_board import PumpBoardEmulator

EXAMPLES = Path(__file__).parents[2] / "membrane_ctrl" / "examples"
BOARD = {"board": "tcp://127.0.0.1:1"}
ROLES = load_toml(EXAMPLES / "all-modbus-tcp.toml", Config).devices.model_dump(exclude_none=True)  # type: ignore[union-attr]


def config_of(changes: dict[str, Any], devices: dict[str, Any] | None = None) -> Config:
    """The defaults with dotted names changed."""
    tables: dict[str, Any] = {} if devices is None else {"devices": {**devices}}
    for name, value in changes.items():
        *path, key = name.split(".")
        table = tables
        for part in path:
            table[part] = {**table.get(part, {})}
            table = table[part]
        table[key] = value
    return parse_tables(tables, Config, "test")


def severity_of(config: Config, field: str, board: BenchIdentity | None = None) -> str:
    """The worst finding about a field; empty for none."""
    found = {finding.severity for finding in cross_check(config, board) if finding.field == field}
    return "error" if "error" in found else "warning" if found else ""


def test_the_defaults_and_the_examples_are_sound() -> None:
    assert cross_check(Config()) == ()
    assert cross_check(Config(), BenchIdentity("board", 1, "1.0.0", 0.5, 800.0, 1.0)) == ()
    for example in sorted(EXAMPLES.glob("*.toml")):
        found = [
            finding
            for finding in cross_check(load_toml(example, Config))
            if finding.field != "devices.vent"
        ]
        assert found == [], example


# field, what is dangerous, the neighbour that is not
FIELDS: list[tuple[str, Any, Any]] = [
    ("resume.most_per_day", 1000, 24),
    ("limits.stale_s", 10.0, 2.0),
    ("limits.stale_s", 0.029, 0.03),
    ("limits.stuck_s", 600.0, 60.0),
    ("limits.stuck_s", 0.05, 0.07),
    ("limits.lateness_max_ms", 500.0, 400.0),
    ("limits.band_um", 60.0, 59.0),
    ("limits.gauge_pressure_max_pa", 600.0, 750.0),
    ("limits.gauge_step_max_pa", 150.0, 140.0),
    ("limits.gauge_stuck_s", 601.0, 600.0),
    ("limits.gauge_stuck_s", 0.05, 0.07),
    ("limits.gauge_step_max_pa", 4.9, 5.0),
    ("limits.laser_gauge_apart_max_um", 6.9, 7.0),
    ("limits.laser_gauge_drift_max_um", 30.0, 31.0),
    ("limits.leak_growth_max", 1.2, 1.25),
    ("limits.leak_growth_max", 7.7, 7.5),
    ("limits.displacement_min_um", -37_100.0, -37_000.0),
    ("optics.mirror.sag_mm", 250.0, 249.0),
    ("limits.laser_gauge_apart_max_um", 500.0, 100.0),
    ("limits.laser_gauge_drift_max_um", 500.0, 200.0),
    ("limits.step_max_um", 500.0, 400.0),
    ("limits.step_max_um", 3.0, 5.0),
    ("loop.rate_hz", 3.9, 6.0),
    ("states.hold_flow_max_s", 600.0, 60.0),
    ("states.ramp_down_s", 600.0, 60.0),
    ("states.pause_max_s", 1e5, 3600.0),
    ("states.check_timeout_s", 11.0, 11.1),
    ("states.settle_timeout_s", 1.5, 2.0),
    ("states.lower_timeout_s", 0.5, 0.6),
    ("states.inflate_stall_s", 1.0, 1.3),
    ("states.vented_pressure_pa", 400.0, 370.0),
    ("states.vented_pressure_pa", 0.0, 1.0),
    ("pump.stall_fraction", 0.05, 0.1),
    ("pump.stall_fraction", 0.3, 0.22),
    ("pump.start_fraction", 0.9, 0.7),
    ("loop.flow_max_um_per_s", 0.3, 2.0),
    ("loop.kp_per_s", 0.0, 0.3),
    ("loop.kp_per_s", 20.0, 1.0),
    ("loop.kp_per_s", 4.0, 1.0),
    ("loop.barometer_gain_um_per_pa", 0.358, -0.5),
    ("loop.barometer_gain_um_per_pa", -3.58, 0.0),
    ("loop.temperature_gain_um_per_k", -123.0, 0.0),
    ("loop.temperature_gain_um_per_k", 1230.0, 150.0),
    ("loop.bleed_fraction", 0.5, 0.02),
    ("loop.flow_rate_limit_um_per_s2", 1.0, 5.0),
    ("shape.trim_max_um", 600.0, 400.0),
    ("shape.fresh_s", 1.0, 2.0),
    ("shape.time_constant_s", 3.0, 4.0),
    ("shape.trim_rate_max_um_per_s", 10.0, 1.0),
    ("shape.disagreement_max_um", 500.0, 100.0),
    ("alarms.silent_s", 1.0, 5.0),
]
MORE: dict[str, dict[str, Any]] = {
    "alarms.silent_s": {"loop.rate_hz": 1.5, "loop.measurement_filter_s": 1.0},
}


@pytest.mark.parametrize(("field", "dangerous", "sound"), FIELDS)
def test_each_dangerous_value_is_an_error_and_the_nearest_safe_value_is_not(
    field: str, dangerous: Any, sound: Any
) -> None:
    more = MORE.get(field, {})
    assert severity_of(config_of({**more, field: dangerous}), field) == "error"
    assert severity_of(config_of({**more, field: sound}), field) != "error"


WARNINGS: list[tuple[str, Any, Any]] = [
    ("loop.kp_per_s", 2.0, 1.0),
    ("loop.setpoint_ramp_um_per_s", 6.0, 5.0),
    ("loop.flow_max_um_per_s", 6.0, 5.3),
    ("limits.lateness_max_ms", 1.0, 5.0),
    ("limits.following_error_max_um", 500.0, 499.0),
    ("shape.frame_interval_s", 0.3, 0.25),
    ("states.inflate_timeout_s", 500.0, 600.0),
    ("optics.mirror.pressure_pa", 0.0, 600.0),
    ("optics.mirror.pressure_pa", 100.0, 101.0),
]


@pytest.mark.parametrize(("field", "odd", "sound"), WARNINGS)
def test_an_unusual_but_safe_value_is_a_warning(field: str, odd: Any, sound: Any) -> None:
    assert severity_of(config_of({field: odd}), field) == "warning"
    assert severity_of(config_of({field: sound}), field) == ""


DEVICES: list[tuple[str, dict[str, Any], Any, Any]] = [
    ("devices.watchdog_s", BOARD, 10.0, 2.0),
    ("devices.timeout_s", BOARD, 0.48, 0.47),
    ("devices.pump.timeout_s", ROLES, 0.28, 0.27),  # with the vent's 0.2 s on the same line
    ("devices.displacement.timeout_s", ROLES, 0.28, 0.27),
    ("devices.pump.limits", ROLES, [0.2, 1.0], [0.0, 1.0]),
    ("devices.pump.value", ROLES, [0.2, 1.0], [1.0, 0.0]),
    ("devices.pump.limits", ROLES, [0.0, 0.8], [0.0, 1.0]),
    ("devices.vent.limits", ROLES, [0.1, 1.0], [0.0, 1.0]),
]


@pytest.mark.parametrize(("field", "devices", "dangerous", "sound"), DEVICES)
def test_each_danger_of_a_device_is_an_error(
    field: str, devices: dict[str, Any], dangerous: Any, sound: Any
) -> None:
    assert (
        severity_of(config_of({field: dangerous}, {"devices": devices}["devices"]), field)
        == "error"
    )
    assert severity_of(config_of({field: sound}, devices), field) == ""


def test_a_watchdog_shorter_than_some_ticks_is_an_error() -> None:
    config = config_of(
        {"devices.watchdog_s": 0.1, "devices.timeout_s": 0.05, "loop.rate_hz": 2.5}, BOARD
    )
    assert severity_of(config, "loop.rate_hz") == "error"


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"limits.displacement_max_um": 2001.0}, "limits.displacement_max_um"),
        ({"limits.displacement_min_um": -2001.0}, "limits.displacement_min_um"),
        ({"limits.gauge_pressure_max_pa": 1050.0}, "limits.gauge_pressure_max_pa"),
    ],
)
def test_a_limit_that_its_sensor_cannot_show(changes: dict[str, float], field: str) -> None:
    assert severity_of(config_of(changes, ROLES), field) == "error"
    found = BenchIdentity(
        "composed",
        0,
        "",
        0.5,
        displacement_range_um=(-2000.0, 2000.0),
        gauge_range_pa=(-100.0, 1050.0),
    )
    assert severity_of(config_of(changes), field, found) == "error"
    assert severity_of(Config(), field, found) == ""


@pytest.mark.parametrize(
    ("zero", "sound"), [(5.0, True), (9.6, True), (9.4, True), (0.4, False), (1.9, False)]
)
def test_the_range_of_a_laser_about_its_zero(zero: float, sound: bool) -> None:
    """10 mm, the bowl nearer when deeper: with the zero at 0.4 mm a limit of 500 µm is in front of
    the range.
    """
    laser = {"driver": "optoncdt1420", "port": "/dev/x", "range_mm": 10.0, "zero_mm": zero}
    shallow = {"limits.displacement_min_um": -300.0, "shape.trim_max_um": 100.0}
    config = config_of(shallow, {**ROLES, "displacement": laser})
    assert (severity_of(config, "limits.displacement_max_um") == "") == (zero >= 0.5)
    deep = config_of({"limits.displacement_max_um": 2000.0}, {**ROLES, "displacement": laser})
    assert (severity_of(deep, "limits.displacement_max_um") == "") == sound


def test_limits_beyond_those_of_the_board_are_errors() -> None:
    strict = BenchIdentity("board", 1, "1.0.0", 0.5, 700.0, 0.7)
    fields = {finding.field for finding in cross_check(Config(), strict)}
    assert fields == {
        "limits.gauge_pressure_max_pa",
        "loop.flow_max_um_per_s",
        "states.actuator_test",
    }
    weaker = config_of(
        {
            "limits.gauge_pressure_max_pa": 700.0,
            "loop.flow_max_um_per_s": 3.5,
            "states.actuator_test": False,
        }
    )
    assert cross_check(weaker, strict) == ()


@pytest.mark.parametrize("version", [1, 2])
def test_a_board_that_does_not_guard_its_gauge_is_a_warning(version: int) -> None:
    old = BenchIdentity("board", version, "1.0.0", 0.5, 800.0, 1.0)
    (finding,) = cross_check(config_of({}, BOARD), old)
    assert finding.line("lab.toml") == (
        "lab.toml: warning: devices.board = tcp://127.0.0.1:1: this board's firmware does "
        "not stop the pump when its "
        "gauge fails; update to map version 3"
    )


def test_a_board_without_a_gauge_is_a_warning() -> None:
    guarded = BenchIdentity("board", 3, "1.1.0", 0.5, 800.0, 1.0, gauge_timeout_s=15.0)
    assert cross_check(config_of({}, BOARD), guarded) == ()
    (finding,) = cross_check(config_of({}, BOARD), replace(guarded, gauge_fitted=False))
    assert (finding.severity, finding.field) == ("warning", "devices.board")
    assert "no over-pressure protection of its own" in finding.why


def test_a_ramp_that_the_board_cuts_off_is_a_warning() -> None:
    """The rule needs ten ticks of 20 ms to notice a missing gauge."""
    board = BenchIdentity("board", 3, "1.1.0", 0.5, 800.0, 1.0, gauge_timeout_s=10.3)
    assert severity_of(config_of({}, BOARD), "states.ramp_down_s", board) == ""
    board = replace(board, gauge_timeout_s=10.1)
    assert severity_of(config_of({}, BOARD), "states.ramp_down_s", board) == "warning"
    assert (
        severity_of(config_of({}, BOARD), "states.ramp_down_s", replace(board, gauge_fitted=False))
        == ""
    )


def test_single_instruments_have_no_board_to_warn_of() -> None:
    assert cross_check(config_of({}, ROLES), BenchIdentity("composed", 0, "", 0.5)) == ()


@pytest.mark.parametrize("room", [("loop.setpoint_um", 450.0), ("loop.setpoint_um", -1950.0)])
def test_a_setpoint_whose_trim_reaches_the_limit(room: tuple[str, float]) -> None:
    assert severity_of(config_of(dict([room])), "shape.trim_max_um") == "error"
    assert (
        severity_of(config_of({**dict([room]), "shape.enabled": False}), "shape.trim_max_um") == ""
    )


def test_a_misspelt_fault_gets_the_nearest_name() -> None:
    (finding,) = cross_check(config_of({"resume.faults": ["link_lost", "watchdog_triped"]}))
    assert (finding.severity, finding.field, finding.remedy) == (
        "error",
        "resume.faults.1",
        "did you mean watchdog_tripped?",
    )


def test_only_faults_whose_cause_is_seen_to_have_gone_may_resume() -> None:
    may = {
        *("link_lost", "device_silent", "watchdog_tripped", "late", "pressure_missing"),
        *("displacement_missing", "displacement_frozen", "displacement_jump", "film_unseen"),
        *("no_answer", "watchdog_by_link", "link_slow"),  # a link whose answers are seen again
    }
    assert {rule.name for rule in TABLE if rule.may_resume} == may
    for rule in TABLE:
        refused = (
            severity_of(config_of({"resume.faults": [rule.name]}), "resume.faults.0") == "error"
        )
        assert refused == (not rule.may_resume), rule.name


@pytest.mark.parametrize(
    ("rule", "refused"),
    [
        ({"field": "fault", "raise_at": 99.0, "clear_at": 0.0}, True),
        ({"field": "fault", "raise_at": 20.0, "clear_at": 0.0}, False),
        ({"field": "pump_fraction", "raise_at": 1.0, "clear_at": 0.5}, True),
        ({"field": "gauge_pressure_pa", "raise_at": 800.0, "clear_at": 700.0}, True),
        ({"field": "gauge_pressure_pa", "raise_at": 100.0, "clear_at": 800.0}, False),
    ],
)
def test_an_alarm_that_can_never_be_raised(rule: dict[str, Any], refused: bool) -> None:
    config = config_of({"alarms.rules": [{"name": "mine", **rule}]})
    assert (severity_of(config, "alarms.rules.0.raise_at") == "error") == refused


def geometry(alpha_deg: float) -> dict[str, Any]:
    return {"a_mm": 2672.0, "b_mm": 2871.0, "alpha_deg": alpha_deg}


@pytest.mark.parametrize("field", ["optics.geometry", "twin.geometry"])
def test_an_angle_in_radians(field: str) -> None:
    findings = cross_check(config_of({field: geometry(1.412)}))
    assert [(f.severity, f.field, f.remedy) for f in findings] == [
        ("error", f"{field}.alpha_deg", "as radians it is 80.9 deg")
    ]
    assert cross_check(config_of({field: geometry(175.0)}))


def test_a_camera_behind_the_mirror() -> None:
    poses = {
        "camera": {
            "position_mm": [0.0, 0.0, -2000.0],
            "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        },
        "screen": {"origin_mm": [0.0, 0.0, 2000.0], "s_x": [1, 0, 0], "s_y": [0, 1, 0]},
    }
    assert (
        severity_of(config_of({"optics.geometry": poses}), "optics.geometry.camera.position_mm")
        == "error"
    )


def test_values_set_by_a_program_must_be_numbers_too() -> None:
    config = Config()
    broken = config.model_copy(
        update={"loop": config.loop.model_copy(update={"ti_s": math.nan, "td_s": math.inf})}
    )
    assert [finding.field for finding in cross_check(broken)] == ["loop.ti_s", "loop.td_s"]


@pytest.mark.parametrize(
    "text",
    [
        "[loop]\nkp_per_s = true\n",
        "[twin]\nseed = true\n",
        "[optics.camera]\nprincipal_px = [true, 1.0]\n",
        "[[alarms.rules]]\nname = 'x'\nfield = 'error_um'\nraise_at = true\nclear_at = 0.0\n",
        "[devices.pump]\ndriver = 'ventus'\nport = 'x'\ntimeout_s = true\n",
    ],
)
def test_true_is_not_accepted_as_a_number(text: str) -> None:
    with pytest.raises(InputError, match=r"true.* is neither a number nor a text"):
        parse_tables(tomllib.loads(text), Config, "lab.toml")
    assert (
        parse_tables({"states": {"actuator_test": False}}, Config, "lab.toml").states.actuator_test
        is False
    )


DANGEROUS = (
    "[states]\nhold_flow_max_s = 600.0\n[loop]\nbarometer_gain_um_per_pa = "
    "0.358\nsetpoint_ramp_um_per_s = 6.0\n"
)


@pytest.mark.parametrize("command", [["check"], ["hold", "--twin", "--duration", "1s", "--config"]])
def test_every_finding_is_a_line_and_no_file_is_written(
    command: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab.toml").write_text(DANGEROUS)
    assert run([*command, "lab.toml"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.split(" = ")[0] for line in lines if line.startswith("membrane-ctrl: ")] == [
        "membrane-ctrl: lab.toml: states.hold_flow_max_s",
        "membrane-ctrl: lab.toml: loop.barometer_gain_um_per_pa",
        "membrane-ctrl: lab.toml: warning: loop.setpoint_ramp_um_per_s",
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["lab.toml"]


class StillPlant:
    """A mirror that does not move."""

    def __init__(self) -> None:
        self.outputs: list[float] = []

    def sample(self) -> BoardSample:
        return BoardSample(0.0, 0, 600.0, 101_325.0, 22.5, 23.0, len(self.outputs), 0.0)

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        self.outputs.append(pump_fraction)


@pytest.mark.parametrize("command", [["check"], ["hold", "--config"]])
async def test_a_limit_beyond_that_of_the_board_is_refused_after_reading_the_board(
    command: list[str], tmp_path: Path
) -> None:
    plant = StillPlant()
    board = PumpBoardEmulator(plant)
    await board.start()
    try:
        (tmp_path / "lab.toml").write_text(
            slow_machine(f"tcp://127.0.0.1:{board.port}") + "gauge_pressure_max_pa = 801.0\n"
        )
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "membrane_ctrl", *command, "lab.toml"),
            cwd=tmp_path,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
        )
        _, output = await process.communicate()
    finally:
        await board.stop()
    assert process.returncode == 2
    (line,) = (line for line in output.decode().splitlines() if line.startswith("membrane-ctrl: "))
    assert "limits.gauge_pressure_max_pa = 801: the board itself vents at 800 Pa" in line
    assert os.listdir(tmp_path) == ["lab.toml"]  # noqa: PTH208
    assert max(plant.outputs) == 0.0
