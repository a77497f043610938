"""A pump board of a later map version, as a process: prints its port
and serves until it is ended.
"""

from __future__ import annotations

import asyncio
import math

from firmware_iface.emulators.pump_board import BoardSample, PumpBoardEmulator


class Still:
    """An idle plant."""

    def sample(self) -> BoardSample:
        return BoardSample(0.0, 0, 600.0, 101325.0, 23.0, math.nan, 1, 0.0)

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        assert pump_fraction == 0.0


async def main() -> None:
    board = PumpBoardEmulator(Still())
    board.state.map_version = 99
    await board.start()
    print(board.port, flush=True)
    await asyncio.Event().wait()


asyncio.run(main())
