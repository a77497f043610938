"""Camera and display of another vendor, as a package of its own: nothing of the product knows it.

Without an emulator the camera films the display directly, in a dark room without a mirror. The
camera brings about the `faults` of its settings, one at each `fault_every`-th exposure.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from firmware_iface import optical_roles, roles, settings

WHITE_ADU, DARK_ADU, NOISE_ADU = 200.0, 5.0, 0.5


class Room:
    """The display that the camera films, and its light."""

    levels: Any = None

    def light(self, levels: Any) -> None:
        """Show a picture."""
        self.levels = levels

    def see(self, shape: tuple[int, int], random: np.random.Generator) -> Any:
        """The display in the camera's pixels, each the mean of a block of the display's."""
        counts = np.full(shape, DARK_ADU)
        if self.levels is not None:
            rows, columns = (
                big // small for big, small in zip(self.levels.shape, shape, strict=True)
            )
            blocks = self.levels[: rows * shape[0], : columns * shape[1]].reshape(
                shape[0], rows, shape[1], columns
            )
            counts += WHITE_ADU * blocks.mean(axis=(1, 3)) / 255.0
        return np.rint(counts + random.normal(0.0, NOISE_ADU, shape)).clip(0, 255).astype(np.uint8)


ROOM = Room()


class CameraSettings(settings.Section):
    """The camera."""

    exposure_ms: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """Exposure. Set it as needed."""
    faults: tuple[str, ...] = ()
    """What goes wrong. Set it in tests."""
    fault_every: int = 30
    """Exposures between two faults. Set it in tests."""


class CameraEmulator:
    """Sees what the simulated sensor sees."""

    def __init__(self, config: CameraSettings, view: Callable[[], Any]) -> None:
        self.view = view


class StudioCamera:
    """Takes a frame in one call."""

    Settings = CameraSettings

    def __init__(
        self,
        config: CameraSettings,
        sensor: optical_roles.SensorFormat,
        clock: optical_roles.DriverClock,
        library: CameraEmulator | None = None,
    ) -> None:
        self._config, self._sensor, self._clock, self._library = config, sensor, clock, library
        self._random = np.random.default_rng(3)
        self._faults = list(config.faults)
        self._exposures = 0
        self._open = False

    def open(self) -> roles.DeviceIdentity:
        self._open = True
        return roles.DeviceIdentity("Studio camera", "S1", f"process {os.getpid()}")

    def grab(self, out: Any = None) -> optical_roles.Frame:
        if not self._open:
            raise roles.LinkDownError("camera studio_cam: is not open")
        self._exposures += 1
        time_s = self._clock.now()
        self._clock.sleep(self._config.exposure_ms / 1000.0)
        pixels = (
            self._library.view() if self._library else ROOM.see(self._sensor.shape, self._random)
        )
        if self._faults and self._exposures % self._config.fault_every == 0:
            return self._fail(self._faults.pop(0), optical_roles.Frame(pixels, time_s))
        return optical_roles.Frame(pixels, time_s)

    def close(self) -> None:
        self._open = False

    def describe(self) -> dict[str, str]:
        return {"port": "studio camera"}

    def _fail(self, fault: str, frame: optical_roles.Frame) -> Any:
        match fault:
            case "raise":
                raise RuntimeError("bus error 5")
            case "exit":
                sys.exit(3)
            case "die":
                os._exit(9)
            case "hang":
                threading.Event().wait()
            case "nothing":
                return None
            case "size":
                return optical_roles.Frame(frame.pixels[:-1], frame.time_s)
            case "late":
                return optical_roles.Frame(frame.pixels, frame.time_s - 1.0)
            case "close":
                self._open = False
                raise roles.LinkDownError("unplugged")
        raise AssertionError(fault)


class WallSettings(settings.ScreenSection):
    """The display."""

    bright: bool = True
    """Full light. Set it to false at night."""


class WallEmulator:
    """Shows what it gets on the simulated panel."""

    def __init__(self, config: WallSettings, light: Callable[[Any], None]) -> None:
        self.light = light


class StudioWall:
    """Shows pictures pixel by pixel."""

    Settings = WallSettings

    def __init__(self, config: WallSettings, library: WallEmulator | None = None) -> None:
        self._config = config
        self._light = library.light if library else ROOM.light

    def open(self) -> roles.DeviceIdentity:
        return roles.DeviceIdentity("Studio wall", "W1", "")

    def prepare(self, levels: Any) -> Any:
        return levels.copy()

    def show(self, picture: Any) -> None:
        self._light(picture)

    def close(self) -> None:
        """Nothing to release."""

    def describe(self) -> dict[str, str]:
        return {"port": "studio wall"}
