"""A camera for the measurement cycle, whichever its driver: opened when needed, every frame
checked.

A driver takes a frame in one call (`grab`), or triggers (`expose`) and transfers (`fetch`) in two.
This class offers all three. Whatever the driver raises becomes a LinkError with one line; after any
failure but a lost frame the driver is closed, and opened again by the next exposure.
"""

import math
from typing import Any

import numpy as np

from firmware_iface import optical_roles, roles
from firmware_iface.driver_calls import call_driver, close_driver

# A camera's clock, converted to the run's clock, may be off by this; a frame of an earlier trigger
# is older
_CLOCK_TOLERANCE_S = 0.005


class GuardedCamera:
    """The role ExposingCamera on a driver.

    Parameters
    ----------
    driver : OpticalDevice
        With `grab`, or with `expose` and `fetch`.
    sensor : SensorFormat
        Size and type that every frame must have.
    now : callable
        The run's clock, on which the frames' times must be.
    name : str
        Begins its messages.

    Raises
    ------
    ValueError
        The driver is no camera.
    """

    def __init__(
        self,
        driver: optical_roles.OpticalDevice,
        sensor: optical_roles.SensorFormat,
        now: roles.Clock,
        name: str,
    ) -> None:
        self._overlaps = isinstance(driver, optical_roles.ExposingCamera)
        if not self._overlaps and not isinstance(driver, optical_roles.Camera):
            raise ValueError(
                f"{name}: the driver has neither grab nor expose and fetch, so it is no camera"
            )
        self.driver = driver
        self._sensor = sensor
        self._now = now
        self._name = name
        self._opened = False
        self._triggered_s = math.nan
        self._grabbed: optical_roles.Frame | optical_roles.FrameLostError | None = None

    def open(self) -> roles.DeviceIdentity:
        """Connect and apply the settings. Raises LinkError."""
        if self._opened:
            self.close()
        identity: roles.DeviceIdentity = self._call_camera("open", returns=roles.DeviceIdentity)
        self._opened = True
        return identity

    def expose(self, out: optical_roles.Pixels | None = None) -> None:
        """Trigger, and return when the exposure is over. Raises LinkError."""
        if not self._opened:
            self.open()
        self._grabbed = None
        self._triggered_s = self._now()
        if self._overlaps:
            self._call_camera("expose", out)
            return
        try:
            self._grabbed = self._call_camera("grab", out, returns=optical_roles.Frame)
        except optical_roles.FrameLostError as error:
            self._grabbed = error

    def fetch(self) -> optical_roles.Frame:
        """The frame of the last `expose`. Raises FrameLostError (expose again), LinkError."""
        if math.isnan(self._triggered_s):
            raise roles.LinkError(f"{self._name}: no exposure to fetch")
        triggered_s, self._triggered_s = self._triggered_s, math.nan
        found, self._grabbed = self._grabbed, None
        if self._overlaps:
            found = self._call_camera("fetch", returns=optical_roles.Frame)
        if isinstance(found, optical_roles.FrameLostError):
            raise found
        assert found is not None
        self._check_frame(found, triggered_s)
        return found

    def grab(self, out: optical_roles.Pixels | None = None) -> optical_roles.Frame:
        """One exposure, taken again when it is lost. Raises LinkError (no camera, or three frames
        lost in a row).
        """
        for _ in range(optical_roles.TRIES - 1):
            try:
                self.expose(out)
                return self.fetch()
            except optical_roles.FrameLostError:
                continue
        self.expose(out)
        return self.fetch()

    def close(self) -> None:
        """Release the camera. Never raises."""
        self._opened = False
        self._triggered_s = math.nan
        self._grabbed = None
        close_driver(self.driver)

    def describe(self) -> dict[str, str]:
        """For people: what the driver states."""
        found: dict[str, str] = call_driver(self._name, self.driver, "describe", returns=dict)
        return {"port": self._name, **found}

    def _call_camera(self, method: str, *arguments: object, returns: type[object] = object) -> Any:
        try:
            return call_driver(self._name, self.driver, method, *arguments, returns=returns)
        except optical_roles.FrameLostError:
            raise
        except roles.LinkError:
            self.close()
            raise

    def _check_frame(self, frame: optical_roles.Frame, triggered_s: float) -> None:
        """Refuse a frame of another size or type, and one that was
        not exposed after its trigger.
        """
        pixels, sensor = frame.pixels, self._sensor
        if (
            not isinstance(pixels, np.ndarray)
            or pixels.shape != sensor.shape
            or pixels.dtype != sensor.dtype
        ):
            self.close()
            raise roles.LinkError(
                f"{self._name}: gave {_describe_array(pixels)}, [optics.camera] states "
                f"{sensor.width_px} x {sensor.height_px} {sensor.dtype}"
            )
        # A frame from before its trigger shows the pattern before; one from the future has a time
        # of another clock. Both are lost frames: the pattern is shown again.
        earliest_s = triggered_s - _CLOCK_TOLERANCE_S
        latest_s = self._now() + _CLOCK_TOLERANCE_S
        if not isinstance(frame.time_s, int | float) or not earliest_s <= frame.time_s <= latest_s:
            raise optical_roles.FrameLostError(
                f"{self._name}: gave a frame of {frame.time_s} s for the trigger at "
                f"{triggered_s:.3f} s: late, or its time is not on the run's clock"
            )


def _describe_array(pixels: object) -> str:
    if not isinstance(pixels, np.ndarray):
        return type(pixels).__name__
    size = " x ".join(str(length) for length in reversed(pixels.shape))
    return f"{size} {pixels.dtype}"
