from __future__ import annotations

import pytest

from membrane_ctrl.alarms.book import sign_of_value, signs_of
from membrane_ctrl.config.alarms import AlarmRule
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import parse_tables
from membrane_ctrl.model.errors import InputError
from membrane_ctrl.model.event_lines import from_dict
from membrane_ctrl.model.events import EventLine

HIGH = AlarmRule(name="high", field="error_um", raise_at=10.0, clear_at=3.0, magnitude=True)
LOW = AlarmRule(name="low", field="gauge_pressure_pa", raise_at=100.0, clear_at=200.0)


@pytest.mark.parametrize(
    ("event", "expected"),
    [
        ({"kind": "fault", "name": "late", "latching": True}, [("fault", True, "critical")]),
        ({"kind": "fault", "name": "late", "latching": False}, [("glitch", True, "warning")]),
        ({"kind": "cleared"}, [("glitch", False, "warning")]),
        (
            {"kind": "state", "state": "standby", "from": "fault"},
            [("fault", False, "warning"), ("glitch", False, "warning")],
        ),
        ({"kind": "state", "state": "hold", "from": "settle"}, []),
        ({"kind": "link", "message": "no answer"}, [("link", True, "warning")]),
        ({"kind": "link", "message": "connected again", "up": True}, [("link", False, "warning")]),
        (
            {"kind": "child_ended", "child": "recorder", "exit_code": -9},
            [("recorder_ended", True, "warning")],
        ),
        ({"kind": "child_silent", "child": "recorder"}, [("recorder_ended", True, "warning")]),
        ({"kind": "child_given_up", "child": "recorder"}, [("recorder_ended", True, "warning")]),
        (
            {"kind": "child_restarted", "child": "recorder"},
            [("recorder_ended", False, "warning")],
        ),
        ({"kind": "child_restarted", "child": "screen"}, [("screen_ended", False, "warning")]),
        ({"kind": "recorder_error", "message": "disk full"}, [("recorder", True, "warning")]),
        ({"kind": "recorder_recovered"}, [("recorder", False, "warning")]),
        (
            {"kind": "port_failed", "port": "tls", "message": "x", "again_s": 1.0},
            [("port", True, "warning")],
        ),
        ({"kind": "port_failed", "port": "tls", "message": "x"}, []),
        ({"kind": "port_open"}, [("port", False, "warning")]),
        (
            {"kind": "maintenance", "name": "creep", "message": "x"},
            [("maintenance_creep", True, "warning")],
        ),
        ({"kind": "maintenance_over", "name": "creep"}, [("maintenance_creep", False, "warning")]),
        (
            {"kind": "plausibility", "faulty": "laser", "readings": "x"},
            [("plausibility", True, "warning")],
        ),
        ({"kind": "plausibility", "faulty": "none"}, [("plausibility", False, "warning")]),
        ({"kind": "latch_failed", "message": "disk full"}, [("latch", True, "critical")]),
        ({"kind": "latch_written"}, [("latch", False, "warning")]),
        ({"kind": "lock", "word": "bofak"}, [("lock", True, "warning")]),
        (
            {"kind": "unlock", "word": "bofak"},
            [("lock", False, "warning"), ("lock_storage", False, "warning")],
        ),
        (
            {"kind": "lock_not_stored", "word": "bofak", "message": "disk full"},
            [("lock_storage", True, "critical")],
        ),
        ({"kind": "lock_stored", "word": "bofak"}, [("lock_storage", False, "warning")]),
        ({"kind": "end", "exit": "safety_trip"}, [("run_ended", True, "critical")]),
        ({"kind": "end", "exit": "done"}, []),
        ({"kind": "end", "exit": "interrupted"}, []),
        (
            {"kind": "interlock_opened", "name": "door", "text": "x", "safe_level": "vent"},
            [("interlock", True, "warning")],
        ),
        ({"kind": "interlock_closed", "name": "door"}, [("interlock", False, "warning")]),
        ({"kind": "why", "why": "x"}, []),
        ({}, []),
    ],
)
def test_events_as_signs(event: EventLine, expected: list[tuple[str, bool, str]]) -> None:
    signs = signs_of(from_dict(event).notice_changes({}))
    assert [(sign.name, sign.bad, sign.severity) for sign in signs] == expected


@pytest.mark.parametrize(
    ("faulty", "message"),
    [
        ("laser", "the laser is wrong"),
        ("optics", "the camera is wrong"),
        ("unknown", "disagree (laser"),
    ],
)
def test_the_faulty_sensor_is_named_in_the_operators_words(faulty: str, message: str) -> None:
    line = {"kind": "plausibility", "faulty": faulty, "readings": "laser +20.0 µm, camera +0.1 µm"}
    (sign,) = signs_of(from_dict(line).notice_changes({}))
    assert message in sign.text
    assert "laser +20.0 µm" in sign.text


@pytest.mark.parametrize(
    ("rule", "value", "standing", "bad"),
    [
        (HIGH, 10.1, False, True),
        (HIGH, -10.1, False, True),
        (HIGH, 9.9, False, None),
        (HIGH, 9.9, True, None),
        (HIGH, 3.1, True, None),
        (HIGH, -2.9, True, False),
        (HIGH, 50.0, True, None),
        (HIGH, float("nan"), True, None),
        (LOW, 99.0, False, True),
        (LOW, 150.0, False, None),
        (LOW, 150.0, True, None),
        (LOW, 201.0, True, False),
    ],
)
def test_hysteresis(rule: AlarmRule, value: float, standing: bool, bad: bool | None) -> None:
    sign = sign_of_value(rule, value, standing)
    assert (sign.bad if sign else None) is bad


def test_the_text_names_value_and_limit() -> None:
    sign = sign_of_value(HIGH, -12.345, False)
    assert sign is not None
    assert sign.text == "error_um = 12.35, above 10 for 30 s"


@pytest.mark.parametrize(
    ("alarms", "message"),
    [
        (
            {"rules": [{"name": "a", "field": "nothing", "raise_at": 1, "clear_at": 0}]},
            "unknown telemetry field",
        ),
        ({"rules": [{"name": "a", "field": "error_um", "raise_at": 1, "clear_at": 1}]}, "flap"),
        (
            {"rules": [{"name": "a", "field": "error_um", "raise_at": 1, "clear_at": 0}] * 2},
            "same name",
        ),
        ({"escalation_urls_file": "x"}, "needs urls_file"),
    ],
)
def test_rules_that_are_none_are_one_line(alarms: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_tables({"alarms": alarms}, Config, "lab.toml")


def test_the_notice_of_a_lock_names_text_author_time_and_word() -> None:
    line = {
        "kind": "lock",
        "word": "bofak",
        "text": "hands inside",
        "author": "unix:ann",
        "set_utc": "2026-01-02",
    }
    (sign,) = signs_of(from_dict(line).notice_changes({}))
    assert sign.about == "bofak"
    for part in ("hands inside", "unix:ann", "2026-01-02", "bofak"):
        assert part in sign.text
