"""`check` warns of a pump board that does not protect the mirror by itself."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from patience import patient_check, slow_machine
from test_safe_state import Bench

from firmware_iface.emulators.pump_board import StoredSettings
from membrane_ctrl.commissioning.check import check_config
from membrane_ctrl.config.schema import Config
from membrane_ctrl.config.toml_file import parse_tables


@pytest.fixture
def bench(version: int, tmp_path: Path) -> Iterator[Bench]:
    made = Bench(version, tmp_path)
    yield made
    made.close()


def check(bench: Bench, as_json: bool) -> None:
    """Check a configuration that has the board; its devices can be used."""
    config = parse_tables(tomllib.loads(slow_machine(str(bench.devices.board))), Config, "lab.toml")
    with patient_check():
        assert check_config(config, "lab.toml", as_json) == 0


def board_warnings(bench: Bench, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What the findings state about the board; the devices can be used in any case."""
    check(bench, as_json=True)
    findings = json.loads(capsys.readouterr().out)["findings"]
    return [finding["why"] for finding in findings if finding["field"] == "devices.board"]


@pytest.mark.parametrize("version", [1, 2])
def test_a_board_of_an_earlier_map_is_used_and_warned_of(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    check(bench, as_json=False)
    lines = " ".join(capsys.readouterr().out.split())
    assert (
        "this board's firmware does not stop the pump when its gauge fails; update to map version 3"
        in lines
    )
    assert board_warnings(bench, capsys) == [
        "this board's firmware does not stop the pump when its gauge fails"
    ]


@pytest.mark.parametrize("version", [3])
def test_a_board_that_guards_its_gauge_is_not_warned_of(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    assert board_warnings(bench, capsys) == []


@pytest.mark.parametrize("version", [3])
def test_a_board_without_a_gauge_is_warned_of(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.board.state.stored = StoredSettings(gauge_fitted=False)
    (warning,) = board_warnings(bench, capsys)
    assert "has no over-pressure protection of its own" in warning
