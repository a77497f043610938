"""The QR code on a terminal is that of the link, and only where a phone could open it."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from membrane_ctrl.control_port.link_code import draw_link_code

LINK = "https://bench.lab:7480/?key=AbC-123_xyz"
MODULE_PX = 8


@pytest.fixture
def _terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)


@pytest.mark.usefixtures("_terminal")
def test_a_scanner_reads_the_link() -> None:
    pytest.importorskip("segno")
    lines = draw_link_code(LINK).splitlines()
    assert len({len(line) for line in lines}) == 1
    upper = [[letter in "█▀" for letter in line] for line in lines]
    lower = [[letter in "█▄" for letter in line] for line in lines]
    light = np.empty((2 * len(lines), len(lines[0])), dtype=np.uint8)
    light[::2], light[1::2] = upper, lower
    picture = np.kron(255 * light, np.ones((MODULE_PX, MODULE_PX), dtype=np.uint8))
    text, *_ = cv2.QRCodeDetector().detectAndDecode(picture)
    assert text == LINK


@pytest.mark.usefixtures("_terminal")
@pytest.mark.parametrize("link", ["", "http://127.0.0.1:7480/?key=x", "http://localhost:7480/"])
def test_a_link_of_this_machine_is_not_drawn(link: str) -> None:
    assert draw_link_code(link) == ""


def test_without_a_terminal_nothing_is_drawn() -> None:
    assert draw_link_code(LINK) == ""
