"""`safe` stops the pump although another program has the board, takes no claim, and leaves clearing
to a person.
"""

from __future__ import annotations

import asyncio
import getpass
import json
import socket
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from firmware_iface.drivers.pump_board import PumpBoard
from firmware_iface.emulators.pump_board import BoardSample
from firmware_iface.register_map import list_known_maps, load_default_map
from firmware_iface.roles import BenchCommand, BenchReading
from membrane_ctrl.commissioning.check import probe_board
from membrane_ctrl.commissioning.safe import make_safe
from membrane_ctrl.config.schema import Config, DevicesConfig, RecordingConfig
from membrane_ctrl.instruments.bench import make_pump_board
from membrane_ctrl.instruments.device_claim import claim_devices
from membrane_ctrl.instruments.device_names import list_device_names
from membrane_ctrl.instruments.lock_keys import list_device_keys
from membrane_ctrl.instruments.lock_store import VARIABLE, LockStore
from membrane_ctrl.model.errors import DeviceError
from tests.worlds.faulty_board import PumpBoardEmulator

STOPPED, WATCHDOG = 0b100, 0b001


class Still:
    """An idle plant."""

    def sample(self) -> BoardSample:
        return BoardSample(0.0, 0, 600.0, 101325.0, 23.0, 21.0, 1, 0.0)

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        pass


class Bench:
    """An emulated board in a thread of its own, its clock in the test's hand, and a program that
    holds it.
    """

    def __init__(self, version: int, folder: Path) -> None:
        self.now_s = 0.0
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.board = self.at_once(self._emulator, version)
        self.devices = DevicesConfig(
            board=f"tcp://127.0.0.1:{self.board.port}", timeout_s=5.0, watchdog_s=0.5
        )
        self.config = Config(devices=self.devices, recording=RecordingConfig(logs_dir=str(folder)))
        self.holder = PumpBoard(str(self.devices.board), timeout_s=5.0, watchdog_s=0.5)
        self.at_once(self.holder.open)
        self.write(0.5)

    async def _emulator(self, version: int) -> PumpBoardEmulator:
        board = PumpBoardEmulator(
            Still(), clock=lambda: self.now_s, registers=list_known_maps()[version]
        )
        await board.start()
        return board

    def at_once(self, act: Callable[..., object], *words: object) -> object:
        return asyncio.run_coroutine_threadsafe(act(*words), self._loop).result(20.0)

    def write(self, pump: float) -> None:
        self.at_once(self.holder.write, BenchCommand(pump, 0.25))

    def read(self) -> BenchReading:
        reading = self.at_once(self.holder.read)
        assert isinstance(reading, BenchReading)
        return reading

    def close(self) -> None:
        self.at_once(self.holder.close)
        self.at_once(self.board.stop)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


@pytest.fixture
def version() -> int:
    return load_default_map().map_version


@pytest.fixture
def bench(version: int, tmp_path: Path) -> Iterator[Bench]:
    made = Bench(version, tmp_path)
    yield made
    made.close()


every_map = pytest.mark.parametrize("version", [1, 2, 3])


@every_map
def test_it_stops_the_pump_under_a_holder_and_changes_nothing_of_his(
    bench: Bench, version: int, tmp_path: Path
) -> None:
    before = bench.board.state.read(48, 2)
    assert make_safe(bench.config, "lab.toml") == 0
    reading = bench.read()
    assert (reading.pump_fraction, reading.vent_fraction, reading.foreign) == (0.0, 0.25, 0)
    assert bench.board.state.read(48, 2) == before
    bench.now_s += 0.51
    assert bench.read().watchdog_tripped  # it has not fed
    (stored,) = LockStore.of_machine().find_locks(list_device_keys(bench.devices))
    assert stored.lock.text == "made safe by hand"
    assert stored.lock.account == f"unix:{getpass.getuser()}"


def test_a_board_with_claims_keeps_it_stopped_until_the_holder_clears_it(bench: Bench) -> None:
    make_safe(bench.config, "lab.toml")
    bench.write(0.5)
    assert (bench.read().pump_fraction, bench.read().latched_faults) == (0.0, STOPPED)
    bench.at_once(bench.holder.clear_faults, STOPPED)
    bench.write(0.5)
    assert bench.read().pump_fraction == 0.5


def test_it_waits_for_no_lock(bench: Bench) -> None:
    with claim_devices(list_device_names(bench.devices)):
        assert make_safe(bench.config, "lab.toml") == 0
    assert bench.read().pump_fraction == 0.0


def test_locks_that_cannot_be_written_are_reported_with_the_pump_stopped(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "locks").write_text("no folder")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "locks"))
    with pytest.raises(DeviceError, match=r"the pump is stopped, but not locked"):
        make_safe(bench.config, "lab.toml")
    assert bench.read().pump_fraction == 0.0


def test_after_a_run_nothing_is_latched(bench: Bench, tmp_path: Path) -> None:
    bench.write(0.0)
    bench.at_once(bench.holder.close)
    assert make_safe(bench.config, "lab.toml", latch=False) == 0
    assert LockStore.of_machine().find_locks() == []
    bench.at_once(bench.holder.open)
    assert bench.read().latched_faults == 0


def test_after_a_killed_run_it_waits_for_the_watchdog_and_latches_nothing_more(
    bench: Bench,
) -> None:
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(make_safe, bench.config, "lab.toml", latch=False)
        bench.now_s += 0.51
        assert done.result(20.0) == 0
    assert (bench.read().pump_fraction, bench.read().latched_faults) == (0.0, WATCHDOG)


