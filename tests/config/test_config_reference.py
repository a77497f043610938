"""Every key of the configuration explains itself, and page, editor schema and `config explain` say
the same.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from membrane_ctrl.config import reference
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import dump_toml, list_driver_names, list_sections
from membrane_ctrl.model.errors import InputError

ROOT = Path(__file__).parents[2]
ALL = [(table.title, key) for table in reference.list_tables() for key in table.keys]
# pure numbers, a camera's own unit, the unit of another key
WITHOUT_UNIT = {
    "change_max",
    "clear_at",
    "exposure",
    "film_poisson",
    "film_prestrain",
    "gain",
    "leak_growth_max",
    "raise_at",
    "setpoint_weight",
}
WITHOUT_UNIT |= {"focal_relative", "pitch_relative", "laser_relative", "k1", "k2", "p1", "p2"}
WITHOUT_UNIT |= {"film_sigma_relative", "thickness_sigma_relative", "gas_sigma_relative", "index"}


@pytest.mark.parametrize(("title", "key"), ALL, ids=lambda value: getattr(value, "name", value))
def test_a_key_states_its_meaning_and_when_to_change_it(title: str, key: reference.Key) -> None:
    assert len(key.meaning.split()) >= 2, title
    assert len(key.advice.split()) >= 2, title
    assert key.advice[-1] == "."
    assert key.range
    assert key.default


def test_no_key_of_the_schema_is_left_out() -> None:
    """Counted from the classes, which the reference itself does not walk."""
    missing, listed = (
        [],
        {(table.driver, key.name) for table in reference.list_tables() for key in table.keys},
    )
    todo: list[Any] = [Config]
    for section in todo:
        driver = (list_driver_names(section) or ("",))[0]
        for name, field in section.model_fields.items():
            inner = list_sections(field.annotation)
            todo += inner
            if not inner and name != "driver" and (driver, name) not in listed:
                missing.append((section.__name__, name))
    assert missing == []
    assert len(todo) > 35


def test_a_quantity_has_its_unit() -> None:
    numbers = {
        key.name: key.unit
        for _, key in ALL
        if " .. " in key.range and not key.range.endswith("whole")
    }
    vectors = {
        name
        for name in numbers
        if name in ("rotation", "s_x", "s_y", "distortion", "raw", "value", "limits")
    }
    assert {name for name, unit in numbers.items() if not unit} == WITHOUT_UNIT | vectors
    assert numbers["flow_rate_limit_um_per_s2"] == "µm/s2"
    assert numbers["kp_per_s"] == "1/s"
    assert reference.unit_of("most_per_day") == "1/day"


@pytest.mark.parametrize(
    ("word", "titles", "names"),
    [
        ("loop.kp_per_s", ["[loop]"], ["kp_per_s"]),
        ("kp_per_s", ["[loop]"], ["kp_per_s"]),
        ("[resume]", ["[resume]"], ["faults", "wait_s", "most_per_day"]),
        ("ventus", ['[devices.pump] driver = "ventus"'], ["port", "power_max_mw", "timeout_s"]),
        ("ventus.power_max_mw", ['[devices.pump] driver = "ventus"'], ["power_max_mw"]),
        ("alarms.rules.raise_at", ["[[alarms.rules]]"], ["raise_at"]),
        ("optics.geometry.a_mm", ["[optics.geometry], [twin.geometry]"], ["a_mm"]),
    ],
)
def test_a_word_finds_its_keys(word: str, titles: list[str], names: list[str]) -> None:
    found = reference.find_explained(word)
    assert [table.title for table in found] == titles
    assert [key.name for table in found for key in table.keys] == names


def test_a_role_shows_each_of_its_drivers() -> None:
    found = {table.driver for table in reference.find_explained("devices.pump")}
    assert found == {"bronkhorst_modbus", "bronkhorst_propar", "external", "modbus_map", "ventus"}
    assert {table.driver for table in reference.find_explained("devices.pump.serial")} == {
        "bronkhorst_modbus",
        "bronkhorst_propar",
    }


@pytest.mark.parametrize(
    ("word", "near"),
    [
        ("kp", "kp_per_s"),
        ("lop", "loop"),
        ("loop.kp_per_sec", "loop.kp_per_s"),
        ("zzzz", "config reference"),
    ],
)
def test_a_near_miss_gets_a_suggestion(word: str, near: str) -> None:
    with pytest.raises(InputError, match=near) as caught:
        reference.find_explained(word)
    assert "no such key or table" in str(caught.value)


def problems(text: str) -> list[str]:
    validator = Draft202012Validator(reference.json_schema())
    return [
        f"{error.json_path}: {error.message}"
        for error in validator.iter_errors(tomllib.loads(text))
    ]


def test_the_editor_schema_is_a_schema_with_texts() -> None:
    schema = reference.json_schema()
    Draft202012Validator.check_schema(schema)
    assert schema["$defs"]["LoopConfig"]["properties"]["td_s"]["description"].startswith(
        "Derivative time"
    )


@pytest.mark.parametrize(
    "example", sorted(ROOT.glob("membrane_ctrl/examples/*.toml")), ids=lambda path: path.stem
)
def test_the_editor_accepts_the_examples(example: Path) -> None:
    assert problems(example.read_text()) == []


def test_the_editor_accepts_what_a_run_writes_and_a_height_map_in_a_file() -> None:
    assert problems(dump_toml(Config())) == []
    grid = "[optics.geometry.screen.height_map]\ns_x_mm = [-250, 250]\ns_y_mm = [-250, 250]\n"
    assert problems(grid + "file = 'screen.txt'\n") == []


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("[loop]\nkp_per_s = -1\n", "$.loop.kp_per_s"),
        ("[loop]\nkp_per_s = '0.6'\n", "$.loop.kp_per_s"),
        ("[loop]\nkp = 0.6\n", "$.loop"),
        ("[lop]\n", "$"),
        ("[twin]\nscenario = 'stormy'\n", "$.twin.scenario"),
        ("[devices.pump]\nport = '/dev/x'\n", "$.devices.pump"),
        ("[devices.displacement]\nport = '/dev/x'\nrate_khz = 2\n", "$.devices.displacement"),
        ("[devices.pump]\ndriver = 'ventus'\nport = '/dev/x'\nnode = 3\n", "$.devices.pump"),
        (
            "[[alarms.rules]]\nname = 'Big'\nfield = 'x'\nraise_at = 1\nclear_at = 0\n",
            "$.alarms.rules[0].name",
        ),
    ],
)
def test_the_editor_marks_what_is_wrong(text: str, path: str) -> None:
    assert {problem.split(":")[0] for problem in problems(text)} == {path}
