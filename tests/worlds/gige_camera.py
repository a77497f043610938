"""A GigE Vision camera on loopback whose pixels come from a Python function.

Discovery, control channel, GenICam description and packet stream are those of aravis' own
`ArvGvFakeCamera`, hosted in this process; the picture, the size of the sensor and the list of pixel
formats are ours. Faults are switched on while it runs: packets are lost, it is unplugged and
plugged in again.
"""

from __future__ import annotations

import ctypes
import fcntl
import socket
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from ctypes import c_size_t, c_uint32, c_void_p
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_iface.links.aravis import PIXEL_FORMATS, load_aravis
from firmware_iface.roles import LinkError
from tests.support.machine_needs import require

Pixels = NDArray[np.uint8] | NDArray[np.uint16]

# registers of arvfakecamera.h
_SENSOR_WIDTH, _SENSOR_HEIGHT, _WIDTH, _HEIGHT = 0x11C, 0x118, 0x100, 0x104
# How often the library's thread checks for a trigger; its own 25 Hz would delay each frame by 40 ms
_TRIGGER_LOOKS_HZ = 500.0
_GVCP_PORT = 3956  # GigE Vision control, fixed by the standard
_PORT_LOCK = Path(tempfile.gettempdir()) / f"membrane-tests-port-{_GVCP_PORT}.lock"
_FILL = ctypes.CFUNCTYPE(None, c_void_p, c_void_p, c_uint32, c_uint32, c_uint32)
_XML_FORMAT = '<EnumEntry Name="{name}" NameSpace="Standard"><Value>{value}</Value></EnumEntry>'
_XML_LAST_FORMAT = '<EnumEntry Name="Mono16" NameSpace="Standard">'


class GigeCameraEmulator:
    """The emulated camera.

    Parameters
    ----------
    expose : callable
        (exposure_ms, gain) -> (height, width) pixels, uint8 or uint16; called from the camera's own
        thread at every exposure. An exception is kept in `error`, and the frame is black.
    width_px, height_px : int
        Size of the sensor.
    address : str
        Of a network interface of this machine; one camera each (`ip addr add 127.0.0.2/8 dev lo`
        makes another).
    serial : str
        Its serial number.

    Attributes
    ----------
    exposures : int
        How many pictures it took.
    error : Exception or None
        The last that `expose` raised.
    """

    def __init__(
        self,
        expose: Callable[[float, int], Pixels],
        width_px: int,
        height_px: int,
        address: str = "127.0.0.1",
        serial: str = "EMU1",
    ) -> None:
        self._aravis = load_aravis()
        self._expose = expose
        self._size = (width_px, height_px)
        self._address, self._serial = address, serial
        self._fill = _FILL(self._fill_buffer)  # the library keeps only its address
        self._camera: int | None = None
        self._inner: int | None = None
        self.exposures = 0
        self.error: Exception | None = None

    @property
    def camera_id(self) -> str:
        """Its name for the driver."""
        return self._address

    def plug_in(self) -> None:
        """Start to answer. Raises LinkError if the address is taken or not of this machine."""
        call = self._aravis.call
        self._look_whether_free()
        with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
            file.write(_description())
            file.flush()
            made = call(
                "arv_gv_fake_camera_new_full",
                self._address.encode(),
                self._serial.encode(),
                file.name.encode(),
            )
        self._camera = made
        if not call("arv_gv_fake_camera_is_running", made):
            self.unplug()
            raise LinkError(
                f"emulated camera: no network interface has the address {self._address}"
            )
        self._inner = inner = call("arv_gv_fake_camera_get_fake_camera", made)
        width_px, height_px = self._size
        for register, value in (
            (_SENSOR_WIDTH, width_px),
            (_SENSOR_HEIGHT, height_px),
            (_WIDTH, width_px),
            (_HEIGHT, height_px),
        ):
            call("arv_fake_camera_write_register", inner, register, value)
        call("arv_fake_camera_set_trigger_frequency", inner, _TRIGGER_LOOKS_HZ)
        call("arv_fake_camera_set_fill_pattern", inner, ctypes.cast(self._fill, c_void_p), None)

    def _look_whether_free(self) -> None:
        """Check the port: if it is taken, the library stays silent and listens to nobody."""
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind((self._address, _GVCP_PORT))
            except OSError as error:
                raise LinkError(
                    f"emulated camera: {self._address} port {_GVCP_PORT}: {error.strerror}"
                ) from None

    def unplug(self) -> None:
        """Vanish, with all settings and the controlling client."""
        if self._camera is not None:
            self._aravis.call("g_object_unref", self._camera)
            self._camera = None

    def lose_packets(self, share: float) -> None:
        """Drop this share (0..1) of the stream's packets from now on."""
        if self._camera is not None:
            self._aravis.set_double(self._camera, "gvsp-lost-ratio", share)

    def __enter__(self) -> GigeCameraEmulator:
        self.plug_in()
        return self

    def __exit__(self, *error: object) -> None:
        self.unplug()

    def _fill_buffer(
        self, buffer: int, _: Any, exposure_us: int, gain: int, pixel_format: int
    ) -> None:
        self.exposures += 1
        over_s = time.monotonic() + exposure_us / 1e6
        # the buffer does not know its size before it is filled
        size_bytes = self._aravis.call("arv_fake_camera_get_payload", self._inner)
        start = self._aravis.call("arv_buffer_get_data", buffer, None)
        try:
            pixels = np.ascontiguousarray(self._expose(exposure_us / 1000.0, gain))
            ctypes.memmove(start, pixels.ctypes.data, min(size_bytes, pixels.nbytes))
        except Exception as error:
            self.error = error
            ctypes.memset(start, 0, size_bytes)
        time.sleep(max(0.0, over_s - time.monotonic()))  # a frame is sent when its exposure is over


@contextmanager
def gige_camera(
    expose: Callable[[float, int], Pixels], width_px: int, height_px: int
) -> Iterator[GigeCameraEmulator]:
    """A camera that is plugged in, for a test; waits until other tests of this machine have
    unplugged theirs.

    The test is skipped where the library is missing, or where another program has the standard's
    one port.
    """
    require("aravis")
    with _PORT_LOCK.open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        emulator = GigeCameraEmulator(expose, width_px, height_px)
        try:
            emulator.plug_in()
        except LinkError as error:
            pytest.skip(str(error))
        try:
            yield emulator
        finally:
            emulator.unplug()


def _description() -> str:
    """The fake camera's own GenICam description, with the pixel formats that it lacks."""
    library = load_aravis()
    camera = library.call("arv_fake_camera_new", b"XML")
    size = c_size_t()
    start = library.call("arv_fake_camera_get_genicam_xml", camera, ctypes.byref(size))
    xml = ctypes.string_at(start, size.value).decode()
    library.call("g_object_unref", camera)
    extra = "".join(
        _XML_FORMAT.format(name=name, value=PIXEL_FORMATS[name]) for name in ("Mono10", "Mono12")
    )
    return xml.replace(_XML_LAST_FORMAT, extra + _XML_LAST_FORMAT)
