"""A run in virtual time: the same controller on the twin, without processes, sockets or waiting.

What a run has and this has not: the link and its latency (a read here is the plant's state at the tick, a write
takes effect at once), lateness, and the processes. A shape source, if given, is asked on its cycle's deadlines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_iface.roles import BenchReading
from membrane_ctrl.commands import Command
from membrane_ctrl.config import Config
from membrane_ctrl.controller import Controller
from membrane_ctrl.errors import Exit
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.telemetry import TelemetryRow
from membrane_ctrl.tick import Event, TickInputs
from membrane_ctrl.twin.plant import Plant

ShapeSource = Callable[[float], ShapeEstimate | None]


@dataclass(frozen=True, slots=True)
class VirtualTick:
    """What one tick left behind."""

    row: TelemetryRow
    events: tuple[Event, ...]
    finished: Exit | None


def run_virtual(
    config: Config,
    plant: Plant,
    duration_s: float,
    sag_sensitivity: NDArray[np.float64],
    shape: ShapeSource | None = None,
    alter: Callable[[float, BenchReading], BenchReading | None] | None = None,
) -> Iterator[VirtualTick]:
    """Hold the twin for `duration_s` of its time, as fast as it goes.

    Parameters
    ----------
    config : Config
        As for a run.
    plant : Plant
        The twin's physics.
    duration_s : float
        When the hold is asked to stop.
    sag_sensitivity : (36,) array
        See `Controller`.
    shape : callable, optional
        Called with the time every `shape.period_s`; returns an estimate or None.
    alter : callable, optional
        Stands between the sensors and the controller, to make faults: gets the time and the reading.

    Yields
    ------
    VirtualTick
        Until the controller says that the run is over.
    """
    controller = Controller(config, sag_sensitivity)
    period_s = 1.0 / config.loop.rate_hz
    due_s = 0.0
    commands: tuple[Command, ...] = (Command("hold", "virtual run"),)
    tick = 0
    stopping = False
    while True:
        plant.advance(period_s)
        tick += 1
        now_s = tick * period_s
        if now_s >= duration_s and not stopping:
            stopping, commands = True, (*commands, Command("stop", "duration"))
        estimate = None
        if shape is not None and now_s >= due_s:
            due_s += config.shape.period_s
            estimate = shape(now_s)
        reading: BenchReading | None = read_plant(plant)
        if alter is not None and reading is not None:
            reading = alter(now_s, reading)
        truth = plant.truth()
        outputs = controller.tick(
            TickInputs(
                now_s=now_s,
                dt_s=period_s,
                reading=reading,
                estimate=estimate,
                commands=commands,
                truth_displacement_um=truth.displacement_um,
                truth_laser_bias_um=truth.laser_bias_um,
            )
        )
        commands = ()
        plant.actuate(outputs.command.pump_fraction, outputs.command.vent_fraction)
        yield VirtualTick(outputs.row, outputs.events, outputs.finished)
        if outputs.finished is not None:
            return


def read_plant(plant: Plant) -> BenchReading:
    """The plant's sensors as the device would report them."""
    sample = plant.sample()
    return BenchReading(
        displacement_um=sample.displacement_um,
        displacement_quality=sample.displacement_quality,
        gauge_pressure_pa=sample.gauge_pressure_pa,
        ambient_pressure_pa=sample.ambient_pressure_pa,
        air_temperature_c=sample.air_temperature_c,
        gas_temperature_c=sample.gas_temperature_c,
        pump_fraction=sample.pump_fraction,
        vent_fraction=sample.vent_fraction,
        sample_counter=sample.sample_counter,
        device_time_s=sample.device_time_s,
        watchdog_tripped=False,
        latched_faults=0,
    )
