"""Faults latched by the board when a hold begins: refused, waited for, or cleared as the resume
rule allows.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path

import pytest
import pytest_asyncio

from firmware_iface.emulators.pump_board import BoardSample
from firmware_iface.register_map import list_known_maps, load_default_map
from membrane_ctrl.config.schema import Config, DevicesConfig, ResumeConfig
from membrane_ctrl.hold.hold_options import HoldOptions
from membrane_ctrl.hold.start_checks import BoardAtStart, identify_board, open_latched_fault
from membrane_ctrl.instruments.bench import make_bench
from membrane_ctrl.instruments.bench_connection import connect_bench
from membrane_ctrl.model.errors import DeviceError, FindingsError
from membrane_ctrl.run_files.latched_fault import NAME, LatchedFile, ResumeLog
from tests.worlds.faulty_board import PumpBoardEmulator

WATCHDOG, OVER_PRESSURE = (
    load_default_map().make_fault_mask(name) for name in ("watchdog", "over_pressure")
)


class Still:
    """An idle plant."""

    def sample(self) -> BoardSample:
        return BoardSample(0.0, 0, 600.0, 101325.0, 23.0, 21.0, 1, 0.0)

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        assert pump_fraction == 0.0


@pytest_asyncio.fixture
async def board() -> AsyncIterator[PumpBoardEmulator]:
    emulator = PumpBoardEmulator(Still())
    await emulator.start()
    yield emulator
    await emulator.stop()


def options(standby: bool = False, clear_faults: bool = False) -> HoldOptions:
    return HoldOptions(
        Config(), "lab.toml", False, None, "test", None, clear_faults, False, standby
    )


async def identified(
    board: PumpBoardEmulator,
    asked: HoldOptions,
    resumes: tuple[str, ...] = (),
    log: ResumeLog | None = None,
) -> BoardAtStart:
    devices = DevicesConfig(board=f"tcp://127.0.0.1:{board.port}")
    config = Config(devices=devices, resume=ResumeConfig(faults=resumes, most_per_day=2))
    return await identify_board(make_bench(devices), config, asked, log)


async def test_a_board_without_faults_is_accepted(board: PumpBoardEmulator) -> None:
    assert await identified(board, options()) == BoardAtStart()


async def test_a_latched_board_is_refused_and_standby_waits_for_it(
    board: PumpBoardEmulator,
) -> None:
    board.state._latch_fault(OVER_PRESSURE)
    with pytest.raises(DeviceError, match=f"latched faults {OVER_PRESSURE:#x}.*--clear-faults"):
        await identified(board, options())
    assert f"{OVER_PRESSURE:#x}" in (await identified(board, options(standby=True))).latched
    assert await identified(board, options(clear_faults=True)) == BoardAtStart()
    assert await identified(board, options()) == BoardAtStart()


async def test_the_watchdogs_own_trip_is_cleared_only_if_the_resume_rule_names_it(
    board: PumpBoardEmulator,
) -> None:
    board.state._latch_fault(WATCHDOG)
    with pytest.raises(DeviceError, match="latched"):
        await identified(board, options(), ("link_lost",))
    found = await identified(board, options(), ("watchdog_tripped",))
    assert (found.latched, "watchdog" in found.cleared) == ("", True)
    assert await identified(board, options()) == BoardAtStart()


@pytest.mark.parametrize("other", [OVER_PRESSURE, load_default_map().make_fault_mask("stopped")])
async def test_the_watchdog_beside_another_fault_is_not_cleared(
    board: PumpBoardEmulator, other: int
) -> None:
    board.state._latch_fault(WATCHDOG | other)
    with pytest.raises(DeviceError, match="latched"):
        await identified(board, options(), ("watchdog_tripped",))


async def test_a_watchdog_that_stopped_a_venting_board_is_not_cleared(
    board: PumpBoardEmulator,
) -> None:
    """The controller before this one was killed while it vented; the board leaves the vent as it
    was.
    """
    board.state._settable["vent_command_fraction"] = 1.0
    board.state._latch_fault(WATCHDOG)
    with pytest.raises(DeviceError, match="latched"):
        await identified(board, options(), ("watchdog_tripped",))


async def test_starts_that_clear_the_watchdog_count_as_resumes(
    board: PumpBoardEmulator, tmp_path: Path
) -> None:
    for _ in range(2):
        board.state._latch_fault(WATCHDOG)
        assert (
            await identified(board, options(), ("watchdog_tripped",), ResumeLog(tmp_path))
        ).cleared
    board.state._latch_fault(WATCHDOG)
    with pytest.raises(DeviceError, match="latched"):
        await identified(board, options(), ("watchdog_tripped",), ResumeLog(tmp_path))


async def test_the_watchdog_is_not_cleared_if_it_cannot_be_counted(
    board: PumpBoardEmulator, tmp_path: Path
) -> None:
    board.state._latch_fault(WATCHDOG)
    with pytest.raises(DeviceError, match="latched"):
        await identified(board, options(), ("watchdog_tripped",), ResumeLog(tmp_path / "nowhere"))


@pytest.mark.parametrize("standby", [False, True])
def test_clear_faults_clears_the_file_in_standby_as_well(tmp_path: Path, standby: bool) -> None:
    (tmp_path / NAME).write_text("{")
    file = open_latched_fault(Config(), tmp_path, options(standby, clear_faults=True))
    assert file is not None
    assert LatchedFile(tmp_path).read() is None


def test_a_latched_fault_that_cannot_be_cleared_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / NAME).mkdir()
    with pytest.raises(DeviceError, match=r"cannot be cleared.*by hand"):
        open_latched_fault(Config(), tmp_path, options(clear_faults=True))


async def test_an_unreachable_board_is_reported_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, unused_tcp_port: int
) -> None:
    monkeypatch.setattr("membrane_ctrl.instruments.bench_connection._PATIENCE_S", 0.05)
    monkeypatch.setattr("membrane_ctrl.instruments.bench_connection._PAUSE_S", 0.0)
    devices = DevicesConfig(board=f"tcp://127.0.0.1:{unused_tcp_port}")
    with pytest.raises(DeviceError) as caught:
        await connect_bench(make_bench(devices), devices)
    reason = "no connection; is the device on, and is this its address?"
    assert str(caught.value) == f"tcp://127.0.0.1:{unused_tcp_port}: {reason}"


@pytest.mark.parametrize("content", ["{", '{"schema": "another"}'])
def test_a_latched_fault_prevents_the_next_hold_and_standby_waits(
    tmp_path: Path, content: str
) -> None:
    (tmp_path / NAME).write_text(content)
    with pytest.raises(DeviceError, match=r"a fault is latched.*--clear-faults"):
        open_latched_fault(Config(), tmp_path, options())
    assert open_latched_fault(Config(), tmp_path, options(standby=True)) is not None
    assert (tmp_path / NAME).read_text() == content


DOOR = {"driver": "board_input", "name": "door", "text": "shut the door", "input": 3}


class Door(Still):
    """The mirror with an open door at input 3."""

    def sample(self) -> BoardSample:
        return replace(super().sample(), interlock_inputs=0xFFFF & ~(1 << 3))


async def test_an_open_interlock_is_refused_and_standby_waits_for_it() -> None:
    emulator = PumpBoardEmulator(Door())
    await emulator.start()
    devices = DevicesConfig.model_validate(
        {"board": f"tcp://127.0.0.1:{emulator.port}", "interlocks": [DOOR]}
    )
    with pytest.raises(
        DeviceError, match=r"interlock door is open: shut the door; close it.*--standby"
    ):
        await identify_board(make_bench(devices), Config(devices=devices), options())
    assert (
        await identify_board(make_bench(devices), Config(devices=devices), options(standby=True))
        == BoardAtStart()
    )
    other = DevicesConfig.model_validate(
        {**devices.model_dump(), "interlocks": [DOOR | {"input": 2}]}
    )
    assert (
        await identify_board(make_bench(other), Config(devices=other), options()) == BoardAtStart()
    )
    await emulator.stop()


async def test_an_input_of_a_board_of_an_earlier_map_is_refused() -> None:
    emulator = PumpBoardEmulator(Still(), registers=list_known_maps()[2])
    await emulator.start()
    devices = DevicesConfig.model_validate(
        {"board": f"tcp://127.0.0.1:{emulator.port}", "interlocks": [DOOR]}
    )
    with pytest.raises(FindingsError, match="register map 2"):
        await identify_board(make_bench(devices), Config(devices=devices), options(standby=True))
    await emulator.stop()
