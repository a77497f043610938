"""The screen on any display: patterns rendered once, corrected and settled; and drivers that make
mistakes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from firmware_iface.display_patterns import ScreenRaster, compute_pattern_light
from firmware_iface.display_response import DisplayResponse
from firmware_iface.optical_roles import DriverClock, Pattern
from firmware_iface.pattern_screen import SETTLE_S, PatternScreen
from firmware_iface.roles import DeviceIdentity, LinkDownError, LinkError

RASTER = ScreenRaster(64, 48, 1.0, periods=2, period_mm=16.0)
PATTERNS = [Pattern("sin", "x", 0), Pattern("gray", "y", 2), Pattern("white"), Pattern("black")]


class Time:
    def __init__(self) -> None:
        self.now_s = 5.0

    def now(self) -> float:
        return self.now_s

    def sleep(self, duration_s: float) -> None:
        self.now_s += duration_s


class Display:
    """Keeps what is shown; `fails` has what a method raises, once."""

    def __init__(self) -> None:
        self.fails: dict[str, BaseException] = {}
        self.opened = 0
        self.prepared = 0
        self.shown: Any = None

    def _fail(self, method: str) -> None:
        if method in self.fails:
            raise self.fails.pop(method)

    def open(self) -> DeviceIdentity:
        self._fail("open")
        self.opened += 1
        return DeviceIdentity("Acme panel", "", "")

    def prepare(self, levels: Any) -> Any:
        self._fail("prepare")
        self.prepared += 1
        return levels.copy()

    def show(self, picture: Any) -> None:
        self._fail("show")
        self.shown = picture

    def close(self) -> None:
        self.shown = None
        self._fail("close")

    def describe(self) -> dict[str, str]:
        return {}


@pytest.fixture
def time() -> Time:
    return Time()


@pytest.fixture
def display() -> Display:
    return Display()


@pytest.fixture
def screen(display: Display, time: Time) -> PatternScreen:
    return PatternScreen(
        display, RASTER, PATTERNS, DriverClock(time.now, time.sleep), "screen acme"
    )


def test_patterns_are_prepared_once_and_shown_pixel_by_pixel(
    screen: PatternScreen, display: Display
) -> None:
    assert screen.open().kind == "Acme panel"
    for pattern in PATTERNS * 2:
        screen.begin(pattern)
        assert np.array_equal(
            display.shown, np.rint(255 * compute_pattern_light(pattern, RASTER).astype(float))
        )
    assert display.prepared == len(PATTERNS)


def test_a_response_is_corrected(screen: PatternScreen, display: Display) -> None:
    screen.open()
    levels = np.linspace(0, 255, 65)
    screen.linearise(DisplayResponse(levels, (levels / 255) ** 2.2))
    screen.begin(PATTERNS[0])
    light = (display.shown / 255.0) ** 2.2
    assert np.abs(light - compute_pattern_light(PATTERNS[0], RASTER)).max() < 0.01


def test_a_picture_is_complete_after_the_settle_time(screen: PatternScreen, time: Time) -> None:
    screen.show(PATTERNS[0])
    assert time.now_s == pytest.approx(5.0 + SETTLE_S)
    screen.begin(PATTERNS[1])
    time.now_s += SETTLE_S + 1.0
    before_s = time.now_s
    screen.wait()
    assert time.now_s == before_s
    assert screen.describe() == {"port": "screen acme", "settle": "300 ms"}


def test_an_image_of_another_size_is_a_mistake_of_the_caller(screen: PatternScreen) -> None:
    with pytest.raises(ValueError, match="the screen"):
        screen.show_levels(np.zeros((48, 65), np.uint8))


@pytest.mark.parametrize("method", ["open", "prepare", "show"])
@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (RuntimeError("no\ngpu"), ": RuntimeError: no gpu"),
        (SystemExit(1), ": SystemExit: 1"),
        (LinkDownError("unplugged"), "unplugged"),
    ],
    ids=["error", "exit", "link"],
)
def test_whatever_a_driver_raises_is_one_line_and_opens_it_again(
    failure: BaseException, words: str, method: str, screen: PatternScreen, display: Display
) -> None:
    display.fails[method] = failure
    with pytest.raises(LinkError) as caught:
        screen.show(PATTERNS[0])
    assert str(caught.value).startswith("screen acme: ")
    assert str(caught.value).endswith(words)
    opened = display.opened
    screen.show(PATTERNS[0])
    assert display.opened == opened + 1
    assert display.shown is not None


def test_closing_never_raises(screen: PatternScreen, display: Display) -> None:
    screen.open()
    display.fails["close"] = RuntimeError("close")
    screen.close()
    with pytest.raises(LinkError, match="'x_sin_9' was not prepared"):
        screen.begin(Pattern("sin", "x", 9))
