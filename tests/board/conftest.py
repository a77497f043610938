"""The board's firmware, built once a worker."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.board.build_board import built
from tests.board.virtual_board import VirtualBoard


@pytest.fixture(scope="session")
def firmware_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The firmware with its hardware in memory; BOARD_LIBRARY names one built to measure coverage."""
    given = os.environ.get("BOARD_LIBRARY")
    return Path(given) if given else built("libboard.so", tmp_path_factory.mktemp("board"), "cc")


@pytest.fixture
def virtual_board(firmware_library: Path) -> VirtualBoard:
    return VirtualBoard(firmware_library)
