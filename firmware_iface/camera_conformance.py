"""Tests whether a camera driver does what the cycle needs, against an emulated camera.

A package's tests extend `CameraBench` and run each check of `list_checks`. A check that needs a
fault which the emulated camera cannot bring about is left out; docs/how-to/new-camera.md lists the
requirements.
"""

import gc
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from firmware_iface import optical_roles, roles
from firmware_iface.guarded_camera import GuardedCamera
from firmware_iface.requirement import overrides, require, require_error, require_identity

_STEP_S = 1e-4  # that a reading of the clock takes: no two moments are the same
_REPEATS = 3
Check = Callable[["CameraBench"], None]


class VirtualTime:
    """A clock that passes by waiting, for drivers and emulators."""

    def __init__(self) -> None:
        self._now_s = 0.0

    def now(self) -> float:
        """Seconds since the start."""
        self._now_s += _STEP_S
        return self._now_s

    def sleep(self, duration_s: float) -> None:
        """Let time pass."""
        self._now_s += duration_s


class CameraBench:
    """An emulated camera that sees `scene`, and its driver. Override `make`, and each possible
    fault.

    Attributes
    ----------
    sensor : SensorFormat
        Size and depth of the emulated sensor.
    exposure_s : float
        Exposure of the driver that `make` makes; 0 if it is unknown.
    clock : DriverClock
        Virtual time; a bench whose camera needs real time replaces it.
    scene : ndarray
        What the sensor sees.
    """

    sensor = optical_roles.SensorFormat(48, 32)
    exposure_s = 0.0

    def __init__(self) -> None:
        time = VirtualTime()
        self.clock = optical_roles.DriverClock(time.now, time.sleep)
        self._random = np.random.default_rng(1)
        self.scene: optical_roles.Pixels = np.zeros(self.sensor.shape, self.sensor.dtype)

    def make(self, sensor: optical_roles.SensorFormat) -> optical_roles.OpticalDevice:
        """Make a driver that is configured for this sensor, not yet connected."""
        raise NotImplementedError

    def lose_frame(self) -> None:
        """Make the frame of the next exposure incomplete, or never sent."""
        raise NotImplementedError

    def delay_frame(self) -> None:
        """Make the frame of the next exposure arrive after the driver's time limit."""
        raise NotImplementedError

    def freeze(self) -> None:
        """Make the camera send its last frame again for each exposure."""
        raise NotImplementedError

    def unplug(self) -> None:
        """Take the camera away, with its settings."""
        raise NotImplementedError

    def plug_in(self) -> None:
        """Bring it back."""
        raise NotImplementedError

    def view(self) -> optical_roles.Pixels:
        """What the sensor sees now: for the emulator."""
        return self.scene.copy()

    def change_scene(self) -> optical_roles.Pixels:
        """Show another scene, and return it."""
        top = min(1 << self.sensor.bits, 1 << 16)
        self.scene = self._random.integers(0, top, self.sensor.shape).astype(self.sensor.dtype)
        return self.scene


def list_checks(bench: type[CameraBench]) -> list[Check]:
    """List the checks for which a bench can bring about the faults."""
    faults_of: dict[Check, tuple[str, ...]] = {
        check_identity: (),
        check_pictures: (),
        check_given_array_is_not_kept: (),
        check_time_stamps: (),
        check_screen_may_change_after_exposure: (),
        check_abandoned_exposure: (),
        check_lost_frame: ("lose_frame",),
        check_late_frame: ("delay_frame",),
        check_frozen_camera: ("freeze",),
        check_unplugged: ("unplug", "plug_in"),
        check_other_sensor: (),
        check_closing: (),
    }
    return [check for check, faults in faults_of.items() if overrides(bench, CameraBench, faults)]


def check_identity(bench: CameraBench) -> None:
    """Opening gives the identity; the description names port and settings."""
    with _open_driver(bench) as driver:
        require_identity(driver)


def check_pictures(bench: CameraBench) -> None:
    """Every frame is what the sensor sees at its exposure, in the configured size and type."""
    with _open_camera(bench) as camera:
        for _ in range(_REPEATS):
            scene = bench.change_scene()
            _require_picture(camera.grab(), scene, "a frame")
        scene = bench.change_scene()
        out = np.zeros(bench.sensor.shape, bench.sensor.dtype)
        frame = camera.grab(out)
        _require_picture(frame, scene, "a frame that may be written to a given array")


def check_given_array_is_not_kept(bench: CameraBench) -> None:
    """The array for a frame is memory that others use: a driver keeps no reference to it after
    `fetch`.
    """
    with _open_camera(bench) as camera:
        out = np.zeros(bench.sensor.shape, bench.sensor.dtype)
        kept = weakref.ref(out)
        camera.grab(out)
        bench.change_scene()
        camera.grab()  # a frame may keep its array until the next one
        del out
        gc.collect()
        require(kept() is None, "keeps a reference to the array that it was given for a frame")


