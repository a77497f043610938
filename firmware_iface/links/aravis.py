"""The aravis library through ctypes: GenICam cameras with only the distribution's shared library.

Source: headers of aravis 0.8 (`arvcamera.h`, `arvstream.h`, `arvbuffer.h`, `arvdevice.h`); the
version in the library's name fixes the binary interface. ctypes releases the interpreter during
every call.
"""

import ctypes
from collections.abc import Iterator
from ctypes import POINTER, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint64, c_void_p
from dataclasses import dataclass
from functools import cache
from typing import Any

from firmware_iface.roles import LinkError

_LIBRARY = "libaravis-0.8.so.0"
MISSING = f"{_LIBRARY} is not installed: apt install libaravis-0.8-0"

# ArvDeviceError, arvdevice.h
NOT_OF_THE_DEVICE = -1
NOT_CONNECTED = 2
TRANSFER_ERROR = 4
TIMEOUT = 5
NOT_FOUND = 6
NOT_CONTROLLER, ACCESS_DENIED, BUSY = 10, 17, 18

PIXEL_FORMATS = {  # arvenums.h (values of the GigE Vision standard)
    "Mono8": 0x01080001,
    "Mono10": 0x01100003,
    "Mono12": 0x01100005,
    "Mono16": 0x01100007,
    "BayerGR8": 0x01080008,
    "BayerRG8": 0x01080009,
    "BayerGB8": 0x0108000A,
    "BayerBG8": 0x0108000B,
}

_ERROR, _CAMERA = object(), c_void_p  # _ERROR: the function's last argument is a GError**
# name: (result, arguments)
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_vendor": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_get_device_address": (c_char_p, (c_uint,)),
    "arv_camera_new": (c_void_p, (c_char_p, _ERROR)),
    "arv_camera_get_device": (c_void_p, (_CAMERA,)),
    "arv_camera_get_vendor_name": (c_char_p, (_CAMERA, _ERROR)),
    "arv_camera_get_model_name": (c_char_p, (_CAMERA, _ERROR)),
    "arv_camera_get_device_serial_number": (c_char_p, (_CAMERA, _ERROR)),
    "arv_camera_is_gv_device": (c_int, (_CAMERA,)),
    "arv_camera_get_sensor_size": (None, (_CAMERA, *(POINTER(c_int),) * 2, _ERROR)),
    "arv_device_set_range_check_policy": (None, (c_void_p, c_int)),
    "arv_gv_device_is_controller": (c_int, (c_void_p,)),
    "arv_camera_set_region": (None, (_CAMERA, c_int, c_int, c_int, c_int, _ERROR)),
    "arv_camera_get_region": (None, (_CAMERA, *(POINTER(c_int),) * 4, _ERROR)),
    "arv_camera_set_pixel_format_from_string": (None, (_CAMERA, c_char_p, _ERROR)),
    "arv_camera_get_pixel_format": (c_uint, (_CAMERA, _ERROR)),
    "arv_camera_is_exposure_auto_available": (c_int, (_CAMERA, _ERROR)),
    "arv_camera_set_exposure_time_auto": (None, (_CAMERA, c_int, _ERROR)),
    "arv_camera_set_exposure_time": (None, (_CAMERA, c_double, _ERROR)),
    "arv_camera_get_exposure_time": (c_double, (_CAMERA, _ERROR)),
    "arv_camera_is_gain_available": (c_int, (_CAMERA, _ERROR)),
    "arv_camera_is_gain_auto_available": (c_int, (_CAMERA, _ERROR)),
    "arv_camera_set_gain_auto": (None, (_CAMERA, c_int, _ERROR)),
    "arv_camera_set_gain": (None, (_CAMERA, c_double, _ERROR)),
    "arv_camera_get_gain": (c_double, (_CAMERA, _ERROR)),
    "arv_camera_get_payload": (c_uint, (_CAMERA, _ERROR)),
    "arv_camera_set_acquisition_mode": (None, (_CAMERA, c_int, _ERROR)),
    "arv_camera_set_trigger": (None, (_CAMERA, c_char_p, _ERROR)),
    "arv_camera_get_trigger_source": (c_char_p, (_CAMERA, _ERROR)),
    "arv_camera_software_trigger": (None, (_CAMERA, _ERROR)),
    "arv_camera_gv_set_packet_size": (None, (_CAMERA, c_int, _ERROR)),
    "arv_camera_gv_set_packet_size_adjustment": (None, (_CAMERA, c_int)),
    "arv_camera_gv_set_stream_options": (None, (_CAMERA, c_int)),
    "arv_camera_create_stream": (c_void_p, (_CAMERA, c_void_p, c_void_p, _ERROR)),
    "arv_camera_start_acquisition": (None, (_CAMERA, _ERROR)),
    "arv_camera_stop_acquisition": (None, (_CAMERA, _ERROR)),
    "arv_device_error_quark": (ctypes.c_uint32, ()),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_try_pop_buffer": (c_void_p, (c_void_p,)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_image_pixel_format": (c_uint, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_object_set_property": (None, (c_void_p, c_char_p, c_void_p)),
    "g_error_free": (None, (c_void_p,)),
    "g_value_init": (c_void_p, (c_void_p, c_size_t)),
    "g_value_set_double": (None, (c_void_p, c_double)),
    "g_value_set_int": (None, (c_void_p, c_int)),
    "g_value_set_enum": (None, (c_void_p, c_int)),
    "arv_gv_stream_socket_buffer_get_type": (c_size_t, ()),
    # the emulated camera
    "arv_gv_fake_camera_new": (c_void_p, (c_char_p, c_char_p)),
    "arv_gv_fake_camera_new_full": (c_void_p, (c_char_p, c_char_p, c_char_p)),
    "arv_gv_fake_camera_is_running": (c_int, (c_void_p,)),
    "arv_gv_fake_camera_get_fake_camera": (c_void_p, (c_void_p,)),
    "arv_fake_camera_new": (c_void_p, (c_char_p,)),
    "arv_fake_camera_write_register": (c_int, (c_void_p, c_uint, c_uint)),
    "arv_fake_camera_get_genicam_xml": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_fake_camera_get_payload": (c_size_t, (c_void_p,)),
    "arv_fake_camera_set_trigger_frequency": (None, (c_void_p, c_double)),
    "arv_fake_camera_set_fill_pattern": (None, (c_void_p, c_void_p, c_void_p)),
}
_G_TYPE_INT, _G_TYPE_DOUBLE = 6 << 2, 15 << 2  # gobject/gtype.h


