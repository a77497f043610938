"""Replay: runs the recorded inputs of a run through today's control code, on the run's own clock.

A tick is a pure function of its inputs and of the ticks before it, so the same code gives identical
outputs, and any difference is a change of the code. A replay starts with the run, or in the middle
of it from a snapshot of what the controller remembered (`controller/snapshot.py`). Each tick's
outputs are compared by checksum. Where the record lacks ticks, the replayed controller misses them
too: until the next snapshot, only decisions (states, faults) are compared.
"""

import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.snapshot import UnknownSnapshotError, continue_from, decode_snapshot
from membrane_ctrl.controller.state import ControllerState
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.controller.tick_checksum import ColumnChoice, output_crc
from membrane_ctrl.controller.tick_codec import unpack_tick
from membrane_ctrl.metrology.figure.held_quantities import find_held_weights
from membrane_ctrl.model import errors, shape_estimate, telemetry
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.events import Cleared, Event, Fault, ShapeLoopState, StateEntered
from membrane_ctrl.model.state_tree import find_differences
from membrane_ctrl.replay.numbers import NUMBERS_WITHIN, RecordedRows
from membrane_ctrl.run_files.inputs_file import InputsFrame

# A shape is used in the tick it arrives in; no more than these need be kept.
_SHAPES_KEPT = 16


@dataclass(frozen=True, slots=True)
class Decision:
    """A decision of the controller and its time: a state, a fault, or the shape loop's state."""

    time_s: float
    kind: str  # of the event
    name: str  # of the state or fault

    @property
    def description(self) -> str:
        """The decision in words."""
        return f"{self.kind} {self.name}"


@dataclass(frozen=True, slots=True)
class RecordedTick:
    """One recorded tick: its inputs, the checksum of its outputs, and the snapshot before it."""

    tick: int
    inputs: TickInputs
    output_crc: int
    snapshot: bytes = b""


@dataclass(frozen=True, slots=True)
class Gap:
    """Ticks that are missing or incomplete in the record."""

    after_tick: int
    time_s: float
    ticks: int
    reason: str


@dataclass(frozen=True, slots=True)
class StateDifferences:
    """Where the replayed state is not the recorded one, as `place: recorded, today`."""

    time_s: float
    fields: list[str]


@dataclass(slots=True)
class Replay:
    """Result of a replay; rows, decisions and end are those of today's code."""

    begin_s: float = math.nan
    ticks: int = 0  # replayed
    compared: int = 0  # of these, bit by bit
    near: int = 0  # of these, with other last bits
    different: int = 0  # of these
    first_different: telemetry.TelemetryRow | None = None  # today's row of the first of these
    gaps: list[Gap] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    last_s: float = -math.inf
    finished: errors.Exit | None = None
    # fields in which the state differs from the first recorded snapshot that is not the replayed
    # state
    state_differences: StateDifferences | None = None
    state: ControllerState | None = None  # after the last replayed tick


@dataclass(frozen=True, slots=True)
class Comparison:
    """How outputs are compared with the record.

    Attributes
    ----------
    columns : ColumnChoice
        Those that the checksums of the run cover.
    rows : RecordedRows or None
        Given if the record was made on another processor, with other libraries or with columns that
        this program does not have: a tick with another checksum is then compared by its numbers.
    """

    columns: ColumnChoice = field(default_factory=lambda: ColumnChoice(telemetry.FIELDS))
    rows: RecordedRows | None = None


