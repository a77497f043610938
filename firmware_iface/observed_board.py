"""A pump board that is only read: on the first day on real hardware, or beside another controller.

Nothing here writes to the board: it is not claimed, its watchdog is neither armed nor fed, its
faults stay, and commands are dropped.
"""

from firmware_iface import roles
from firmware_iface.drivers.pump_board import PumpBoard


class ObservedBoard:
    """A `roles.Bench` that reads a pump board and drops every command.

    Parameters
    ----------
    board : PumpBoard
        Not yet connected.
    """

    def __init__(self, board: PumpBoard) -> None:
        self._board = board

    async def open(self) -> roles.BenchIdentity:
        """Connect and check kind and map version. Raises LinkError."""
        return await self._board.identify()

    async def read(self) -> roles.BenchReading:
        """One sample. Raises LinkError."""
        return await self._board.read()

    async def write(self, command: roles.BenchCommand) -> None:
        """Drop the command."""

    async def clear_faults(self, mask: int) -> None:
        """Leave the faults to the program that drives the board."""

    def dead_guards(self) -> tuple[str, ...]:
        """None: nothing is guarded."""
        return ()

    def link_state(self) -> roles.LinkState:
        """How the board answered the last reading."""
        return self._board.link_state()

    async def close(self) -> None:
        """Close the link; a watchdog that was not armed here stays as it is."""
        await self._board.close()
