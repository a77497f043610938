"""One program a device: however two configurations name it, and however the other program ended."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from membrane_ctrl.config.schema import DevicesConfig
from membrane_ctrl.instruments.device_claim import claim_devices
from membrane_ctrl.instruments.device_names import list_device_names, modbus_names
from membrane_ctrl.model.errors import DeviceError

HOLDS = """
import sys
from membrane_ctrl.instruments.device_claim import claim_devices
with claim_devices([sys.argv[1]]):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def device(tmp_path: Path) -> str:
    """No other test's."""
    return str(tmp_path / "tty")


@pytest.fixture
def other(device: str) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the device."""
    words = [sys.executable, "-c", HOLDS, device, "--config", "\x1b[2Jlab.toml"]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def refused(device: str) -> str:
    with pytest.raises(DeviceError) as caught, claim_devices([device]):
        pass
    return str(caught.value)


def test_another_process_is_named_with_its_number_and_words(
    device: str, other: subprocess.Popen[str]
) -> None:
    refusal = refused(device)
    assert refusal.startswith(f"{device}: in use by process {other.pid} (")
    assert "stop that first" in refusal
    assert refusal.isprintable()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_process_that_ended_anyhow_leaves_nothing(
    device: str, other: subprocess.Popen[str], number: signal.Signals
) -> None:
    other.send_signal(number)
    other.wait()
    with claim_devices([device]):
        pass


def test_a_stopped_process_keeps_its_devices(device: str, other: subprocess.Popen[str]) -> None:
    other.send_signal(signal.SIGSTOP)
    assert str(other.pid) in refused(device)


def test_it_is_given_back_and_may_be_had_again(device: str) -> None:
    for _ in range(2):
        with claim_devices([device]):
            assert f"process {os.getpid()}" in refused(device)


def test_of_several_devices_none_is_kept_when_one_is_refused(device: str) -> None:
    with claim_devices([f"{device} b"]):
        with (
            pytest.raises(DeviceError, match=" b: in use"),
            claim_devices([f"{device} a", f"{device} b", f"{device} c"]),
        ):
            pass
        with claim_devices([f"{device} a", f"{device} c"]):
            pass


def test_many_that_are_refused_do_not_wait(device: str, other: subprocess.Popen[str]) -> None:
    refusal = {refused(device) for _ in range(200)}
    assert len(refusal) == 1
    assert str(other.pid) in refusal.pop()


@pytest.mark.parametrize(
    "url",
    [
        "tcp://127.0.0.1:1502",
        "tcp://LOCALHOST:1502",
        "tcp://[::1]:1502",
        "tcp://127.0.0.7:1502",
        "tcp://0.0.0.0:1502",
        "tcp://[::ffff:127.0.0.1]:1502",
    ],
)
def test_all_names_of_this_machine_are_one(url: str) -> None:
    assert modbus_names(url, 1) == {"localhost port 1502 unit 1"}


def test_a_name_is_locked_by_its_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    def addresses(host: str, *_: object, **__: object) -> list[tuple[object, ...]]:
        if host == "unknown.lab":
            raise socket.gaierror(-2, "Name or service not known")
        found = {
            "board.lab": ["192.0.2.7"],
            "old-name.lab": ["192.0.2.7", "2001:db8::7"],
            "192.0.2.7": ["192.0.2.7"],
        }
        return [(0, 0, 0, "", (address, 0)) for address in found[host]]

    monkeypatch.setattr(socket, "getaddrinfo", addresses)
    names = [
        modbus_names(f"tcp://{host}", 1) for host in ("board.lab", "old-name.lab", "192.0.2.7")
    ]
    assert set.intersection(*names) == {"192.0.2.7 port 502 unit 1"}
    assert modbus_names("tcp://Unknown.lab:502", 1) == {"unknown.lab port 502 unit 1"}


@pytest.mark.parametrize("other", ["tcp://127.0.0.1:1503", "rtu:///dev/ttyS0"])
def test_other_devices_are_others(other: str) -> None:
    assert not modbus_names("tcp://127.0.0.1:1502", 1) & modbus_names(other, 1)
    assert not modbus_names("tcp://127.0.0.1:1502", 1) & modbus_names("tcp://127.0.0.1:1502", 2)


def test_a_serial_line_is_what_its_links_lead_to(tmp_path: Path) -> None:
    line, by_id = tmp_path / "ttyUSB0", tmp_path / "usb-FTDI"
    line.touch()
    by_id.symlink_to(line)
    assert modbus_names(f"rtu://{line}?baud=115200", 1) == modbus_names(
        f"rtu://{by_id}?baud=9600&parity=E", 2
    )


def test_a_composed_bench_has_all_its_devices(tmp_path: Path) -> None:
    analog = {
        "driver": "modbus_map",
        "link": "tcp://127.0.0.1:1502",
        "address": 0,
        "value": [0.0, 1.0],
    }
    devices = DevicesConfig.model_validate(
        {
            "displacement": {"driver": "optoncdt1420", "port": f"{tmp_path}/laser"},
            "pump": {"driver": "ventus", "port": f"{tmp_path}/pump"},
            "vent": {**analog, "unit_id": 3},
            "gauge_pressure": {**analog, "unit_id": 4, "value": [0.0, 1000.0]},
        }
    )
    assert list_device_names(devices) == {
        f"{tmp_path}/laser",
        f"{tmp_path}/pump",
        "localhost port 1502 unit 3",
        "localhost port 1502 unit 4",
    }
