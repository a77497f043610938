"""Checksum of what a tick decided, which shows whether a replay is identical."""

import struct
import zlib
from collections.abc import Sequence

import numpy as np

from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.model import telemetry

_DRIVEN = struct.Struct("<2d")
_ANSWER = struct.Struct("<q?")


def output_crc(outputs: TickOutputs, row: bytes) -> int:
    """Checksum of what a tick decided: command, row, kinds and numbers of its events, answers, end.

    No names of columns and no sentences: a renamed column or a better sentence is no difference.

    Parameters
    ----------
    outputs : TickOutputs
        Of the tick.
    row : bytes
        Doubles: the values of the columns that the run records (`ColumnChoice`).
    """
    # Command and row, events, answers; an end only in the tick that has it
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
