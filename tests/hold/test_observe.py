"""`hold --observe` reads, estimates and records, and never writes to an actuator."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from dataclasses import dataclass, field

import pytest
import pytest_asyncio

from firmware_iface.emulators.pump_board import BoardSample, PumpBoardEmulator
from firmware_iface.roles import BenchCommand
from membrane_ctrl.cli import run as run_command_line
from membrane_ctrl.config.schema import Config, DevicesConfig, EstimatorConfig, StatesConfig
from membrane_ctrl.controller.command import Command, Kind
from membrane_ctrl.hold.hold_options import HoldOptions
from membrane_ctrl.hold.start_checks import identify_board
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.instruments.bench import make_bench
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.model.events import CommandTaken, Fault
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump, foreign_config


class Still:
    """An idle plant."""

    def sample(self) -> BoardSample:
        return BoardSample(0.0, 0, 600.0, 101325.0, 23.0, 21.0, 1, 0.0)

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        pass


@pytest_asyncio.fixture
async def board() -> AsyncIterator[PumpBoardEmulator]:
    emulator = PumpBoardEmulator(Still())
    await emulator.start()
    yield emulator
    await emulator.stop()


def count_writes(board: PumpBoardEmulator, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The addresses of every register that a client writes from now on."""
    written: list[int] = []
    take = type(board.state).write

    def write(self: object, address: int, values: list[int]) -> object:
        written.append(address)
        return take(self, address, values)  # type: ignore[arg-type]

    monkeypatch.setattr(type(board.state), "write", write)
    return written


async def test_an_observed_board_is_never_written(
    board: PumpBoardEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = count_writes(board, monkeypatch)
    devices = DevicesConfig(board=f"tcp://127.0.0.1:{board.port}")
    config = Config(devices=devices, states=StatesConfig(observe=True))
    board.state._latch_fault(1)
    options = HoldOptions(config, "lab.toml", False, None, "test", None, False, False, True)
    await identify_board(make_bench(devices, observe=True), config, options)
    bench = make_bench(devices, observe=True)
    await bench.open()
    for _ in range(5):
        reading = await bench.read()
        assert math.isfinite(reading.displacement_um)
        assert reading.latched_faults == 1
        await bench.write(BenchCommand(0.5, 1.0))
    await bench.clear_faults(-1)
    await bench.close()
    await bench.open()  # as after a lost link
    await bench.close()
    assert written == []
    # the count sees what a hold does
    driven = make_bench(devices)
    await driven.open()
    await driven.close()
    assert written
    await asyncio.sleep(0)


@dataclass
class DrivenElsewhere(VirtualBench):
    """A board whose pump another controller drives; it counts our writes."""

    fraction: float = 0.31
    writes: list[BenchCommand] = field(default_factory=list)

    def __init__(self) -> None:
        self.fraction, self.writes = 0.31, []
        super().__init__(ForeignPlant(ForeignPump(), seed=2, weather=0.3))  # type: ignore[arg-type]

    def drive_actuators(self) -> None:
        self.wrong.readback_fraction = self.fraction
        self.plant.actuate(self.fraction, 0.0)

    def write(self, command: BenchCommand) -> None:
        self.writes.append(command)


def observe(
    duration_s: float, *commands: Command, process_value: str = "estimate"
) -> tuple[list[VirtualTick], DrivenElsewhere]:
    config = foreign_config(rate_hz=20.0).model_copy(
        update={
            "states": StatesConfig(observe=True),
            "estimator": EstimatorConfig.model_validate({"process_value": process_value}),
        }
    )
    bench = DrivenElsewhere()
    run = VirtualRun(config, bench, zernike_projection())
    ticks = [run.run_tick((Command("hold", "test"), *commands))]
    while run.now_s < duration_s and run.finished is None:
        ticks.append(run.run_tick())
    ticks.append(run.run_tick((Command("stop", "test"),)))
    assert run.finished == Exit.INTERRUPTED
    return [tick for tick in ticks if tick is not None], bench


def test_a_mirror_that_others_hold_is_followed_without_a_command_or_a_fault() -> None:
    ticks, bench = observe(60.0)
    assert {tick.row.state for tick in ticks} == {State.STANDBY}
    assert {(tick.row.pump_fraction, tick.row.vent_fraction) for tick in ticks} == {(0.0, 0.0)}
    assert all(command == BenchCommand(0.0, 0.0) for command in bench.writes)
    assert not any(isinstance(event, Fault) for tick in ticks for event in tick.events)
    # read-back, flow, filtered reading and the estimate's standard deviation are there
    last = ticks[-2].row
    assert last.pump_readback_fraction == pytest.approx(0.31)
    assert last.flow_um_per_s == pytest.approx(1.24, abs=0.1)
    assert abs(last.filtered_um - last.truth_displacement_um) < 1.0
    assert 0.0 < last.estimate_sigma_um < 1.0


@pytest.mark.parametrize(
    "kind", ["hold", "manual", "tune", "gains", "vent", "lower", "setpoint", "ack"]
)
def test_commands_that_would_drive_are_refused_with_the_cause(kind: Kind) -> None:
    ticks, _ = observe(1.0, Command(kind, "someone", value=1.0))
    refused = [
        event
        for tick in ticks
        for event in tick.events
        if isinstance(event, CommandTaken) and event.command == kind
    ]
    assert refused
    assert all("only observes" in (event.refused or "") for event in refused)


def test_single_instruments_cannot_be_observed() -> None:
    with pytest.raises(InputError, match="needs a pump board"):
        make_bench(DevicesConfig.model_construct(board=None), observe=True)


def test_what_writes_is_not_combined_with_observing(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--autotune", "--clear-faults"):
        assert run_command_line(["hold", "--twin", "--observe", option]) == Exit.BAD_INPUT
        assert "writes nothing" in capsys.readouterr().err
