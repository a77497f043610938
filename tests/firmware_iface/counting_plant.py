"""A plant that is easily checked, and a clock that a test moves."""

from __future__ import annotations

import asyncio

from firmware_iface.emulators.pump_board import BoardSample


class CountingPlant:
    """Every sample is new, and every value of it follows from its counter."""

    def __init__(self) -> None:
        self.counter = 0
        self.gauge_pressure_pa = 600.0
        self.interlock_inputs = 0xFFFF
        self.outputs: list[tuple[float, float]] = []
        self.actuated = asyncio.Event()

    @staticmethod
    def displacement_um(counter: int) -> float:
        return counter * 0.25 - 100.0

    def sample(self) -> BoardSample:
        self.counter += 1
        return BoardSample(
            displacement_um=self.displacement_um(self.counter),
            displacement_quality=0,
            gauge_pressure_pa=self.gauge_pressure_pa,
            ambient_pressure_pa=101_325.0 + 0.5 * (self.counter % 100),
            air_temperature_c=20.25,
            gas_temperature_c=-3.125,
            sample_counter=self.counter,
            device_time_s=self.counter / 128,
            interlock_inputs=self.interlock_inputs,
        )

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        self.outputs.append((pump_fraction, vent_fraction))
        self.actuated.set()

    async def reaches(self, outputs: tuple[float, float]) -> None:
        """Wait for these outputs; pytest fails with a TimeoutError if they never come."""
        async with asyncio.timeout(5):
            while self.outputs[-1] != outputs:
                self.actuated.clear()
                await self.actuated.wait()


class ManualClock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s
