"""Inputs and outputs of a tick: the whole interface between the control code and the world.

A tick is a plain function of these, with no I/O and no clock: the asyncio supervisor, the
virtual-time runs and a replay call the same code.
"""

import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from firmware_iface.roles import SENSORS, BenchCommand, BenchReading
from membrane_ctrl.controller.commands import Command
from membrane_ctrl.model import errors, shape_estimate, telemetry
from membrane_ctrl.model.columns import COLUMNS
from membrane_ctrl.model.events import Event


@dataclass(frozen=True, slots=True)
class TickInputs:
    """All inputs of a tick."""

    now_s: float  # start of the tick on the run's clock
    dt_s: float  # true time since the last tick, clamped
    reading: BenchReading | None  # None without a valid answer in this tick
    lateness_ms: float = 0.0  # start after the deadline
    missed_ticks: int = 0  # running count of skipped deadlines
    link_up: bool = True  # the device link is connected
    # the newest shape, only in the tick in which it arrives
    estimate: shape_estimate.ShapeEstimate | None = None
    commands: tuple[Command, ...] = ()  # since the last tick
    dead_tasks: tuple[str, ...] = ()  # supervised tasks that ended
    # the twin's truth, for the record only; NaN on a real bench
    truth_displacement_um: float = math.nan
    truth_laser_bias_um: float = math.nan


@dataclass(frozen=True, slots=True)
class TickOutputs:
    """All outputs of a tick."""

    command: BenchCommand  # the write that ends the tick
    row: telemetry.TelemetryRow
    events: tuple[Event, ...]
    finished: errors.Exit | None  # exit code if the run is over
    answers: tuple[
        tuple[int, str], ...
    ] = ()  # number of each command, and why it was refused (empty: executed)
    # the board's latches to clear: all after `ack`, the watchdog's by the resume rule
    clear_mask: int = 0


# The exact inputs of a tick as bytes, so that a replay gives the same tick (docs/how-to/replay.md).
#
# A tick is one fixed record and its telemetry row; rare data (commands, ended tasks) precede it as
# JSON, in pieces. A shape estimate is referred to by its time: the recorder has it from its own
# ring. A checksum of all outputs tells whether a replay is identical.

# First bytes of the inputs ring's messages.
TICK, PIECE = b"T", b"P"

_FORMATS = {float: "f8", int: "i8", bool: "u1"}
_READING = {name: _FORMATS[kind] for name, kind in get_type_hints(BenchReading).items()}
_LINK_UP, _HAS_READING = 1, 2
RECORD = np.dtype(
    [
        ("tick", "<i8"),
        ("now_s", "<f8"),
        ("dt_s", "<f8"),
        ("lateness_ms", "<f8"),
        ("missed_ticks", "<i8"),
        ("flags", "u1"),
        *((name, f"<{code}") for name, code in _READING.items()),
        ("estimate_time_s", "<f8"),
        ("truth_displacement_um", "<f8"),
        ("truth_laser_bias_um", "<f8"),
        ("output_crc", "<u4"),
        ("tail_bytes", "<u4"),
    ]
)
Records = NDArray[np.void]
# Readings of sensors that the telemetry row repeats as they are; that of the gauge it has without
# jumps.
AS_READ = tuple(name for name in SENSORS if name in COLUMNS and name != "gauge_pressure_pa")
# Fields of a record that the tick's telemetry row repeats.
SAME = {
    "now_s": "mono_s",
    "pump_fraction": "pump_readback_fraction",
    "vent_fraction": "vent_readback_fraction",
    **{
        name: name
        for name in (
            "tick",
            "lateness_ms",
            "missed_ticks",
            *AS_READ,
            "gas_temperature_c",
            "device_time_s",
            "truth_displacement_um",
            "truth_laser_bias_um",
        )
    },
}
_TAIL_LOST = 2**32 - 1  # no tail is that long

