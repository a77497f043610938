"""The exact inputs of a tick as bytes, from which a replay gives the same tick.

See docs/how-to/replay.md.

A tick is one fixed record and its telemetry row; rare data (commands, ended tasks, trouble with the
links) precede it as JSON, in pieces. A shape estimate is referred to by its time: the recorder has
it from its own ring. A checksum of all outputs shows whether a replay is identical.
"""

import json
import math
import struct
from collections.abc import Mapping
from operator import attrgetter
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from firmware_iface.roles import SENSORS, BenchReading
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.link_report import LinkReport
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.controller.tick_checksum import output_crc
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.columns import COLUMNS

# First bytes of the inputs ring's messages.
TICK = b"T"
PIECE = b"P"

_FORMATS = {float: "f8", int: "i8", bool: "u1"}
_READING = {name: _FORMATS[kind] for name, kind in get_type_hints(BenchReading).items()}
_LINK_UP = 1
_HAS_READING = 2
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
ROW_OFFSET = len(TICK) + RECORD.itemsize
# A slot of the ring has room for a tick. Commands that are longer come in pieces.
MESSAGE_BYTES = ROW_OFFSET + telemetry.ROW_BYTES
# Plain tables in, plain tables out, whatever a command carries; floats survive bit by bit.
_COMMANDS = TypeAdapter(tuple[Command, ...])
_LINK = TypeAdapter(LinkReport)
_reading_values = attrgetter(*_READING)  # ten times as fast as `astuple`
_NO_READING = tuple(math.nan if code == "f8" else 0 for code in _READING.values())
SNAPSHOT_BYTES_MAX = 1 << 18  # one takes 8 kB, with the estimator's covariance 70 kB
SNAPSHOT_HEAD = struct.Struct("<q")
SNAPSHOT_MESSAGE_BYTES = SNAPSHOT_HEAD.size + SNAPSHOT_BYTES_MAX


def pack_tick(tick: int, inputs: TickInputs, outputs: TickOutputs, row: bytes) -> list[bytes]:
    """Return the messages for the inputs ring, in order; the last one is the tick.

    Parameters
    ----------
    tick : int
        Its number, from 1.
    inputs : TickInputs
        What the controller got: a replay gets the same, to the last bit.
    outputs : TickOutputs
        What it decided, for the checksum.
    row : bytes
        The packed telemetry row of the outputs.
    """
    # What most ticks have, as a fixed record; what few have, as JSON before it. The figure itself
    # is in the ring of shapes: its time identifies it
    tail = _pack_tail(inputs)
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
    return [*_split_message(PIECE, tail), TICK + record + row]


def pack_row(tick: int, row: telemetry.TelemetryRow) -> bytes:
    """Return the message of a tick whose inputs cannot be packed: its row alone, a gap for a
    replay.

    Parameters
    ----------
    tick : int
        Its number, from 1.
    row : TelemetryRow
        Has some of the inputs, such as the sensors' readings.
    """
    record = np.zeros(1, dtype=RECORD)
    for name, field in SAME.items():
        record[name] = getattr(row, field)
    record["tick"] = tick
    record["tail_bytes"] = _TAIL_LOST
    return TICK + record.tobytes() + row.pack()


def pack_snapshot(tick: int, snapshot: bytes) -> bytes:
    """Return the message for the ring of snapshots.

    Parameters
    ----------
    tick : int
        The tick before which it was taken.
    snapshot : bytes
        What the controller remembers.
    """
    return SNAPSHOT_HEAD.pack(tick) + snapshot


def _split_message(kind: bytes, data: bytes) -> list[bytes]:
    step = MESSAGE_BYTES - len(kind)
    return [kind + data[start : start + step] for start in range(0, len(data), step)]


def _pack_tail(inputs: TickInputs) -> bytes:
    is_common = not inputs.commands and not inputs.dead_tasks and inputs.link == LinkReport()
    if is_common:
        return b""
    rare = {
        "commands": _COMMANDS.dump_python(inputs.commands),
        "dead_tasks": inputs.dead_tasks,
        "link": _LINK.dump_python(inputs.link),
    }
    return json.dumps(rare).encode()


def unpack_tick(
    record: np.void, tail: bytes, estimates: Mapping[float, shape_estimate.ShapeEstimate]
) -> TickInputs:
    """Return the bit-exact inputs of a tick.

    Parameters
    ----------
    record : numpy record
        Fixed part of the message.
    tail : bytes
        Its commands and ended tasks, as JSON.
    estimates : mapping of ShapeEstimate
        The run's shape estimates by time.

    Raises
    ------
    LookupError
        If an estimate or a tail is missing.
    """
    # The fixed part by name; commands and ended tasks are a JSON tail, which most ticks lack.
    values: dict[str, Any] = dict(zip(RECORD.names or (), record.item(), strict=True))
    if len(tail) != values["tail_bytes"]:
        raise LookupError(f"commands of tick {values['tick']} are missing")
    rest = json.loads(tail) if tail else {"commands": [], "dead_tasks": [], "link": {}}
    # The shape estimate is recorded once, under its time, not in each tick that saw it.
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
        link=_LINK.validate_python(rest.get("link", {})),
        truth_displacement_um=values["truth_displacement_um"],
        truth_laser_bias_um=values["truth_laser_bias_um"],
    )
