"""A still film that notes what the board's outputs do."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from firmware_iface.emulators.pump_board import BoardSample

_PATIENCE_S = 8.0


@dataclass
class StillFilm:
    """A plant that does not react."""

    gauge_pressure_pa: float = 100.0
    pump: float = 0.0
    vent: float = 0.0
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def sample(self) -> BoardSample:
        return BoardSample(12.5, 0, self.gauge_pressure_pa, 101_325.0, 21.0, 22.0, 0, 0.0)

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        self.pump, self.vent = pump_fraction, vent_fraction
        self.changed.set()

    async def until(self, right: Callable[[], bool]) -> float:
        """Wait for outputs; the seconds that it took."""
        start_s = time.monotonic()
        async with asyncio.timeout(_PATIENCE_S):
            while not right():
                self.changed.clear()
                await self.changed.wait()
        return time.monotonic() - start_s

    @property
    def safe(self) -> bool:
        return self.pump == 0