def check_time_stamps(bench: CameraBench) -> None:
    """A frame's time is the start of its exposure on the given clock; an exposure lasts as long as
    configured.
    """
    with _open_camera(bench) as camera:
        earlier_s = bench.clock.now()
        for _ in range(_REPEATS):
            before_s = bench.clock.now()
            camera.expose()
            over_s = bench.clock.now()
            frame = camera.fetch()
            require(
                before_s <= frame.time_s <= over_s,
                f"time_s = {frame.time_s:g} is not within its exposure",
            )
            require(frame.time_s > earlier_s, "time_s does not advance")
            require(
                over_s >= frame.time_s + bench.exposure_s,
                f"an exposure of {bench.exposure_s:g} s is over after {over_s - frame.time_s:g} s",
            )
            earlier_s = frame.time_s


def check_screen_may_change_after_exposure(bench: CameraBench) -> None:
    """What changes between `expose` and `fetch` is not in the frame;
    each exposure is fetched once.
    """
    with _open_camera(bench) as camera:
        scene = bench.change_scene()
        camera.expose()
        if isinstance(camera.driver, optical_roles.ExposingCamera):
            bench.change_scene()
        _require_picture(
            camera.fetch(), scene, "a frame whose exposure was over before the scene changed"
        )
        if isinstance(camera.driver, optical_roles.ExposingCamera):
            fetch = camera.driver.fetch
        else:
            fetch = camera.fetch
        require_error(fetch, roles.LinkError)


def check_abandoned_exposure(bench: CameraBench) -> None:
    """An exposure that is never fetched does not answer the next one."""
    with _open_camera(bench) as camera:
        bench.change_scene()
        camera.expose()
        scene = bench.change_scene()
        camera.expose()
        _require_picture(camera.fetch(), scene, "the frame after an exposure that was not fetched")


def check_lost_frame(bench: CameraBench) -> None:
    """A lost frame is a FrameLostError, and the next exposure works."""
    with _open_camera(bench) as camera:
        camera.grab()
        bench.change_scene()
        bench.lose_frame()
        camera.expose()
        require_error(camera.fetch, optical_roles.FrameLostError)
        scene = bench.change_scene()
        _require_picture(_capture_again(camera), scene, "the frame after a lost one")


def check_late_frame(bench: CameraBench) -> None:
    """A late frame is lost, and never taken for the next one."""
    with _open_camera(bench) as camera:
        camera.grab()
        bench.change_scene()
        bench.delay_frame()
        camera.expose()
        require_error(camera.fetch, optical_roles.FrameLostError)
        for _ in range(_REPEATS):
            scene = bench.change_scene()
            _require_picture(_capture_again(camera), scene, "a frame after a late one")


def check_frozen_camera(bench: CameraBench) -> None:
    """An old frame is never returned as a new one."""
    with _open_camera(bench) as camera:
        bench.change_scene()
        camera.grab()
        bench.change_scene()
        bench.freeze()
        require_error(camera.grab, roles.LinkError)


def check_unplugged(bench: CameraBench) -> None:
    """A camera that is gone is a LinkDownError, and is opened again once it is back."""
    with _open_camera(bench) as camera:
        camera.grab()
        bench.unplug()
        require_error(camera.grab, roles.LinkError)
        require_error(camera.open, roles.LinkDownError)
        bench.plug_in()
        camera.open()
        scene = bench.change_scene()
        _require_picture(camera.grab(), scene, "a frame after the camera came back")


def check_other_sensor(bench: CameraBench) -> None:
    """A camera with a sensor of another size is refused, with both sizes."""
    other = replace(bench.sensor, width_px=bench.sensor.width_px + 16)
    with _open_driver(bench, other) as driver:
        message = require_error(driver.open, roles.DeviceRefusedError)
        for width_px in (bench.sensor.width_px, other.width_px):
            require(
                str(width_px) in message,
                f"{message!r} does not name the width of {width_px} pixels",
            )


def check_closing(bench: CameraBench) -> None:
    """Closing never raises, closed or open, and a closed camera can be opened again."""
    with _open_driver(bench) as driver:
        driver.close()
        driver.open()
        driver.close()
        driver.close()
    with _open_camera(bench) as camera:
        for _ in range(_REPEATS):
            camera.open()
            scene = bench.change_scene()
            _require_picture(camera.grab(), scene, "a frame after the camera was closed and opened")
            camera.close()


@contextmanager
def _open_driver(
    bench: CameraBench, sensor: optical_roles.SensorFormat | None = None
) -> Iterator[optical_roles.OpticalDevice]:
    driver = bench.make(sensor or bench.sensor)
    try:
        yield driver
    finally:
        driver.close()


@contextmanager
def _open_camera(bench: CameraBench) -> Iterator[GuardedCamera]:
    with _open_driver(bench) as driver:
        camera = GuardedCamera(driver, bench.sensor, bench.clock.now, "camera under test")
        camera.open()
        yield camera


def _capture_again(camera: GuardedCamera) -> optical_roles.Frame:
    camera.expose()
    return camera.fetch()


def _require_picture(frame: optical_roles.Frame, scene: optical_roles.Pixels, what: str) -> None:
    require(np.array_equal(frame.pixels, scene), f"{what} is not what the sensor saw")