def replay_record(
    config: Config,
    record: Iterable[RecordedTick | Gap],
    sag_sensitivity: FloatArray,
    from_s: float = 0.0,
    to_s: float = math.inf,
    comparison: Comparison | None = None,
) -> Replay:
    """Run recorded ticks through a new controller.

    Parameters
    ----------
    config : Config
        Configuration of the run.
    record : iterable of RecordedTick or Gap
        Ticks from the run's first, or from one with a snapshot.
    sag_sensitivity : (terms,) array
        Change of the Zernike coefficients for each µm of sag.
    from_s, to_s : float
        Part that is compared bit by bit, in s of the run; earlier ticks run, but are not compared.
    comparison : Comparison, optional
        How outputs and state are compared.

    Raises
    ------
    UnknownSnapshotError
        Today's code cannot use the record's first snapshot, or a tick raises after using one.
    """
    held_weights = find_held_weights(config)
    controller = Controller(config, sag_sensitivity, held_weights=held_weights)
    comparison = comparison or Comparison()
    found = Replay()
    same_past, remembered = True, False
    for item in record:
        # After a gap, the controller's memory differs from that of the run
        if isinstance(item, Gap):
            if item.time_s <= to_s:
                found.gaps.append(item)
            same_past = False
            continue
        if item.inputs.now_s > to_s or found.finished is not None:
            break
        # A snapshot replaces the memory: at the beginning of a part, and after a gap. In between it
        # must equal the replayed memory
        if not found.ticks:
            found.begin_s = item.inputs.now_s
            if item.tick > 1 and item.snapshot:
                controller = continue_from(item.snapshot, config, sag_sensitivity, held_weights)
                remembered = True
        elif item.snapshot and not same_past:
            with suppress(UnknownSnapshotError):  # then decisions only, as before
                controller = continue_from(item.snapshot, config, sag_sensitivity, held_weights)
                same_past, remembered = True, True
        elif item.snapshot and found.state_differences is None:
            found.state_differences = _compare_state(item, controller, comparison)
        # Run the tick, and compare its outputs if the memory is that of the run
        outputs = _run_tick(controller, item, remembered)
        found.ticks += 1
        found.last_s = item.inputs.now_s
        found.finished = outputs.finished
        found.decisions += decisions_of((item.inputs.now_s, event) for event in outputs.events)
        if item.inputs.now_s >= from_s and same_past:
            _compare_tick(item, outputs, found, comparison)
    found.state = controller.memory
    return found


def _compare_state(
    item: RecordedTick, controller: Controller, comparison: Comparison
) -> StateDifferences | None:
    """Where a recorded snapshot differs from the replayed state; None if nowhere, or if it has
    another layout.
    """
    try:
        recorded = decode_snapshot(item.snapshot)
    except UnknownSnapshotError:
        return None
    fields = find_differences(
        recorded, controller.memory, NUMBERS_WITHIN if comparison.rows else 0.0
    )
    if not fields:
        return None
    return StateDifferences(item.inputs.now_s, fields)


def _run_tick(controller: Controller, item: RecordedTick, remembered: bool) -> TickOutputs:
    """Run a tick. Ticks never raise by themselves: one that does after a snapshot proves that it
    was forged.
    """
    try:
        return controller.tick(item.inputs)
    except Exception as error:
        if not remembered:
            raise
        what = f"{type(error).__name__} at {item.inputs.now_s:.2f} s: {error}"
        raise UnknownSnapshotError(f"the snapshot cannot be used: {what}") from None


def _compare_tick(
    item: RecordedTick, outputs: TickOutputs, found: Replay, comparison: Comparison
) -> None:
    found.compared += 1
    if output_crc(outputs, comparison.columns.pack(outputs.row)) == item.output_crc:
        return
    if comparison.rows is not None and comparison.rows.find_differing(outputs.row) == ():
        found.near += 1
        return
    found.different += 1
    if found.first_different is None:
        found.first_different = outputs.row


def decisions_of(logged: Iterable[tuple[float, Event]]) -> list[Decision]:
    """The decisions among events with their times."""
    found: list[Decision] = []
    for time_s, event in logged:
        match event:
            case (
                StateEntered(state=name)
                | Fault(name=name)
                | Cleared(name=name)
                | ShapeLoopState(state=name)
            ):
                found.append(Decision(time_s, event.kind, name))
    return found


