"""Interlock circuits at GPIO lines of this machine, by Linux' GPIO character device.

The package `gpiod` (libgpiod 2, the kernel developers' own binding) requests the lines; the kernel
then refuses them to every other program. A line of an I2C or USB expander may take long to answer,
and a request for it cannot be abandoned: each call runs in a thread, so that the tick never waits
for it. The threads are daemons and not those of asyncio's executor, for whose end the program would
wait.

Source: libgpiod 2, Python bindings; Documentation/userspace-api/gpio/chardev.rst of the Linux
kernel.
"""

import asyncio
import contextlib
import errno
import importlib
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from firmware_iface.roles import DeviceIdentity, DeviceRefusedError, LinkDownError, LinkError

Wiring = Literal["to_ground", "to_supply"]
Pull = Literal["internal", "external"]
_CONSUMER = "membrane-ctrl interlock"
MISSING = "the Python package gpiod is missing: pip install 'membrane-ctrl[gpio]'"


def load_gpiod() -> Any:
    """Return the package `gpiod`. Raises ValueError if it is missing, or older than version 2."""
    try:
        module = importlib.import_module("gpiod")
    except ImportError:
        raise ValueError(MISSING) from None
    if not hasattr(module, "request_lines"):
        raise ValueError(
            "the Python package gpiod is older than version 2: pip install 'membrane-ctrl[gpio]'"
        )
    return module


@dataclass(frozen=True, slots=True)
class GpioCircuit:
    """One circuit: the line's number on its chip, and how the contact is wired.

    "to_ground": a closed contact connects the line to ground, and a pull-up raises it otherwise.
    "to_supply": a closed contact connects the line to the supply, and a pull-down lowers it
    otherwise. Either way a broken wire reads as an open circuit. `pull` "external": resistors
    outside do what the chip's own cannot.
    """

    line: int
    wiring: Wiring = "to_ground"
    pull: Pull = "internal"


class GpioLines:
    """Circuits at the lines of one GPIO chip.

    Parameters
    ----------
    chip : str
        Its device, such as `/dev/gpiochip0`.
    circuits : sequence of GpioCircuit
        In the order in which `closed_circuits` answers.
    gpiod : module or None
        A simulation of the package `gpiod`; None is the package, or ValueError without it.
    """

    def __init__(self, chip: str, circuits: Sequence[GpioCircuit], gpiod: Any = None) -> None:
        self._gpiod = load_gpiod() if gpiod is None else gpiod
        self._chip = chip
        self._circuits = tuple(circuits)
        self._request: Any = None
        # a thread that hangs in the driver keeps this; later calls then fail at once instead of
        # piling up
        self._busy = threading.Lock()

    async def open(self) -> DeviceIdentity:
        """Request the lines from the kernel, and read them once.

        Raises LinkDownError (the chip is absent), DeviceRefusedError (another program has a line,
        or the chip lacks the line or its pull resistor).
        """
        if self._request is not None:
            await self.close()
        self._request = await self._in_thread(self._request_lines)
        await self.closed_circuits()
        return DeviceIdentity("GPIO lines", "", "", ", ".join(self._list_lines()))

    async def closed_circuits(self) -> tuple[bool, ...]:
        """Whether each circuit is closed. Raises LinkError."""
        if self._request is None:
            raise LinkDownError(f"{self._chip}: not open")
        active = self._gpiod.line.Value.ACTIVE
        values = await self._in_thread(self._read_values)
        if len(values) != len(self._circuits):
            raise LinkError(f"{self._chip}: {len(values)} values instead of {len(self._circuits)}")
        return tuple(value == active for value in values)

    async def close(self) -> None:
        """Give the lines back. Never raises."""
        request, self._request = self._request, None
        if request is not None:
            # the chip is gone, or its driver hangs: nothing can be given back
            with contextlib.suppress(LinkError):
                await self._in_thread(request.release)

    def describe(self) -> dict[str, str]:
        """Chip and lines."""
        return {"port": self._chip, "register": ", ".join(self._list_lines())}

    def _list_lines(self) -> list[str]:
        return [f"line {circuit.line} {circuit.wiring}" for circuit in self._circuits]

    def _request_lines(self) -> Any:
        settings = {circuit.line: self._make_line_settings(circuit) for circuit in self._circuits}
        return self._gpiod.request_lines(self._chip, consumer=_CONSUMER, config=settings)

    def _make_line_settings(self, circuit: GpioCircuit) -> Any:
        """An input that is ACTIVE while the contact is closed."""
        line = self._gpiod.line
        to_ground = circuit.wiring == "to_ground"
        own_pull = line.Bias.PULL_UP if to_ground else line.Bias.PULL_DOWN
        bias = own_pull if circuit.pull == "internal" else line.Bias.DISABLED
        return self._gpiod.LineSettings(
            direction=line.Direction.INPUT, bias=bias, active_low=to_ground
        )

    def _read_values(self) -> list[Any]:
        return list(self._request.get_values([circuit.line for circuit in self._circuits]))

    async def _in_thread(self, call: Any) -> Any:
        """Run a blocking call in a thread. Raises LinkError kinds for what the kernel reports."""
        if not self._busy.acquire(blocking=False):
            raise LinkError(f"{self._chip}: the last request has not been answered yet")
        loop = asyncio.get_running_loop()
        answer: asyncio.Future[Any] = loop.create_future()

        def run() -> None:
            result: Any = None
            failure: Exception | None = None
            try:
                result = call()
            except Exception as error:  # whatever the binding raises is a fault of this source
                failure = error
            finally:
                self._busy.release()
            with contextlib.suppress(RuntimeError):  # the event loop has ended meanwhile
                loop.call_soon_threadsafe(_settle_future, answer, result, failure)

        threading.Thread(target=run, name="gpio", daemon=True).start()
        try:
            return await answer
        except OSError as error:
            raise self._explain_refusal(error) from None
        except ValueError as error:  # the chip has no such line
            raise DeviceRefusedError(f"{self._chip}: {error}") from None

    def _explain_refusal(self, error: OSError) -> LinkError:
        what = error.strerror or str(error)
        if error.errno == errno.EBUSY:
            return DeviceRefusedError(
                f"{self._chip}: another program or the kernel uses the line ({what})"
            )
        if error.errno in (errno.EINVAL, errno.ENXIO, errno.EOPNOTSUPP):
            hint = 'without a pull resistor of its own use pull = "external"'
            return DeviceRefusedError(
                f"{self._chip}: the chip does not accept the line or its pull ({what}); {hint}"
            )
        if error.errno == errno.EACCES:
            return DeviceRefusedError(f"{self._chip}: {what}; add this user to the device's group")
        return LinkDownError(f"{self._chip}: {what}")


def _settle_future(answer: asyncio.Future[Any], result: Any, failure: Exception | None) -> None:
    """Give the thread's result to the caller, if it still waits."""
    if answer.done():
        return
    if failure is None:
        answer.set_result(result)
    else:
        answer.set_exception(failure)
