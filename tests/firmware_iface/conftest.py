"""The emulated pump board over a plant that counts."""

from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
from counting_plant import CountingPlant, ManualClock

from firmware_iface.register_map import list_known_maps, load_default_map
from tests.worlds.faulty_board import PumpBoardEmulator


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
async def plant() -> CountingPlant:
    return CountingPlant()


@pytest.fixture
def map_version() -> int:
    """Of the emulated board; a module whose tests run on an earlier one as well parametrizes it."""
    return load_default_map().map_version


@pytest.fixture
async def board(
    plant: CountingPlant, clock: ManualClock, map_version: int
) -> AsyncIterator[PumpBoardEmulator]:
    """The emulated board, running."""
    emulator = PumpBoardEmulator(plant, clock=clock, registers=list_known_maps()[map_version])
    await emulator.start()
    yield emulator
    await emulator.stop()
