"""The checksum of a tick's outputs: what it covers and what it leaves out."""

from __future__ import annotations

from dataclasses import replace

import pytest

from firmware_iface.roles import BenchCommand
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.controller.tick_checksum import ColumnChoice, output_crc
from membrane_ctrl.model.errors import Exit
from membrane_ctrl.model.events import Fault, StateEntered, Why
from membrane_ctrl.model.telemetry import FIELDS, TelemetryRow

ROW = TelemetryRow(**{name: float(place) for place, name in enumerate(FIELDS)})
FAULT = Fault(
    10,
    "displacement_missing",
    "no valid laser reading",
    "quality 1",
    "3 ticks",
    "hold_flow",
    False,
    "look",
)
OUTPUTS = TickOutputs(BenchCommand(0.3, 0.0), ROW, (FAULT, Why("holding")), None, ((7, ""),), 0)


def crc(outputs: TickOutputs, columns: tuple[str, ...] = FIELDS) -> int:
    return output_crc(outputs, ColumnChoice(columns).pack(outputs.row))


@pytest.mark.parametrize(
    "other",
    [
        replace(OUTPUTS, command=BenchCommand(0.3, 0.1)),
        replace(OUTPUTS, command=BenchCommand(0.30000000000000004, 0.0)),
        replace(OUTPUTS, row=replace(ROW, trim_um=-0.0)),
        replace(OUTPUTS, events=(FAULT,)),
        replace(OUTPUTS, events=(Why("holding"), FAULT)),
        replace(OUTPUTS, events=(replace(FAULT, code=11), Why("holding"))),
        replace(OUTPUTS, events=(replace(FAULT, latching=True), Why("holding"))),
        replace(OUTPUTS, finished=Exit.DONE),
        replace(OUTPUTS, answers=()),
        replace(OUTPUTS, answers=((8, ""),)),
        replace(OUTPUTS, answers=((7, "not now"),)),
        replace(OUTPUTS, clear_mask=1),
    ],
)
def test_another_decision_or_number_is_another_checksum(other: TickOutputs) -> None:
    assert crc(other) != crc(OUTPUTS)


@pytest.mark.parametrize(
    "other",
    [
        replace(
            OUTPUTS,
            events=(
                replace(FAULT, cause="the laser has no reading", remedy="clean it"),
                Why("as is"),
            ),
        ),
        replace(OUTPUTS, events=(replace(FAULT, name="no_laser"), Why("holding"))),
    ],
)
def test_names_and_sentences_do_not_affect_the_checksum(other: TickOutputs) -> None:
    assert crc(other) == crc(OUTPUTS)


def test_a_reworded_refusal_gives_the_same_checksum() -> None:
    refused = replace(OUTPUTS, answers=((7, "not now"),))
    assert crc(refused) == crc(replace(OUTPUTS, answers=((7, "later, please"),)))


def test_a_column_that_the_run_did_not_record_does_not_affect_the_checksum() -> None:
    recorded = tuple(name for name in FIELDS if name != "leak_um_per_s")
    other = replace(OUTPUTS, row=replace(ROW, leak_um_per_s=9e9))
    assert crc(OUTPUTS, recorded) == crc(other, recorded)
    assert crc(OUTPUTS, recorded) != crc(replace(OUTPUTS, row=replace(ROW, trim_um=9e9)), recorded)


def test_columns_that_the_program_does_not_have_are_named() -> None:
    assert ColumnChoice(FIELDS).unknown == ()
    assert ColumnChoice((*FIELDS, "gone_um")).unknown == ("gone_um",)


def test_ends_and_events_in_different_places_are_different() -> None:
    entered = StateEntered("hold", "settle", "")
    assert crc(replace(OUTPUTS, events=(entered,), answers=())) != crc(
        replace(OUTPUTS, events=(), answers=())
    )