def find_first_tick(frames: Iterable[InputsFrame], from_s: float) -> int:
    """Return the tick from which a replay must begin: the last one before a time that has a
    snapshot.

    Parameters
    ----------
    frames : iterable of InputsFrame
        The recorded inputs, in order.
    from_s : float
        The time of the run.

    Returns
    -------
    int
        1 if there is no snapshot.
    """
    begin = 1
    for frame in frames:
        for record in frame.records[np.isin(frame.records["tick"], list(frame.snapshots))]:
            if record["now_s"] <= from_s:
                begin = int(record["tick"])
        if len(frame.records) and frame.records["now_s"][-1] > from_s:
            break
    return begin


def recorded_ticks(
    frames: Iterable[InputsFrame], begin: int = 1, snapshots: bool = True
) -> Iterator[RecordedTick | Gap]:
    """Yield the ticks of a record in order, with a `Gap` wherever some are missing.

    Parameters
    ----------
    frames : iterable of InputsFrame
        The recorded inputs, in order.
    begin : int
        First tick.
    snapshots : bool
        Whether the ticks carry their snapshots.
    """
    estimates: dict[float, shape_estimate.ShapeEstimate] = {}
    last, last_s = begin - 1, 0.0
    for frame in frames:
        estimates |= frame.estimates
        # Each tick with its inputs; a gap where one is missing or cannot be read.
        for record in frame.records[frame.records["tick"] >= begin]:
            tick = int(record["tick"])
            try:
                inputs = unpack_tick(record, frame.tails.get(tick, b""), estimates)
            except (LookupError, ValueError, TypeError) as error:
                yield Gap(tick - 1, last_s, 1, str(error.args[0] if error.args else error))
            else:
                if tick > last + 1:
                    yield Gap(last, last_s, tick - last - 1, "not recorded")
                snapshot = frame.snapshots.get(tick, b"") if snapshots else b""
                yield RecordedTick(tick, inputs, int(record["output_crc"]), snapshot)
            last, last_s = tick, float(record["now_s"])
        # A tick refers to a recent estimate: older ones are not needed.
        while len(estimates) > _SHAPES_KEPT:
            del estimates[next(iter(estimates))]


def differing_fields(
    today: telemetry.TelemetryRow, recorded: telemetry.TelemetryRow
) -> dict[str, tuple[float, float]]:
    """Fields of a telemetry row that are not bit-identical; NaN equals NaN.

    Parameters
    ----------
    today, recorded : TelemetryRow
        The replay's row of a tick, and that of the run.

    Returns
    -------
    dict
        By field: the recorded value, and today's.
    """
    fields: dict[str, tuple[float, float]] = {}
    for name in telemetry.FIELDS:
        then, now = getattr(recorded, name), getattr(today, name)
        if then != now and not (math.isnan(then) and math.isnan(now)):
            fields[name] = (float(then), float(now))
    return fields


def drop_repeats(decisions: list[Decision]) -> list[Decision]:
    """Drop shape-loop decisions that only give another reason for the same state."""
    kept: list[Decision] = []
    shape = ""
    for decision in decisions:
        is_shape = decision.kind == ShapeLoopState.line_kind
        if not is_shape or decision.name != shape:
            kept.append(decision)
        if is_shape:
            shape = decision.name
    return kept


def find_unmatched(recorded: list[Decision], today: list[Decision], slack_s: float) -> list[str]:
    """Return the differences between two lists of decisions, as sentences.

    Parameters
    ----------
    recorded : list of Decision
        Decisions of the run.
    today : list of Decision
        Decisions of the replay.
    slack_s : float
        By how much times may differ.
    """
    lines: list[str] = []
    recorded, today = drop_repeats(recorded), drop_repeats(today)
    for place in range(max(len(recorded), len(today))):
        then = recorded[place] if place < len(recorded) else None
        now = today[place] if place < len(today) else None
        if (
            then is None
            or now is None
            or then.description != now.description
            or abs(then.time_s - now.time_s) > slack_s
        ):
            lines.append(f"recorded: {_describe_decision(then)}; today: {_describe_decision(now)}")
            if then is None or now is None or then.description != now.description:
                break  # all later ones are shifted against each other
    return lines


def _describe_decision(decision: Decision | None) -> str:
    if decision is None:
        return "nothing more"
    return f"{decision.description} at {decision.time_s:.2f} s"
