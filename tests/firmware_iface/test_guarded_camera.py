"""A camera whose driver makes every mistake: each becomes one line,
and the camera is opened again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.optical_roles import Frame, FrameLostError, SensorFormat
from firmware_iface.roles import DeviceIdentity, DeviceRefusedError, LinkDownError, LinkError

SENSOR = SensorFormat(6, 4)


class Time:
    now_s = 0.0

    def now(self) -> float:
        self.now_s += 0.01
        return self.now_s


class Driver:
    """Triggers and transfers; `fails` has what a method raises or returns instead, once."""

    def __init__(self, time: Time) -> None:
        self.time = time
        self.fails: dict[str, Any] = {}
        self.called: list[str] = []
        self._time_s = 0.0

    def _call(self, method: str, result: Any = None) -> Any:
        self.called.append(method)
        if method not in self.fails:
            return result
        failure = self.fails.pop(method)
        if isinstance(failure, BaseException):
            raise failure
        return failure

    def open(self) -> Any:
        return self._call("open", DeviceIdentity("Acme", "7", "1.0"))

    def close(self) -> None:
        self._call("close")

    def describe(self) -> Any:
        return self._call("describe", {"manual": "p. 3"})


class Exposing(Driver):
    def expose(self, out: Any = None) -> None:
        self._time_s = self.time.now()
        self._call("expose")

    def fetch(self) -> Any:
        return self._call("fetch", Frame(np.full((4, 6), 9, np.uint8), self._time_s))


class Grabbing(Driver):
    def grab(self, out: Any = None) -> Any:
        return self._call("grab", Frame(np.full((4, 6), 9, np.uint8), self.time.now()))


@pytest.fixture
def driver() -> Exposing:
    return Exposing(Time())


@pytest.fixture
def camera(driver: Exposing) -> GuardedCamera:
    return GuardedCamera(driver, SENSOR, driver.time.now, "camera acme")


def message(act: Callable[[], object], kind: type[LinkError] = LinkError) -> str:
    """The one line of a failure."""
    with pytest.raises(kind) as caught:
        act()
    assert type(caught.value) is kind
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("camera acme: ")
    return str(caught.value)


def test_the_first_exposure_opens_it(camera: GuardedCamera, driver: Exposing) -> None:
    camera.grab()
    camera.grab()
    assert driver.called == ["open", "expose", "fetch", "expose", "fetch"]


def test_a_driver_that_grabs_does_for_both_steps() -> None:
    driver = Grabbing(Time())
    camera = GuardedCamera(driver, SENSOR, driver.time.now, "camera acme")
    camera.expose()
    assert camera.fetch().pixels[0, 0] == 9
    assert camera.grab().pixels[0, 0] == 9
    assert driver.called == ["open", "grab", "grab"]
    driver.fails["grab"] = FrameLostError("not whole")
    camera.expose()  # the cycle shows the pattern again after a lost frame, which `fetch` reports
    assert message(camera.fetch, FrameLostError) == "camera acme: not whole"


def test_what_takes_no_frames_is_no_camera() -> None:
    with pytest.raises(
        ValueError, match="camera acme: the driver has neither grab nor expose and fetch"
    ):
        GuardedCamera(Driver(Time()), SENSOR, Time().now, "camera acme")


@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (RuntimeError("bus\nerror 5"), "RuntimeError: bus error 5"),
        (SystemExit(3), "SystemExit: 3"),
        (OSError(), "OSError: no message"),
        (ValueError("x" * 1000), "ValueError: " + "x" * 300),
    ],
    ids=lambda value: type(value).__name__,
)
@pytest.mark.parametrize("method", ["open", "expose", "fetch"])
def test_whatever_a_driver_raises_is_one_line_and_opens_it_again(
    method: str, failure: BaseException, words: str, camera: GuardedCamera, driver: Exposing
) -> None:
    driver.fails[method] = failure
    assert message(camera.grab) == f"camera acme: {method}: {words}"
    driver.called.clear()
    camera.grab()
    assert driver.called == ["open", "expose", "fetch"]


@pytest.mark.parametrize("kind", [LinkDownError, DeviceRefusedError, LinkError])
def test_a_link_error_keeps_its_kind_and_closes_it(
    kind: type[LinkError], camera: GuardedCamera, driver: Exposing
) -> None:
    driver.fails["expose"] = kind("no answer")
    assert message(camera.expose, kind) == "camera acme: no answer"
    assert driver.called[-1] == "close"
    driver.fails["expose"] = kind("camera 10.0.0.3: no answer")
    with pytest.raises(kind, match=r"^camera 10\.0\.0\.3: no answer$"):
        camera.expose()


def test_a_lost_frame_leaves_it_open_and_is_taken_again(
    camera: GuardedCamera, driver: Exposing
) -> None:
    camera.expose()
    driver.fails["fetch"] = FrameLostError("not whole")
    message(camera.fetch, FrameLostError)
    driver.fails["fetch"] = FrameLostError("not whole")
    assert camera.grab().pixels[0, 0] == 9
    assert driver.called.count("open") == 1


def test_three_lost_frames_in_a_row_are_a_failure(camera: GuardedCamera, driver: Exposing) -> None:
    def lose() -> None:
        raise FrameLostError("not whole")

    driver.fetch = lose  # type: ignore[method-assign]
    message(camera.grab, FrameLostError)
    assert driver.called.count("expose") == 3


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (np.zeros((4, 7), np.uint8), "gave 7 x 4 uint8, [optics.camera] states 6 x 4 uint8"),
        (np.zeros((4, 6), np.uint16), "gave 6 x 4 uint16"),
        (np.zeros((4, 6, 3), np.uint8), "gave 3 x 6 x 4 uint8"),
        ([[0] * 6] * 4, "gave list"),
    ],
    ids=["size", "type", "colour", "list"],
)
def test_a_picture_of_another_kind_is_refused(
    pixels: Any, words: str, camera: GuardedCamera, driver: Exposing
) -> None:
    camera.expose()
    driver.fails["fetch"] = Frame(pixels, driver.time.now_s)
    assert words in message(camera.fetch)


@pytest.mark.parametrize("time_s", [-1.0, 1e9, float("nan"), None], ids=str)
def test_a_frame_not_exposed_after_its_trigger_is_lost(
    time_s: float | None, camera: GuardedCamera, driver: Exposing
) -> None:
    camera.expose()
    driver.fails["fetch"] = Frame(np.zeros((4, 6), np.uint8), time_s)  # type: ignore[arg-type]
    assert "late, or its time is not on the run's clock" in message(camera.fetch, FrameLostError)


@pytest.mark.parametrize(
    ("method", "result", "words"),
    [
        ("open", "Acme", "open returned str instead of DeviceIdentity"),
        ("fetch", None, "fetch returned NoneType instead of Frame"),
        ("fetch", np.zeros((4, 6)), "fetch returned ndarray instead of Frame"),
    ],
    ids=["open", "none", "array"],
)
def test_a_result_of_another_type_is_refused(
    method: str, result: Any, words: str, camera: GuardedCamera, driver: Exposing
) -> None:
    driver.fails[method] = result
    assert words in message(camera.grab)


def test_no_exposure_nothing_to_fetch(camera: GuardedCamera) -> None:
    camera.grab()
    assert "no exposure to fetch" in message(camera.fetch)


def test_closing_never_raises(camera: GuardedCamera, driver: Exposing) -> None:
    for failure in (RuntimeError("close"), SystemExit(1)):
        driver.fails["close"] = failure
        camera.close()


def test_it_is_described_even_without_a_port(camera: GuardedCamera, driver: Exposing) -> None:
    assert camera.describe() == {"port": "camera acme", "manual": "p. 3"}
    driver.fails["describe"] = "text"
    assert "describe returned str instead of dict" in message(camera.describe)
