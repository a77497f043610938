"""A serial port on the event loop: delivers bytes as they arrive, and reports a lost link at once.

It uses `loop.add_reader` on the port's own descriptor: no thread, no polling, and a pulled plug
makes the descriptor readable at once. pyserial only opens and configures the port.
"""

import asyncio
import contextlib
import errno
import os
import termios
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import serial

from firmware_iface.links.port_names import check_port_name, resolve_port_path
from firmware_iface.roles import Clock, DeviceRefusedError, LinkDownError, LinkError, LinkWaitsError

# fast enough for a replugged cable, slow enough not to hammer a server that accepts and hangs up
FIRST_S = 0.1
LONGEST_S = 5.0
# A connection that has been read for so long is good. A younger one may be one of many that open,
# identify the device and then fail
PROVEN_S = 1.0
_READ_BYTES = 65_536
# a missing port costs only one look-up: no reason to back off, and a replug must be found at once
_ABSENT_S = 0.1
_REMEDIES = {
    errno.EACCES: "no permission; add yourself to the port's group (dialout) and log in again",
    errno.EPERM: "no permission; add yourself to the port's group (dialout) and log in again",
    errno.EAGAIN: "in use by another program; close that one first",
    errno.EBUSY: "in use by another program; close that one first",
    errno.ENOENT: "there is no such port; is the adapter plugged in?",
    errno.ENODEV: "there is no such port; is the adapter plugged in?",
    errno.ENXIO: "there is no such port; is the adapter plugged in?",
    errno.ENOTTY: "this is not a serial port",
    errno.EISDIR: "this is not a serial port",
}


class BackOff:
    """Doubling waits between attempts to connect.

    An attempt counts as failed until the device has been read for `PROVEN_S`: a connection that is
    opened, or dropped after its first answers, is no success. The first retry after an answer is
    free.
    """

    def __init__(self) -> None:
        self._wait_s = 0.0
        self._attempt_s = self._earliest_s = float("-inf")

    def remaining_s(self, now_s: float) -> float:
        """Time until the next attempt is due; 0 when it is."""
        return max(0.0, self._earliest_s - now_s)

    def attempted(self, now_s: float) -> None:
        """An attempt begins."""
        # 0 becomes `FIRST_S`, then each attempt doubles the wait up to `LONGEST_S`. Only
        # `succeeded` sets it back.
        self._wait_s = min(max(2 * self._wait_s, FIRST_S), LONGEST_S)
        self._attempt_s = now_s
        self._earliest_s = now_s + self._wait_s

    def succeeded(self, now_s: float) -> None:
        """Note a valid answer to a read."""
        if now_s - self._attempt_s >= PROVEN_S:
            self._wait_s = 0.0
        # After a first attempt, or a connection that has proven itself, the next attempt may
        # follow at once: a replugged cable costs no wait.
        if self._wait_s <= FIRST_S:
            self._earliest_s = float("-inf")


@dataclass(frozen=True, slots=True)
class SerialSettings:
    """Line settings: `parity` is "N", "E" or "O"; with E or O, the kernel drops bytes of wrong
    parity.
    """

    baud: int
    data_bits: int = 8
    parity: str = "N"
    stop_bits: int = 1

    def __post_init__(self) -> None:
        if self.baud not in serial.Serial.BAUDRATES:
            raise ValueError(f"baud = {self.baud}: not a rate that serial ports have")
        if (
            self.data_bits not in (7, 8)
            or self.parity not in ("N", "E", "O")
            or self.stop_bits not in (1, 2)
        ):
            raise ValueError(
                f"{self}: expected 7 or 8 data bits, parity N, E or O, 1 or 2 stop bits"
            )

    @property
    def char_s(self) -> float:
        """Duration of one character, including the start bit."""
        return (1 + self.data_bits + (self.parity != "N") + self.stop_bits) / self.baud

    def __str__(self) -> str:
        return f"{self.baud} {self.data_bits}{self.parity}{self.stop_bits}"


class Receiver(Protocol):
    """Callbacks of a port, within the event loop."""

    def received(self, data: bytes) -> None:
        """Bytes have arrived."""

    def lost(self, error: LinkDownError) -> None:
        """The port is gone and closed."""


