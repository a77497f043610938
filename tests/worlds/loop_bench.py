"""The virtual bench as the bench of a supervisor: it advances to the event loop's time when it is
read.
"""

import asyncio

from firmware_iface.roles import NO_LINK_STATE, BenchCommand, BenchIdentity, BenchReading, LinkState
from membrane_ctrl.config.schema import Config
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench


class LoopBench:
    """Plant and board in memory, advanced at each access."""

    def __init__(self, config: Config) -> None:
        self.virtual = VirtualBench(Plant(config.twin, config.pump))
        self._at_s = asyncio.get_running_loop().time()

    def now(self) -> VirtualBench:
        """The bench at the loop's time."""
        now_s = asyncio.get_running_loop().time()
        if now_s > self._at_s:
            self.before(now_s)
            self.virtual.advance(now_s - self._at_s)
            self._at_s = now_s
        return self.virtual

    def before(self, now_s: float) -> None:
        """For faults that begin or end until `now_s`."""

    async def open(self) -> BenchIdentity:
        return self.now().open()

    async def read(self) -> BenchReading:
        return self.now().read()

    async def write(self, command: BenchCommand) -> None:
        self.now().write(command)

    async def clear_faults(self, mask: int) -> None:
        self.now().clear_faults(mask)

    def dead_guards(self) -> tuple[str, ...]:
        return ()

    def link_state(self) -> LinkState:
        return NO_LINK_STATE

    async def close(self) -> None:
        self.now().close()
