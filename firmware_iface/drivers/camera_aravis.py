"""GenICam cameras (USB3 Vision and GigE Vision) through aravis: role Camera.

Standards: GenICam SFNC 2.7 (features' names), GigE Vision 2.0, USB3 Vision 1.1; aravis 0.8 manual.

A software trigger starts every exposure, so that a frame belongs to the pattern on the screen. An
incomplete frame is counted as lost. After a timeout the stream is restarted, as a late frame would
be taken for the answer to the next trigger.
"""

import ctypes
import threading
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from firmware_iface import optical_roles, roles, settings
from firmware_iface.links import aravis as arv

# One frame being filled and one to spare; each is copied out at once
_BUFFERS = 3
# Room for one frame of 5 MB in the kernel while the reading thread has no core
_SOCKET_BYTES = 8 << 20
# A newly started stream misses the first trigger (seen on loopback without this)
_STREAM_READY_S = 0.2
# arvenums.h, arvgvdevice.h, arvgvstream.h
_AUTO_OFF = 0
_CONTINUOUS = 0
_ADJUST_NEVER = 0
_NO_PACKET_SOCKET = 1
_RANGE_CHECKED = 1  # arvdevice.h; by default the library writes values outside the camera's range
_SUCCESS = 0  # ArvBufferStatus
_REAL_TIME = optical_roles.DriverClock()
_GONE = (arv.NOT_CONNECTED, arv.TRANSFER_ERROR, arv.TIMEOUT)
_TAKEN = (arv.NOT_CONTROLLER, arv.ACCESS_DENIED, arv.BUSY)


@dataclass(slots=True)
class FrameCounts:
    """Results of the triggers: `taken` whole, `incomplete`, `missing` (no frame came), and
    `reconnects`.
    """

    taken: int = 0
    incomplete: int = 0
    missing: int = 0
    reconnects: int = 0


