"""The emulated pump board over a plant that counts."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
from counting_plant import CountingPlant, ManualClock

from firmware_iface.emulators.pump_board import PumpBoardEmulator


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
async def plant() -> CountingPlant:
    return CountingPlant()


@pytest.fixture
async def board(plant: CountingPlant, clock: ManualClock) -> AsyncIterator[PumpBoardEmulator]:
    """The emulated board, running."""
    emulator = PumpBoardEmulator(plant, clock=clock)
    await emulator.start()
    yield emulator
    await emulator.stop()
