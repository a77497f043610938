"""The conformance checks of cameras and displays pass a driver that is right, and find each
mistake.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest

from firmware_iface import camera_conformance, display_conformance
from firmware_iface.optical_roles import Frame, FrameLostError, SensorFormat
from firmware_iface.requirement import ConformanceError
from firmware_iface.roles import DeviceIdentity, DeviceRefusedError, LinkDownError, LinkError

EXPOSURE_S = 0.01


class Wire:
    """An emulated camera: numbered frames, lost, late or frozen on request."""

    def __init__(self, view: Any) -> None:
        self.view = view
        self.there, self.frozen = True, False
        self.lose = self.delay = 0
        self.numbers = 0
        self.last: Any = None
        self.sent: deque[Any] = deque()
        self.late: deque[Any] = deque()

    def expose(self) -> None:
        self.numbers += 1
        self.sent.extend(self.late)
        self.late.clear()
        frame = self.last if self.frozen else (self.numbers, self.view())
        self.last = frame
        if self.lose:
            self.lose -= 1
        elif self.delay:
            self.delay -= 1
            self.late.append(frame)
        else:
            self.sent.append(frame)


class Camera:
    """A driver that is right."""

    def __init__(self, sensor: SensorFormat, clock: Any, wire: Wire, real: SensorFormat) -> None:
        self.sensor, self.clock, self.wire, self.real = sensor, clock, wire, real
        self.time_s: float | None = None
        self.opened = False

    def open(self) -> DeviceIdentity:
        self.require_wire()
        if self.sensor.width_px != self.real.width_px:
            raise DeviceRefusedError(f"{self.real.width_px} x 32, not {self.sensor.width_px}")
        self.wire.sent.clear()
        self.opened = True
        return DeviceIdentity("right", "", "")

    def close(self) -> None:
        self.opened, self.time_s = False, None

    def describe(self) -> dict[str, str]:
        return {"port": "wire"}

    def expose(self, out: Any = None) -> None:
        self.require_wire()
        self.time_s = self.clock.now()
        self.wire.expose()
        self.clock.sleep(EXPOSURE_S)

    def fetch(self) -> Frame:
        if self.time_s is None:
            raise LinkError("nothing was exposed")
        self.require_wire()
        time_s, self.time_s = self.time_s, None
        while self.wire.sent:
            number, pixels = self.wire.sent.popleft()
            if number == self.wire.numbers:
                return Frame(pixels, time_s)
        raise FrameLostError("no frame")

    def require_wire(self) -> None:
        if not self.wire.there:
            raise LinkDownError("gone")


class Bench(camera_conformance.CameraBench):
    driver: type[Camera] = Camera
    exposure_s = EXPOSURE_S

    def __init__(self) -> None:
        super().__init__()
        self.wire = Wire(self.view)

    def make(self, sensor: SensorFormat) -> Camera:
        return self.driver(sensor, self.clock, self.wire, self.sensor)

    def lose_frame(self) -> None:
        self.wire.lose = 1

    def delay_frame(self) -> None:
        self.wire.delay = 1

    def freeze(self) -> None:
        self.wire.frozen = True

    def unplug(self) -> None:
        self.wire.there = False

    def plug_in(self) -> None:
        self.wire.there = True


class BenchOfFewFaults(camera_conformance.CameraBench):
    """Its emulator brings about nothing but a lost frame."""

    def lose_frame(self) -> None:
        """Lost."""


@pytest.mark.parametrize(
    "check", camera_conformance.list_checks(Bench), ids=lambda check: check.__name__
)
def test_a_right_camera_driver_passes(check: camera_conformance.Check) -> None:
    check(Bench())


def test_checks_of_faults_that_cannot_be_brought_about_are_left_out() -> None:
    every = {check.__name__ for check in camera_conformance.list_checks(Bench)}
    few = {check.__name__ for check in camera_conformance.list_checks(BenchOfFewFaults)}
    assert every - few == {"check_late_frame", "check_frozen_camera", "check_unplugged"}


class Nameless(Camera):
    def open(self) -> DeviceIdentity:
        super().open()
        return DeviceIdentity("", "", "")


class OneBehind(Camera):
    """Returns the frame before, as a driver of a queue that is not emptied."""

    before: Any = None

    def fetch(self) -> Frame:
        frame = super().fetch()
        self.before, pixels = frame.pixels, self.before if self.before is not None else frame.pixels
        return Frame(pixels, frame.time_s)


class AtTransfer(Camera):
    """Exposes when the frame is fetched."""

    def fetch(self) -> Frame:
        frame = super().fetch()
        return Frame(self.wire.view(), frame.time_s)


class KeepsTheArray(Camera):
    kept: Any = None

    def expose(self, out: Any = None) -> None:
        super().expose(out)
        self.kept = out if out is not None else self.kept


class TimeOfArrival(Camera):
    def fetch(self) -> Frame:
        return Frame(super().fetch().pixels, self.clock.now())


class Hasty(Camera):
    def expose(self, out: Any = None) -> None:
        self.time_s = self.clock.now()
        self.wire.expose()


class TakesWhateverComes(Camera):
    """Takes the oldest frame for the answer, and an old picture when none comes."""

    def fetch(self) -> Frame:
        if self.time_s is None:
            raise LinkError("nothing was exposed")
        time_s, self.time_s = self.time_s, None
        if not self.wire.sent:
            raise FrameLostError("no frame")
        return Frame(self.wire.sent.popleft()[1], time_s)


class Fills(Camera):
    """Returns black for a lost frame."""

    def fetch(self) -> Frame:
        time_s = self.time_s
        try:
            return super().fetch()
        except FrameLostError:
            return Frame(np.zeros(self.sensor.shape, self.sensor.dtype), time_s)


class RaisesOSError(Camera):
    def require_wire(self) -> None:
        if not self.wire.there:
            raise OSError("gone")


class TakesAnySensor(Camera):
    def open(self) -> DeviceIdentity:
        self.sensor = self.real
        return super().open()


class OpensOnce(Camera):
    def close(self) -> None:
        if not self.opened:
            raise LinkDownError("was not open")
        super().close()


class Verbose(Camera):
    def require_wire(self) -> None:
        if not self.wire.there:
            raise LinkDownError("gone\nfor good")


@pytest.mark.parametrize(
    ("driver", "check", "words"),
    [
        (Nameless, camera_conformance.check_identity, "without a kind"),
        (OneBehind, camera_conformance.check_pictures, "not what the sensor saw"),
        (
            AtTransfer,
            camera_conformance.check_screen_may_change_after_exposure,
            "was over before the scene changed",
        ),
        (KeepsTheArray, camera_conformance.check_given_array_is_not_kept, "keeps a reference"),
        (TimeOfArrival, camera_conformance.check_time_stamps, "is not within its exposure"),
        (Hasty, camera_conformance.check_time_stamps, "is over after"),
        (
            TakesWhateverComes,
            camera_conformance.check_abandoned_exposure,
            "not what the sensor saw",
        ),
        (TakesWhateverComes, camera_conformance.check_late_frame, "a frame after a late one"),
        (TakesWhateverComes, camera_conformance.check_frozen_camera, "raises no LinkError"),
        (Fills, camera_conformance.check_lost_frame, "raises no FrameLostError"),
        (
            RaisesOSError,
            camera_conformance.check_unplugged,
            "raises LinkError instead of LinkDownError",
        ),
        (TakesAnySensor, camera_conformance.check_other_sensor, "raises no DeviceRefusedError"),
    ],
    ids=lambda value: getattr(value, "__name__", "")[:30],
)
def test_a_mistake_of_a_camera_driver_is_found(
    driver: type[Camera], check: camera_conformance.Check, words: str
) -> None:
    bench = Bench()
    bench.driver = driver
    with pytest.raises(ConformanceError, match=words):
        check(bench)


def test_a_driver_that_cannot_be_closed_twice_is_found() -> None:
    bench = Bench()
    bench.driver = OpensOnce
    with pytest.raises(LinkDownError, match="was not open"):
        camera_conformance.check_closing(bench)


def test_a_message_of_two_lines_is_one_line_where_it_is_shown() -> None:
    bench = Bench()
    bench.driver = Verbose
    camera_conformance.check_unplugged(bench)  # the camera is guarded


class Panel:
    """A driver that is right; the panel is `bench`."""

    def __init__(self, bench: Any, width_px: int) -> None:
        self.bench, self.width_px = bench, width_px

    def open(self) -> DeviceIdentity:
        self.require_wire()
        if self.width_px != self.bench.width_px:
            raise DeviceRefusedError(f"{self.bench.width_px} x 48, not {self.width_px}")
        return DeviceIdentity("right", "", "")

    def prepare(self, levels: Any) -> Any:
        return levels.copy()

    def show(self, picture: Any) -> None:
        self.require_wire()
        self.bench.light(picture)

    def close(self) -> None:
        """Nothing to release."""

    def describe(self) -> dict[str, str]:
        return {"port": "wire"}

    def require_wire(self) -> None:
        if not self.bench.there:
            raise LinkDownError("gone")


class PanelBench(display_conformance.DisplayBench):
    driver: type[Panel] = Panel
    there = True

    def make(self, width_px: int, height_px: int) -> Panel:
        return self.driver(self, width_px)

    def unplug(self) -> None:
        self.there = False

    def plug_in(self) -> None:
        self.there = True


@pytest.mark.parametrize(
    "check", display_conformance.list_checks(PanelBench), ids=lambda check: check.__name__
)
def test_a_right_display_driver_passes(check: display_conformance.Check) -> None:
    check(PanelBench())


class Smooths(Panel):
    def prepare(self, levels: Any) -> Any:
        return ((levels.astype(np.int64) + np.roll(levels, 1, axis=1)) // 2).astype(np.uint8)


class KeepsTheSource(Panel):
    def prepare(self, levels: Any) -> Any:
        return levels


class Stays(Panel):
    """Says nothing when its display is gone."""

    def require_wire(self) -> None:
        """There is no check."""


class AnySize(Panel):
    def open(self) -> DeviceIdentity:
        return DeviceIdentity("wrong", "", "")


class Portless(Panel):
    def describe(self) -> dict[str, str]:
        return {}


@pytest.mark.parametrize(
    ("driver", "check", "words"),
    [
        (Smooths, display_conformance.check_pictures, "does not show the picture as sent"),
        (KeepsTheSource, display_conformance.check_prepared_pictures, "that was prepared before"),
        (Stays, display_conformance.check_unplugged, "raises no LinkError"),
        (AnySize, display_conformance.check_other_size, "raises no DeviceRefusedError"),
        (Portless, display_conformance.check_identity, "describe has no port"),
    ],
    ids=lambda value: getattr(value, "__name__", "")[:30],
)
def test_a_mistake_of_a_display_driver_is_found(
    driver: type[Panel], check: display_conformance.Check, words: str
) -> None:
    bench = PanelBench()
    bench.driver = driver
    with pytest.raises(ConformanceError, match=words):
        check(bench)
