"""Assembles the messages of the inputs ring into ticks."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.controller.tick_codec import RECORD, ROW_OFFSET, SNAPSHOT_HEAD, TICK, Records
from membrane_ctrl.model import telemetry


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
        this or a later call of `add_messages`.
        """
        for message in messages:
            (tick,) = SNAPSHOT_HEAD.unpack_from(message)
            self._snapshots[tick] = message[SNAPSHOT_HEAD.size :]

    def add_messages(self, messages: list[bytes]) -> TickBatch:
        """Take messages in order; a tick may end in a later call than its first piece."""
        records: list[bytes] = []
        rows: list[bytes] = []
        tails: dict[int, bytes] = {}
        snapshots: dict[int, bytes] = {}
        for message in messages:
            # A tick's message is its last: pieces before it are its tail.
            if message[:1] == TICK:
                records.append(message[1:ROW_OFFSET])
                rows.append(message[ROW_OFFSET:])
                tick = int.from_bytes(message[1:9], "little")
                if self._pieces:
                    tails[tick] = b"".join(self._pieces)
                    self._pieces.clear()
                if tick in self._snapshots:
                    snapshots[tick] = self._snapshots.pop(tick)
            else:
                self._pieces.append(message[1:])
        return TickBatch(
            np.frombuffer(b"".join(records), dtype=RECORD),
            telemetry.unpack_rows(rows),
            tails,
            snapshots,
        )