# `struct` packs in 2 us what a NumPy record takes 10 us to fill
_LETTERS = {"<i8": "q", "<f8": "d", "|u1": "B", "<u4": "I"}
_STRUCT = struct.Struct("<" + "".join(_LETTERS[RECORD[name].str] for name in RECORD.names or ()))
assert _STRUCT.size == RECORD.itemsize
_ROW_PLACE = len(TICK) + RECORD.itemsize
# A slot of the ring has room for a tick. Commands that are longer come in pieces.
MESSAGE_BYTES = _ROW_PLACE + telemetry.ROW_BYTES
# Plain tables in, plain tables out, whatever a command carries; floats survive bit by bit.
_COMMANDS = TypeAdapter(tuple[Command, ...])
_reading_values = attrgetter(*_READING)  # ten times as fast as `astuple`
_NO_READING = tuple(math.nan if code == "f8" else 0 for code in _READING.values())


def pack_tick(tick: int, inputs: TickInputs, outputs: TickOutputs, row: bytes) -> list[bytes]:
    """Messages for the inputs ring, in order; the last one is the tick.

    `tick` counts from 1, and `row` is the packed telemetry row of the outputs.
    """
    tail = _tail(inputs)
    reading, estimate = inputs.reading, inputs.estimate
    record = _STRUCT.pack(
        tick,
        inputs.now_s,
        inputs.dt_s,
        inputs.lateness_ms,
        inputs.missed_ticks,
        _LINK_UP * inputs.link_up | _HAS_READING * (reading is not None),
        *(_NO_READING if reading is None else _reading_values(reading)),
        math.nan if estimate is None else estimate.time_s,
        inputs.truth_displacement_um,
        inputs.truth_laser_bias_um,
        output_crc(outputs, row),
        len(tail),
    )
    return [*_pieces(PIECE, tail), TICK + record + row]


def pack_row(tick: int, row: telemetry.TelemetryRow) -> bytes:
    """The message of a tick whose inputs cannot be packed: its row alone, a gap for a replay."""
    record = np.zeros(1, dtype=RECORD)
    for name, field in SAME.items():
        record[name] = getattr(row, field)
    record["tick"], record["tail_bytes"] = tick, _TAIL_LOST
    return TICK + record.tobytes() + row.pack()


SNAPSHOT_BYTES_MAX = 1 << 18  # one takes 8 kB, with the estimator's covariance 70 kB
_SNAPSHOT_HEAD = struct.Struct("<q")
SNAPSHOT_MESSAGE_BYTES = _SNAPSHOT_HEAD.size + SNAPSHOT_BYTES_MAX


def pack_snapshot(tick: int, snapshot: bytes) -> bytes:
    """The message for the ring of snapshots: what the controller remembers before a tick."""
    return _SNAPSHOT_HEAD.pack(tick) + snapshot


def _pieces(kind: bytes, data: bytes) -> list[bytes]:
    step = MESSAGE_BYTES - len(kind)
    return [kind + data[start : start + step] for start in range(0, len(data), step)]


_DRIVEN = struct.Struct("<2d")
_ANSWER = struct.Struct("<q?")


def output_crc(outputs: TickOutputs, row: bytes) -> int:
    """Checksum of what a tick decided: command, row, kinds and numbers of its events, answers, end.

    No names of columns and no sentences: a renamed column or a better sentence is no difference.

    Parameters
    ----------
    outputs : TickOutputs
    row : bytes
        Doubles: the values of the columns that the run records (`ColumnChoice`).
    """
    command = outputs.command
    crc = zlib.crc32(row, zlib.crc32(_DRIVEN.pack(command.pump_fraction, command.vent_fraction)))
    for event in outputs.events:
        numbers = event.numbers()
        crc = zlib.crc32(event.kind.encode() + struct.pack(f"<{len(numbers)}d", *numbers), crc)
    for number, refused in outputs.answers:
        crc = zlib.crc32(_ANSWER.pack(number, bool(refused)), crc)
    if outputs.finished is not None or outputs.clear_mask:
        end = -1 if outputs.finished is None else int(outputs.finished)
        crc = zlib.crc32(struct.pack("<2q", end, outputs.clear_mask), crc)
    return crc