class SerialPort:
    """A serial port of this machine.

    Parameters
    ----------
    port : str
        A path, or `usb:VID:PID[:SERIAL]`, which is looked up at every `open`, so that a replug in
        another socket works.
    settings : SerialSettings
        Of the line.
    clock : callable
        Monotonic time of the back-off, s.

    Raises
    ------
    ValueError
        The name is neither.
    """

    def __init__(self, port: str, settings: SerialSettings, clock: Clock = time.monotonic) -> None:
        self._port = check_port_name(port)
        self._settings = settings
        self._clock = clock
        self._back_off = BackOff()
        self._absent_until_s = float("-inf")
        self._serial: serial.Serial | None = None
        self._receiver: Receiver | None = None

    @property
    def name(self) -> str:
        """For messages."""
        return self._port

    @property
    def settings(self) -> SerialSettings:
        """Line settings."""
        return self._settings

    @property
    def is_open(self) -> bool:
        """Whether bytes can flow."""
        return self._serial is not None

    @property
    def retry_in_s(self) -> float:
        """Time until `open` will try."""
        now_s = self._clock()
        return max(self._back_off.remaining_s(now_s), self._absent_until_s - now_s, 0.0)

    def open(self, receiver: Receiver) -> None:
        """Open the port again, as its only user.

        Raises LinkDownError (not there, busy, not permitted, or not yet time for the next attempt),
        DeviceRefusedError (several adapters have this USB identity).
        """
        if (wait_s := self.retry_in_s) > 0:
            raise LinkWaitsError(f"{self._port}: next attempt to open in {wait_s:.1f} s")
        self.close()
        # A port that is not there has a short wait of its own and does not count as an attempt.
        path = self._locate_port()
        self._back_off.attempted(self._clock())
        self._serial = _open_serial(path, self._port, self._settings)
        self._receiver = receiver
        asyncio.get_running_loop().add_reader(self._serial.fileno(), self._read_available)

    def write(self, data: bytes) -> None:
        """Give bytes to the kernel for sending.

        Raises LinkDownError (the port is closed or just went away), LinkError (the kernel's buffer
        is full: nothing is being sent).
        """
        if self._serial is None:
            raise LinkDownError(f"{self._port}: not open")
        try:
            written = os.write(self._serial.fileno(), data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise self._note_lost_port() from error
        if written != len(data):
            raise LinkError(
                f"{self._port}: only {written} of {len(data)} bytes could be sent; is the "
                "line held?"
            )

    def succeeded(self) -> None:
        """Note a valid answer to a read (see `BackOff`)."""
        self._back_off.succeeded(self._clock())

    def close(self) -> None:
        """Close; never raises."""
        if self._serial is None:
            return
        port = self._serial
        self._serial = None
        self._receiver = None
        asyncio.get_running_loop().remove_reader(port.fileno())
        with contextlib.suppress(OSError, termios.error):
            # closing a tty waits up to 30 s for its output to drain when the line is held
            termios.tcflush(port.fileno(), termios.TCOFLUSH)
        with contextlib.suppress(OSError):
            port.close()

    def _locate_port(self) -> str:
        try:
            path = resolve_port_path(self._port)
        except LinkDownError:
            self._absent_until_s = self._clock() + _ABSENT_S
            raise
        if not Path(path).exists():
            self._absent_until_s = self._clock() + _ABSENT_S
            raise LinkDownError(f"{self._port}: {_REMEDIES[errno.ENOENT]}")
        return path

    def _read_available(self) -> None:
        if self._serial is None or self._receiver is None:
            return
        try:
            data = os.read(self._serial.fileno(), _READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._receiver.received(data)
        else:  # end of file on a tty is a hang-up
            self._note_lost_port()

    def _note_lost_port(self) -> LinkDownError:
        receiver = self._receiver
        self.close()
        error = LinkDownError(f"{self._port}: the port is gone; is the adapter unplugged?")
        if receiver is not None:
            receiver.lost(error)
        return error


def _open_serial(path: str, name: str, settings: SerialSettings) -> Any:
    try:
        port = serial.Serial(
            path,
            baudrate=settings.baud,
            bytesize=settings.data_bits,
            parity=settings.parity,
            stopbits=settings.stop_bits,
            timeout=0,
            exclusive=True,
        )
    except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
        code = _find_errno(error)
        remedy = _REMEDIES.get(code, str(error))
        if code in (errno.ENOTTY, errno.EISDIR):
            raise DeviceRefusedError(f"{name}: {remedy}") from error
        raise LinkDownError(f"{name}: {remedy}") from error
    with contextlib.suppress(ValueError, OSError):
        # FTDI adapters otherwise hold bytes back for 16 ms; others lack this mode
        port.set_low_latency_mode(True)
    if settings.parity != "N":
        _drop_wrong_parity(port.fileno())
    return port


def _find_errno(error: BaseException) -> int:
    """Error number of a SerialException or of the termios.error that caused it; else 0."""
    for source in (error, error.__context__):
        for code in (getattr(source, "errno", None), *getattr(source, "args", ())[:1]):
            if isinstance(code, int):
                return code
    return 0


def _drop_wrong_parity(descriptor: int) -> None:
    """Enable the kernel's parity check of input, which pyserial leaves off: a corrupted byte is
    then missing.
    """
    attributes = termios.tcgetattr(descriptor)
    attributes[0] |= termios.INPCK | termios.IGNPAR
    termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