class AravisError(LinkError):
    """An error that the library reported.

    Parameters
    ----------
    message : str
        As the library states it.
    code : int
        An ArvDeviceError of this module, or NOT_OF_THE_DEVICE.
    """

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class _GError(ctypes.Structure):
    _fields_ = (("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p))


class _GValue(ctypes.Structure):  # gobject/gvalue.h: a type and two words
    _fields_ = (("type", c_size_t), ("data", c_uint64 * 2))


class Aravis:
    """The library: `call` any function of it; one that can fail raises."""

    def __init__(self) -> None:
        library = ctypes.CDLL(_LIBRARY)
        self._calls: dict[str, Any] = {}
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(library, name)  # glib's functions are found through it too
            function.restype = result
            function.argtypes = [
                POINTER(POINTER(_GError)) if kind is _ERROR else kind for kind in arguments
            ]
            self._calls[name] = function

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function without its GError argument.
        Raises AravisError (what it reported there).
        """
        if _ERROR not in _SIGNATURES[name][1]:
            return self._calls[name](*arguments)
        error = POINTER(_GError)()
        result = self._calls[name](*arguments, ctypes.byref(error))
        if error:
            message = error.contents.message.decode(errors="replace")
            code = error.contents.code
            if error.contents.domain != self._calls["arv_device_error_quark"]():
                code = NOT_OF_THE_DEVICE  # the same numbers have other meanings there
            self._calls["g_error_free"](error)
            raise AravisError(message, code)
        return result

    def text(self, name: str, *arguments: Any) -> str:
        """Call a function that returns a string it keeps; empty for none."""
        found = self.call(name, *arguments)
        if not found:
            return ""
        return str(found, "utf-8", errors="replace")

    def set_double(self, instance: int, name: str, value: float) -> None:
        """Set a property of type double.

        Parameters
        ----------
        instance : int
            Address of the GObject, as `call` returns it.
        name : str
            Of the property, with dashes, such as `gvsp-lost-ratio`.
        value : float
            In the property's own unit.
        """
        self._set_property(instance, name, _G_TYPE_DOUBLE, "g_value_set_double", value)

    def set_int(self, instance: int, name: str, value: int) -> None:
        """Set a property of type int.

        Parameters
        ----------
        instance : int
            Address of the GObject, as `call` returns it.
        name : str
            Of the property, with dashes, such as `socket-buffer-size`.
        value : int
            In the property's own unit.
        """
        self._set_property(instance, name, _G_TYPE_INT, "g_value_set_int", value)

    def fix_socket_buffer(self, stream: int, size_bytes: int) -> None:
        """Give the UDP socket of a GigE Vision stream a buffer of a fixed size.

        Packets that arrive while the stream's thread does not run wait there; a buffer that is full
        loses them.

        Parameters
        ----------
        stream : int
            Address of the ArvGvStream.
        size_bytes : int
            Requested; the kernel limits it to `net.core.rmem_max`.
        """
        kind = self.call("arv_gv_stream_socket_buffer_get_type")
        # ..._FIXED, arvgvstream.h
        self._set_property(stream, "socket-buffer", kind, "g_value_set_enum", 0)
        self.set_int(stream, "socket-buffer-size", size_bytes)

    def _set_property(self, instance: int, name: str, kind: int, setter: str, value: float) -> None:
        # glib's variadic `g_object_set` needs the C types of its arguments; a GValue carries its
        # type with it.
        holder = _GValue()
        self.call("g_value_init", ctypes.byref(holder), kind)
        self.call(setter, ctypes.byref(holder), value)
        self.call("g_object_set_property", instance, name.encode(), ctypes.byref(holder))


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A camera that answered: `camera_id` names it to `camera_aravis`."""

    camera_id: str
    vendor: str
    model: str
    address: str


@cache
def load_aravis() -> Aravis:
    """The library, loaded once. Raises LinkError with the remedy when it is not installed."""
    try:
        return Aravis()
    except OSError:
        raise LinkError(MISSING) from None


def find_cameras() -> Iterator[FoundCamera]:
    """All GenICam cameras on USB and on the network (takes about a second). Raises LinkError
    without the library.
    """
    library = load_aravis()
    library.call("arv_update_device_list")
    for index in range(library.call("arv_get_n_devices")):
        words = (
            library.text(f"arv_get_device_{word}", index)
            for word in ("id", "vendor", "model", "address")
        )
        yield FoundCamera(*words)