class AravisCamera:
    """The camera; opened by the first exposure, and again by the next one after its link was lost.

    Parameters
    ----------
    config : AravisCameraConfig
        Which camera, and its exposure, gain and format.
    sensor : SensorFormat
        Size of the sensor in `[optics.camera]`; a camera of another size is refused.
    clock : DriverClock
        Of the frames' times; the run's clock in a hold.

    Attributes
    ----------
    counts : FrameCounts
        Results of the triggers so far.
    """

    def __init__(
        self,
        config: settings.AravisCameraConfig,
        sensor: optical_roles.SensorFormat,
        clock: optical_roles.DriverClock = _REAL_TIME,
    ) -> None:
        self.config = config
        self.counts = FrameCounts()
        self._name = f"camera {config.camera}" if config.camera else "camera"
        self._size = (sensor.width_px, sensor.height_px)
        self._now = clock.now
        self._sleep = clock.sleep
        self._camera: int | None = None
        self._stream: int | None = None
        self._opened = False
        self._pending: tuple[float, optical_roles.Pixels | None] | None = None

    def open(self) -> roles.DeviceIdentity:
        """Connect, apply the settings, read them back, start the stream.

        Raises LinkError (no library, no camera, camera in use), DeviceRefusedError (a setting that
        the camera does not take).
        """
        self.close()
        library, config = arv.load_aravis(), self.config
        try:
            self._camera = library.call("arv_camera_new", config.camera.encode() or None)
            if not self._camera:
                raise roles.LinkDownError(f"{self._name}: not found; see `membrane-ctrl devices`")
            self._check_ownership()
            identity = self._read_identity()
            self._apply_settings()
            self._start_stream()
        except roles.LinkError as error:
            self.close()
            raise self._make_link_error(error, "opening") from None
        self.counts.reconnects += self._opened
        self._opened = True
        return identity

    def expose(self, out: optical_roles.Pixels | None = None) -> None:
        """Trigger, and return when the exposure is over: the screen may change while the frame is
        transferred.

        Raises LinkError without a camera.
        """
        # No frame of an earlier exposure may be left, in flight or in the stream: frames carry no
        # number of their trigger, so the next one would be taken for the answer to this one.
        if self._pending is not None and self._stream is not None:
            self._discard_pending()
        if self._stream is None:
            self.open()
        library = arv.load_aravis()
        while buffer := library.call("arv_stream_try_pop_buffer", self._stream):
            library.call("arv_stream_push_buffer", self._stream, buffer)  # arrived unrequested
        time_s = self._now()
        try:
            library.call("arv_camera_software_trigger", self._camera)
        except roles.LinkError as error:
            self._drop_camera()
            raise self._make_link_error(error, "trigger") from None
        self._pending = time_s, out
        self._sleep(max(0.0, time_s + self.config.exposure_ms / 1000.0 - self._now()))

    def fetch(self) -> optical_roles.Frame:
        """The frame of the last `expose`, in its `out` if one was given.

        Raises FrameLostError (it did not come, or not whole: show the pattern again and expose
        again), LinkError (nothing was exposed).
        """
        if self._pending is None or self._stream is None:
            raise roles.LinkError(f"{self._name}: no exposure to fetch")
        time_s, out = self._pending
        self._pending = None
        # A frame that does not come in time: the stream begins again, so that it cannot come later
        library = arv.load_aravis()
        timeout_us = round(1e6 * self.config.timeout_s)
        buffer = library.call("arv_stream_timeout_pop_buffer", self._stream, timeout_us)
        if not buffer:
            self.counts.missing += 1
            self._restart_stream()
            raise optical_roles.FrameLostError(
                f"{self._name}: no frame within {self.config.timeout_s:g} s of its trigger"
            )
        # A frame that came: copied if it is whole, and its buffer goes back to the stream
        try:
            status = library.call("arv_buffer_get_status", buffer)
            if status != _SUCCESS:
                self.counts.incomplete += 1
                raise optical_roles.FrameLostError(
                    f"{self._name}: frame not whole (aravis status {status}); cable, packet "
                    "size, other traffic?"
                )
            frame = optical_roles.Frame(self._copy_pixels(buffer, out), time_s)
        finally:
            library.call("arv_stream_push_buffer", self._stream, buffer)
        self.counts.taken += 1
        return frame

    def close(self) -> None:
        """Release the camera. Never raises."""
        self._stop_stream()
        if self._camera is not None:
            arv.load_aravis().call("g_object_unref", self._camera)
        self._camera = self._pending = None

    def _drop_camera(self) -> None:
        """Drop a camera that does not answer, in a thread,
        as the library takes 10 s to close it.
        """
        left = [instance for instance in (self._stream, self._camera) if instance is not None]
        self._stream = self._camera = self._pending = None
        unref = arv.load_aravis().call
        threading.Thread(
            target=lambda: [unref("g_object_unref", instance) for instance in left], daemon=True
        ).start()

    def describe(self) -> dict[str, str]:
        """For people: where, settings, what was lost."""
        config, counts = self.config, self.counts
        return {
            "port": config.camera or "first GenICam camera",
            "settings": f"{self._size[0]} x {self._size[1]} {config.pixel_format}, "
            f"{config.exposure_ms:g} ms, {config.gain_db:g} dB",
            "frames": f"{counts.taken} taken, {counts.incomplete} incomplete, {counts.missing} "
            f"missing, {counts.reconnects} reconnects",
            "manual": "GenICam SFNC 2.7; aravis 0.8",
        }

    def _read_identity(self) -> roles.DeviceIdentity:
        words = (
            arv.load_aravis().text(f"arv_camera_get_{word}", self._camera)
            for word in ("vendor_name", "model_name", "device_serial_number")
        )
        vendor, model, serial = words
        return roles.DeviceIdentity(f"{vendor} {model}", serial, "", self.describe()["settings"])

    def _check_ownership(self) -> None:
        """Check control: a GigE Vision camera lets anyone read, but ignores writes except its
        controller's.
        """
        call = arv.load_aravis().call
        device = call("arv_camera_get_device", self._camera)
        call("arv_device_set_range_check_policy", device, _RANGE_CHECKED)
        if call("arv_camera_is_gv_device", self._camera) and not call(
            "arv_gv_device_is_controller", device
        ):
            raise arv.AravisError("another controller", arv.NOT_CONTROLLER)

    def _apply_settings(self) -> None:
        # Every setting is read back: a camera may round a value, or ignore a write. First the size
        # and format of the frames, on which the size of the buffers depends.
        call, camera, config = arv.load_aravis().call, self._camera, self.config
        sensor = [ctypes.c_int() for _ in range(2)]
        call("arv_camera_get_sensor_size", camera, *map(ctypes.byref, sensor))
        if (found := (sensor[0].value, sensor[1].value)) != self._size:
            raise roles.DeviceRefusedError(
                f"its sensor has {found[0]} x {found[1]} pixels, [optics.camera] states "
                f"{self._size[0]} x {self._size[1]}"
            )
        call("arv_camera_set_pixel_format_from_string", camera, config.pixel_format.encode())
        self._must_be("pixel_format", call("arv_camera_get_pixel_format", camera), self._format)
        call("arv_camera_set_region", camera, 0, 0, *self._size)
        region = [ctypes.c_int() for _ in range(4)]
        call("arv_camera_get_region", camera, *map(ctypes.byref, region))
        size = tuple(number.value for number in region)
        self._must_be("x, y, width and height in px", size, (0, 0, *self._size))
        call("arv_camera_set_acquisition_mode", camera, _CONTINUOUS)
        # every trigger of the camera is cleared first; the library finds the selector that exists
        # (FrameStart, or only FrameBurstStart as on Hikrobot's cameras)
        call("arv_camera_set_trigger", camera, b"Software")
        self._must_be("trigger source", call("arv_camera_get_trigger_source", camera), b"Software")
        # Exposure and gain by hand: an automatic would follow the patterns on the screen.
        if call("arv_camera_is_exposure_auto_available", camera):
            call("arv_camera_set_exposure_time_auto", camera, _AUTO_OFF)
        call("arv_camera_set_exposure_time", camera, 1000.0 * config.exposure_ms)
        exposure_ms = call("arv_camera_get_exposure_time", camera) / 1000.0
        # sensors count in lines
        if abs(exposure_ms - config.exposure_ms) > max(0.02 * config.exposure_ms, 0.02):
            self._must_be("exposure_ms", exposure_ms, config.exposure_ms)
        if call("arv_camera_is_gain_auto_available", camera):
            call("arv_camera_set_gain_auto", camera, _AUTO_OFF)
        if call("arv_camera_is_gain_available", camera):
            call("arv_camera_set_gain", camera, config.gain_db)
            gain_db = call("arv_camera_get_gain", camera)
            if abs(gain_db - config.gain_db) > 0.1:
                self._must_be("gain_db", gain_db, config.gain_db)

    def _must_be(self, name: str, found: Any, wanted: Any) -> None:
        if found != wanted:
            raise roles.DeviceRefusedError(f"{name} = {found} after {wanted} was written")

    @property
    def _format(self) -> int:
        return arv.PIXEL_FORMATS[self.config.pixel_format]

    def _start_stream(self) -> None:
        library, camera = arv.load_aravis(), self._camera
        gige = bool(library.call("arv_camera_is_gv_device", camera))
        if gige:
            # packet sockets need root
            library.call("arv_camera_gv_set_stream_options", camera, _NO_PACKET_SOCKET)
            if self.config.packet_bytes:
                library.call("arv_camera_gv_set_packet_size_adjustment", camera, _ADJUST_NEVER)
                library.call("arv_camera_gv_set_packet_size", camera, self.config.packet_bytes)
        self._stream = library.call("arv_camera_create_stream", camera, None, None)
        if not self._stream:
            raise roles.LinkError("no stream")
        if gige:
            library.fix_socket_buffer(self._stream, _SOCKET_BYTES)
        # Buffers must be in the stream before frames arrive: without one, frames are lost.
        payload_bytes = library.call("arv_camera_get_payload", camera)
        for _ in range(_BUFFERS):
            buffer = library.call("arv_buffer_new_allocate", payload_bytes)
            library.call("arv_stream_push_buffer", self._stream, buffer)
        library.call("arv_camera_start_acquisition", camera)
        self._sleep(_STREAM_READY_S)
        self._discard_frame()

    def _discard_frame(self) -> None:
        """The first frame after a start may be exposed up to 0.1 s after its trigger, with the next
        pattern lit.
        """
        library = arv.load_aravis()
        library.call("arv_camera_software_trigger", self._camera)
        wait_us = round(1e6 * (self.config.timeout_s + self.config.exposure_ms / 1000.0))
        if buffer := library.call("arv_stream_timeout_pop_buffer", self._stream, wait_us):
            library.call("arv_stream_push_buffer", self._stream, buffer)

    def _stop_stream(self) -> None:
        if self._stream is None:
            return
        library = arv.load_aravis()
        with suppress(roles.LinkError):
            library.call("arv_camera_stop_acquisition", self._camera)
        library.call("g_object_unref", self._stream)
        self._stream = None

    def _discard_pending(self) -> None:
        """Wait for the frame of an exposure that was not fetched: later it would answer the next
        trigger.
        """
        self._pending = None
        library = arv.load_aravis()
        timeout_us = round(1e6 * self.config.timeout_s)
        buffer = library.call("arv_stream_timeout_pop_buffer", self._stream, timeout_us)
        if buffer:
            library.call("arv_stream_push_buffer", self._stream, buffer)
        else:
            self._restart_stream()

    def _restart_stream(self) -> None:
        """A new stream to the same camera; a new connection if that
        fails (at the next exposure).
        """
        self._stop_stream()
        try:
            self._start_stream()
        except roles.LinkError:
            self._drop_camera()

    def _copy_pixels(self, buffer: int, out: optical_roles.Pixels | None) -> optical_roles.Pixels:
        """Copy a whole frame's pixels."""
        library = arv.load_aravis()
        found = tuple(
            library.call(f"arv_buffer_get_image_{word}", buffer)
            for word in ("height", "width", "pixel_format")
        )
        height_px, width_px = self._size[::-1]
        # Another size or format would be read as a wrong picture
        if found != (height_px, width_px, self._format):
            raise roles.LinkError(
                f"{self._name}: sent a frame of {found[1]} x {found[0]}, format {found[2]:#x}"
            )
        wide = (self._format >> 16) & 0xFF > 8  # bits a pixel, in the format's number
        dtype: np.dtype[Any] = np.dtype(np.uint16 if wide else np.uint8)
        size = ctypes.c_size_t()
        start = library.call("arv_buffer_get_data", buffer, ctypes.byref(size))
        count = height_px * width_px
        if size.value < count * dtype.itemsize:
            raise roles.LinkError(
                f"{self._name}: sent {size.value} bytes instead of {count * dtype.itemsize}"
            )
        # A view of the library's memory, copied before the buffer is used again
        memory = memoryview((ctypes.c_char * (count * dtype.itemsize)).from_address(start))
        seen: optical_roles.Pixels = np.ndarray(count, dtype, memory).reshape(height_px, width_px)
        if out is None:
            return seen.copy()
        if out.shape != seen.shape or out.dtype != seen.dtype:
            raise ValueError(
                f"camera gives {seen.shape} {seen.dtype}, expected {out.shape} {out.dtype}"
            )
        np.copyto(out, seen)
        return out

    def _make_link_error(self, error: roles.LinkError, doing: str) -> roles.LinkError:
        """A link error with the camera's name and the remedy."""
        name, message = self._name, str(error)
        code = error.code if isinstance(error, arv.AravisError) else -1
        if code in _TAKEN:
            return roles.LinkError(
                f"{name}: in use by another program ({message}); close it, then try again"
            )
        if code == arv.NOT_FOUND:
            return roles.LinkDownError(
                f"{name}: not found; is it on and plugged in? `membrane-ctrl devices` lists "
                "the cameras"
            )
        if code in _GONE:
            return roles.LinkDownError(
                f"{name}: {doing}: no answer ({message}); is it on and plugged in?"
            )
        if isinstance(error, roles.LinkDownError) or message == arv.MISSING:
            return error
        return roles.DeviceRefusedError(f"{name}: {doing}: {message}; see [devices.camera]")
