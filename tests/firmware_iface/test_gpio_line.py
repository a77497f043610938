"""Interlock circuits at GPIO lines, with a stand-in for the package gpiod."""

from __future__ import annotations

import asyncio
import errno
import sys
import threading
from types import SimpleNamespace

import pytest

from firmware_iface.drivers.gpio_line import MISSING, GpioCircuit, GpioLines, load_gpiod
from firmware_iface.emulators.gpio import EmulatedGpio
from firmware_iface.roles import DeviceRefusedError, LinkDownError, LinkError

CHIP = "/dev/gpiochip0"


@pytest.mark.parametrize("pull", ["internal", "external"])
@pytest.mark.parametrize("wiring", ["to_ground", "to_supply"])
@pytest.mark.parametrize(("contact", "closed"), [("closed", True), ("open", False), ("cut", False)])
async def test_only_a_closed_contact_is_closed_however_it_is_wired(
    wiring: str, pull: str, contact: str, closed: bool
) -> None:
    gpio = EmulatedGpio({(CHIP, 5): contact})  # type: ignore[dict-item]
    lines = GpioLines(CHIP, [GpioCircuit(5, wiring, pull)], gpio)  # type: ignore[arg-type]
    await lines.open()
    assert await lines.closed_circuits() == (closed,)
    await lines.close()


async def test_lines_come_in_the_order_of_the_circuits() -> None:
    gpio = EmulatedGpio({(CHIP, 2): "open", (CHIP, 7): "closed", (CHIP, 4): "open"})
    lines = GpioLines(CHIP, [GpioCircuit(7), GpioCircuit(2), GpioCircuit(4, "to_supply")], gpio)
    await lines.open()
    assert await lines.closed_circuits() == (True, False, False)
    gpio.contacts[CHIP, 2] = "closed"
    assert await lines.closed_circuits() == (True, True, False)
    assert lines.describe() == {
        "port": CHIP,
        "register": "line 7 to_ground, line 2 to_ground, line 4 to_supply",
    }
    await lines.close()


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.EBUSY, DeviceRefusedError, "another program"),
        (errno.EACCES, DeviceRefusedError, "group"),
        (errno.EINVAL, DeviceRefusedError, "external"),
        (errno.ENODEV, LinkDownError, CHIP),
        (errno.ENOENT, LinkDownError, CHIP),
    ],
)
async def test_what_the_kernel_refuses_is_one_line(
    number: int, kind: type[LinkError], words: str
) -> None:
    gpio = EmulatedGpio({(CHIP, 5): "closed"})
    lines = GpioLines(CHIP, [GpioCircuit(5)], gpio)
    gpio.failing = OSError(number, "as the kernel says")
    with pytest.raises(kind, match=words):
        await lines.open()
    with pytest.raises(LinkDownError, match="not open"):
        await lines.closed_circuits()


async def test_a_line_that_the_chip_does_not_have_is_refused() -> None:
    lines = GpioLines(CHIP, [GpioCircuit(77)], EmulatedGpio({}))
    with pytest.raises(DeviceRefusedError, match="77"):
        await lines.open()


async def test_a_lost_chip_is_opened_again_with_a_new_request() -> None:
    gpio = EmulatedGpio({(CHIP, 5): "closed"})
    lines = GpioLines(CHIP, [GpioCircuit(5)], gpio)
    await lines.open()
    gpio.failing = OSError(errno.ENODEV, "gone")
    with pytest.raises(LinkDownError):
        await lines.closed_circuits()
    gpio.failing = None
    await lines.open()
    assert gpio.requests == 2
    assert await lines.closed_circuits() == (True,)
    await lines.close()


async def test_a_driver_that_hangs_blocks_neither_the_loop_nor_the_next_call() -> None:
    gpio = EmulatedGpio({(CHIP, 5): "closed"})
    lines = GpioLines(CHIP, [GpioCircuit(5)], gpio)
    await lines.open()
    release = threading.Event()
    gpio.check = release.wait  # type: ignore[assignment]
    waiting = asyncio.create_task(lines.closed_circuits())
    await asyncio.sleep(0.05)
    assert not waiting.done()
    with pytest.raises(LinkError, match="not been answered"):
        await lines.closed_circuits()
    waiting.cancel()
    release.set()
    await asyncio.gather(waiting, return_exceptions=True)


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(ValueError, match="pip install 'membrane-ctrl\\[gpio\\]'") as caught:
        GpioLines(CHIP, [GpioCircuit(5)])
    assert str(caught.value) == MISSING


def test_the_old_package_of_the_same_name_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", SimpleNamespace())
    with pytest.raises(ValueError, match="older than version 2"):
        load_gpiod()
