"""Inputs and outputs of a tick: the whole interface between the control code and the world.

A tick is a plain function of these, with no I/O and no clock: the asyncio supervisor, the
virtual-time runs and a replay call the same code.
"""

import math
from dataclasses import dataclass, field

from firmware_iface.roles import BenchCommand, BenchReading
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.link_report import LinkReport
from membrane_ctrl.model import errors, shape_estimate, telemetry
from membrane_ctrl.model.events import Event


@dataclass(frozen=True, slots=True)
class TickInputs:
    """All inputs of a tick."""

    now_s: float  # start of the tick on the run's clock
    dt_s: float  # true time since the last tick, clamped
    reading: BenchReading | None  # None without a valid answer in this tick
    lateness_ms: float = 0.0  # start after the deadline
    missed_ticks: int = 0  # running count of skipped deadlines
    link_up: bool = True  # the device link is connected
    # the newest shape, only in the tick in which it arrives
    estimate: shape_estimate.ShapeEstimate | None = None
    commands: tuple[Command, ...] = ()  # since the last tick
    dead_tasks: tuple[str, ...] = ()  # supervised tasks that ended
    link: LinkReport = field(default_factory=LinkReport)
    # the twin's truth, for the record only; NaN on a real bench
    truth_displacement_um: float = math.nan
    truth_laser_bias_um: float = math.nan


@dataclass(frozen=True, slots=True)
class TickOutputs:
    """All outputs of a tick."""

    command: BenchCommand  # the write that ends the tick
    row: telemetry.TelemetryRow
    events: tuple[Event, ...]
    finished: errors.Exit | None  # exit code if the run is over
    # number of each command, and why it was refused (empty: executed)
    answers: tuple[tuple[int, str], ...] = ()
    # the board's latches to clear: all after `ack`, the watchdog's by the resume rule
    clear_mask: int = 0
