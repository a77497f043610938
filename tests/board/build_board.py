"""Builds the board's firmware for the tests, with the repository's own Makefile."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from tests.support.machine_needs import require

FIRMWARE = Path(__file__).parents[2] / "firmware_iface" / "board"


def built(target: str, folder: Path, *tools: str) -> Path:
    """Build a target of the firmware's Makefile in a folder; skip the test where a tool is missing.

    BOARD_BUILD names another folder, whose content is kept (`make board` measures the coverage
    there).
    """
    folder = Path(os.environ.get("BOARD_BUILD", folder))
    require("make", *tools)
    subprocess.run(
        ["make", "--silent", "-C", str(FIRMWARE), f"OUT={folder}", str(folder / target)],
        check=True,
        capture_output=True,
        text=True,
    )
    return folder / target
