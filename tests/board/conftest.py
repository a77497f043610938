"""The board's firmware, built once a worker."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.board.build_board import built
from tests.board.virtual_board import VirtualBoard


@pytest.fixture(scope="session")
def firmware_library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The firmware with its hardware in memory."""
    return built("libboard.so", tmp_path_factory.mktemp("board"), "cc")


@pytest.fixture
def virtual_board(firmware_library: Path) -> VirtualBoard:
    return VirtualBoard(firmware_library)
