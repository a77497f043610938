"""What the controller decided in each scenario, stored in `expected.npz`, and the comparison.

The file contains numbers only, so that it stays valid when columns, events, states or sentences get
other names. For each scenario `NAME` it has

=====================  ==================  =====================================================
`NAME/commands`        (ticks, 2) float64  pump and vent fraction that each tick commands
`NAME/codes`           (ticks, 6) int32    state, state of the shape loop, safe level, fault, board
                                           latches to clear, exit code (-1 while the run continues)
`NAME/events`          (events, 3) int32   tick, identity, count of numbers. Events of one kind and
                                           one code have one identity; identities count from 0 in
                                           order of appearance
`NAME/event_numbers`   (numbers,) float64  the numbers of all events, one after the other
`NAME/answers`         (answers, 3) int32  tick, number of the command, 1 if it was refused
`NAME/rows`            (blocks, columns)   values of every hundredth telemetry row, in rising order
`NAME/row_digests`     (blocks,) uint32    checksum of all rows of a block of a hundred ticks, each
                                           in rising order of its values
=====================  ==================  =====================================================

On the processor and with the libraries of the recording, all bits must be the same. Elsewhere codes
and events must be the same, and numbers within 1e-9 of their size (of 1 if they are smaller).

`python -m tests.recorded_scenarios.recording` records the scenarios again, after a change of the
controller's behaviour that is wanted, and after a new column.
"""

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.model.arithmetic import describe_arithmetic
from membrane_ctrl.model.events import Event
from membrane_ctrl.replay.numbers import NUMBERS_WITHIN
from tests.recorded_scenarios.scenarios import SCENARIOS
from tests.worlds.controller_runs import Story, Ticks, record_story

PATH = Path(__file__).with_name("expected.npz")
BLOCK_TICKS = 100
_ARITHMETIC = "arithmetic"  # key of the description of processor and libraries

Recording = dict[str, np.ndarray]


def run_scenario(story: Story) -> Recording:
    """Run a scenario and return its arrays, by the names of the table above."""
    ticks, _ = record_story(story)
    rows = [_sorted_values(outputs) for _, outputs in ticks]
    blocks = [rows[first : first + BLOCK_TICKS] for first in range(0, len(rows), BLOCK_TICKS)]
    return {
        "commands": np.array([_commanded_fractions(outputs) for _, outputs in ticks]),
        "codes": np.array([_codes_of(outputs) for _, outputs in ticks], dtype=np.int32),
        **_collect_events(ticks),
        "answers": _collect_answers(ticks),
        "rows": np.array([block[-1] for block in blocks]),
        "row_digests": np.array(
            [zlib.crc32(np.array(block).tobytes()) for block in blocks], dtype=np.uint32
        ),
    }


def _commanded_fractions(outputs: TickOutputs) -> tuple[float, float]:
    return outputs.command.pump_fraction, outputs.command.vent_fraction


def _codes_of(outputs: TickOutputs) -> tuple[int, ...]:
    row = outputs.row
    exit_code = -1 if outputs.finished is None else int(outputs.finished)
    return (
        int(row.state),
        int(row.shape_state),
        int(row.safe_level),
        int(row.fault),
        outputs.clear_mask,
        exit_code,
    )


def _sorted_values(outputs: TickOutputs) -> np.ndarray:
    """The values of a row in rising order, which do not depend on the order of the columns."""
    values = np.sort(np.frombuffer(outputs.row.pack()))
    values[np.isnan(values)] = np.nan  # one pattern of bits for all
    return values + 0.0  # -0.0 becomes 0.0


def _collect_events(ticks: Ticks) -> Recording:
    identities: dict[tuple[Any, ...], int] = {}
    events: list[tuple[int, int, int]] = []
    numbers: list[float] = []
    for tick, (_, outputs) in enumerate(ticks):
        for event in outputs.events:
            identity = identities.setdefault(_identity_of(event), len(identities))
            event_numbers = event.numbers()
            events.append((tick, identity, len(event_numbers)))
            numbers += event_numbers
    return {
        "events": np.array(events, dtype=np.int32).reshape(-1, 3),
        "event_numbers": np.array(numbers, dtype=float),
    }


def _identity_of(event: Event) -> tuple[Any, ...]:
    """Class and code of an event; its sentence does not matter."""
    return type(event), getattr(event, "code", None)


def _collect_answers(ticks: Ticks) -> np.ndarray:
    answers = [
        (tick, number, bool(refusal))
        for tick, (_, outputs) in enumerate(ticks)
        for number, refusal in outputs.answers
    ]
    return np.array(answers, dtype=np.int32).reshape(-1, 3)


def read_expected() -> tuple[dict[str, Recording], bool]:
    """Read the recordings by scenario, and whether all bits must be the same on this machine."""
    recordings: dict[str, Recording] = {}
    with np.load(PATH) as stored:
        arithmetic = str(stored[_ARITHMETIC])
        for key in stored.files:
            scenario, _, name = key.partition("/")
            if name:
                recordings.setdefault(scenario, {})[name] = stored[key]
    return recordings, arithmetic == describe_arithmetic()


def find_differences(
    expected: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray], bit_by_bit: bool
) -> list[str]:
    """Compare a run with its recording; returns a sentence for each array that differs."""
    differences: list[str] = []
    for name, was in expected.items():
        if name == "row_digests" and not bit_by_bit:
            continue
        got = found[name]
        if was.shape != got.shape:
            differences.append(f"{name}: shape {got.shape}, recorded {was.shape}")
            continue
        differs = _differing(was, got, bit_by_bit)
        if differs.any():
            place = int(np.flatnonzero(differs.reshape(len(was), -1).any(axis=1))[0])
            differences.append(f"{name}: item {place} is {got[place]}, recorded {was[place]}")
    return differences


def _differing(was: np.ndarray, got: np.ndarray, bit_by_bit: bool) -> np.ndarray:
    same: np.ndarray = (was == got) | (np.isnan(was) & np.isnan(got))
    if was.dtype.kind == "f" and not bit_by_bit:
        with np.errstate(invalid="ignore"):
            same |= np.abs(got - was) <= NUMBERS_WITHIN * np.maximum(np.abs(was), 1.0)
    return ~same


def record_all() -> None:
    """Run all scenarios and replace the file of recordings."""
    arrays = {
        f"{scenario}/{name}": array
        for scenario, story in SCENARIOS.items()
        for name, array in run_scenario(story).items()
    }
    np.savez_compressed(PATH, **{_ARITHMETIC: np.array(describe_arithmetic())}, **arrays)


if __name__ == "__main__":
    record_all()