def test_a_pump_that_the_watchdog_leaves_on_is_stopped_after_all(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.commissioning.safe._LOOK_S", 0.001)
    monkeypatch.setattr("membrane_ctrl.commissioning.safe._LAPSE_S", -0.45)
    assert (
        make_safe(bench.config, "lab.toml", latch=False) == 0
    )  # its clock is stopped: no watchdog trips
    assert (bench.read().pump_fraction, bench.read().latched_faults) == (0.0, STOPPED)


def test_without_a_latch_a_running_program_is_left_alone(bench: Bench) -> None:
    with (
        claim_devices(list_device_names(bench.devices)),
        pytest.raises(DeviceError, match="in use by process"),
    ):
        make_safe(bench.config, "lab.toml", latch=False)
    assert bench.read().pump_fraction == 0.5


def test_a_missing_hold_and_board_give_one_line(
    tmp_path: Path, unused_tcp_port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("membrane_ctrl.instruments.bench_connection._PATIENCE_S", 0.05)
    devices = DevicesConfig(board=f"tcp://127.0.0.1:{unused_tcp_port}")
    config = Config(devices=devices, recording=RecordingConfig(logs_dir=str(tmp_path)))
    with pytest.raises(DeviceError, match=r"no connection.*; cut the pump's power if it runs"):
        make_safe(config, "lab.toml")


@every_map
def test_a_check_beside_a_holder_writes_nothing(bench: Bench, version: int) -> None:
    """As from another machine, where no lock is seen; with another watchdog period in its
    configuration.
    """
    before = bench.board.state.read(48, 2) + bench.board.state.read(56, 3)
    slow = bench.devices.model_copy(update={"watchdog_s": 10.0})
    probe = asyncio.run(probe_board(make_pump_board(slow, str(slow.board)), "board"))
    assert probe.problem == ""
    assert ("has no claim" in probe.notes) == (version == 1)
    assert bench.board.state.read(48, 2) + bench.board.state.read(56, 3) == before
    assert (bench.read().pump_fraction, bench.read().foreign) == (0.5, 0)
    bench.now_s += 0.51
    assert bench.read().watchdog_tripped


class Hold:
    """Listens like a hold's control port, and keeps the requests."""

    def __init__(
        self, path: Path, answer: dict[str, object], ticks: Callable[[], None] = lambda: None
    ) -> None:
        self._ticks = ticks
        self.asked: list[dict[str, object]] = []
        self._answer = answer
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        with (
            self._listener,
            self._listener.accept()[0] as connection,
            connection.makefile("rwb") as lines,
        ):
            lines.write(
                b'{"membrane_ctrl": 1, "run": "night", "you": "unix:ann", "role": "tune"}\n'
            )
            lines.flush()
            request = json.loads(lines.readline())
            self.asked.append(request)
            self._ticks()
            lines.write(json.dumps({"number": request["number"], **self._answer}).encode() + b"\n")
            lines.flush()

    def close(self) -> None:
        self._thread.join()


def composed(folder: Path) -> Config:
    """A bench of instruments, all absent."""
    roles = {
        "displacement": {"driver": "optoncdt1420", "port": f"{folder}/laser"},
        "pump": {"driver": "ventus", "port": f"{folder}/pump"},
        "gauge_pressure": {"driver": "bronkhorst_propar", "port": f"{folder}/gauge"},
    }
    recording = RecordingConfig(logs_dir=str(folder))
    return Config(devices=DevicesConfig.model_validate(roles), recording=recording)


STORED = {"ok": True, "stored": True, "lock": {"word": "bofak"}}


@pytest.mark.parametrize("answer", [{"ok": True}, STORED, {"ok": False, "refused": "not you"}])
def test_a_running_hold_is_locked_and_that_is_enough_where_it_alone_has_the_pump(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    answer: dict[str, object],
) -> None:
    monkeypatch.setattr("membrane_ctrl.instruments.bench_connection._PATIENCE_S", 0.05)
    hold = Hold(tmp_path / "control.sock", answer)
    if answer["ok"]:
        assert make_safe(composed(tmp_path), "lab.toml") == 0
        assert "run night: locked" in capsys.readouterr().err
        assert bool(LockStore.of_machine().find_locks()) == ("stored" not in answer)
    else:
        with pytest.raises(DeviceError, match="cut the pump's power"):
            make_safe(composed(tmp_path), "lab.toml")
        assert "refused the lock: not you" in capsys.readouterr().err
    hold.close()
    assert [request["do"] for request in hold.asked] == ["latch"]


def test_the_hold_is_locked_also_where_the_board_latches(bench: Bench, tmp_path: Path) -> None:
    """Its next hold, after a restart of the board that forgets, is then refused as well."""
    hold = Hold(tmp_path / "control.sock", {"ok": True})
    make_safe(bench.config, "lab.toml")
    hold.close()
    assert [request["do"] for request in hold.asked] == ["latch"]
    assert bench.read().latched_faults == STOPPED


@pytest.mark.parametrize("version", [1])
def test_an_old_board_is_stopped_again_after_the_hold_was_locked(
    bench: Bench, version: int, tmp_path: Path
) -> None:
    """The hold's last command before it latched came after the first stop."""
    hold = Hold(tmp_path / "control.sock", {"ok": True}, ticks=lambda: bench.write(0.5))
    make_safe(bench.config, "lab.toml")
    hold.close()
    assert bench.read().pump_fraction == 0.0