class ColumnChoice:
    """The columns of a run's own schema, which the checksums of its ticks cover.

    Attributes
    ----------
    unknown : tuple of str
        Columns that this program does not have: no checksum of the run can be computed.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.unknown = tuple(name for name in names if name not in telemetry.COLUMN)
        self._places = [telemetry.COLUMN[name] for name in names if name in telemetry.COLUMN]
        self._all = self._places == list(range(len(telemetry.FIELDS)))

    def pack(self, row: telemetry.TelemetryRow) -> bytes:
        """The values of these columns, for `output_crc`."""
        packed = row.pack()
        return packed if self._all else np.frombuffer(packed)[self._places].tobytes()


def _tail(inputs: TickInputs) -> bytes:
    if not inputs.commands and not inputs.dead_tasks:
        return b""
    commands = _COMMANDS.dump_python(inputs.commands)
    return json.dumps({"commands": commands, "dead_tasks": inputs.dead_tasks}).encode()


def unpack_tick(
    record: np.void, tail: bytes, estimates: Mapping[float, shape_estimate.ShapeEstimate]
) -> TickInputs:
    """Return the bit-exact inputs of a tick; `tail` are its commands and ended tasks as JSON.

    `estimates` are the run's shape estimates by time. Raises LookupError if an estimate or a tail
    is missing.
    """
    values: dict[str, Any] = dict(zip(RECORD.names or (), record.item(), strict=True))
    if len(tail) != values["tail_bytes"]:
        raise LookupError(f"commands of tick {values['tick']} are missing")
    rest = json.loads(tail) if tail else {"commands": [], "dead_tasks": []}
    estimate_time_s = values["estimate_time_s"]
    if not math.isnan(estimate_time_s) and estimate_time_s not in estimates:
        raise LookupError(f"the shape of {estimate_time_s:.3f} s is missing")
    reading = {name: values[name] for name in _READING} | {
        "watchdog_tripped": bool(values["watchdog_tripped"])
    }
    return TickInputs(
        now_s=values["now_s"],
        dt_s=values["dt_s"],
        reading=BenchReading(**reading) if values["flags"] & _HAS_READING else None,
        lateness_ms=values["lateness_ms"],
        missed_ticks=values["missed_ticks"],
        link_up=bool(values["flags"] & _LINK_UP),
        estimate=estimates.get(estimate_time_s),
        commands=_COMMANDS.validate_python(tuple(rest["commands"])),
        dead_tasks=tuple(rest["dead_tasks"]),
        truth_displacement_um=values["truth_displacement_um"],
        truth_laser_bias_um=values["truth_laser_bias_um"],
    )


@dataclass(frozen=True, slots=True)
class TickBatch:
    """Ticks taken from the ring: inputs, telemetry rows, and any tails and snapshots by tick."""

    records: Records
    rows: telemetry.Rows
    tails: dict[int, bytes]
    snapshots: dict[int, bytes]


class TickAssembler:
    """Assembles the pieces in the inputs ring; a tick whose pieces were overwritten gets an empty
    tail.
    """

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._snapshots: dict[int, bytes] = {}

    def add_snapshots(self, messages: list[bytes]) -> None:
        """Add messages of the ring of snapshots, for the ticks of
        this or a later call of `take`.
        """
        for message in messages:
            (tick,) = _SNAPSHOT_HEAD.unpack_from(message)
            self._snapshots[tick] = message[_SNAPSHOT_HEAD.size :]

    def take(self, messages: list[bytes]) -> TickBatch:
        """Take messages in order; a tick may end in a later call than its first piece."""
        records: list[bytes] = []
        rows: list[bytes] = []
        tails: dict[int, bytes] = {}
        snapshots: dict[int, bytes] = {}
        for message in messages:
            if message[:1] == TICK:
                records.append(message[1:_ROW_PLACE])
                rows.append(message[_ROW_PLACE:])
                tick = int.from_bytes(message[1:9], "little")
                if self._pieces:
                    tails[tick] = b"".join(self._pieces)
                    self._pieces.clear()
                if tick in self._snapshots:
                    snapshots[tick] = self._snapshots.pop(tick)
            else:
                self._pieces.append(message[1:])
        return TickBatch(
            np.frombuffer(b"".join(records), dtype=RECORD), telemetry.unpack(rows), tails, snapshots
        )
