"""What goes into a tick and what comes out: the whole interface between the control code and the world.

A tick is a plain function of these, with no I/O and no clock: the asyncio supervisor, the virtual-time runs and
a replay call the same code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from firmware_iface.roles import BenchCommand, BenchReading
from membrane_ctrl.commands import Command
from membrane_ctrl.errors import Exit
from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.telemetry import TelemetryRow

Event = dict[str, Any]  # one line of events.jsonl, without its times


@dataclass(frozen=True, slots=True)
class TickInputs:
    """Everything a tick may know.

    Attributes
    ----------
    now_s : float
        Start of the tick on the run's clock.
    dt_s : float
        True time since the last tick, clamped.
    lateness_ms : float
        Start against the deadline.
    missed_ticks : int
        Running count of skipped deadlines.
    link_up : bool
        The device link is connected.
    reading : BenchReading or None
        None if the device gave no valid answer in this tick.
    estimate : ShapeEstimate or None
        The newest shape, in the tick in which it arrives.
    commands : tuple of Command
        Since the last tick.
    dead_tasks : tuple of str
        Supervised tasks that ended.
    truth_displacement_um, truth_laser_bias_um : float
        The twin's truth, for the record only; NaN on a real bench.
    """

    now_s: float
    dt_s: float
    reading: BenchReading | None
    lateness_ms: float = 0.0
    missed_ticks: int = 0
    link_up: bool = True
    estimate: ShapeEstimate | None = None
    commands: tuple[Command, ...] = ()
    dead_tasks: tuple[str, ...] = ()
    truth_displacement_um: float = math.nan
    truth_laser_bias_um: float = math.nan


@dataclass(frozen=True, slots=True)
class TickOutputs:
    """What a tick decided.

    Attributes
    ----------
    command : BenchCommand
        The write that ends the tick.
    row : TelemetryRow
        For the record.
    events : tuple of Event
        For the record.
    finished : Exit or None
        The run is over, with this exit code.
    answers : tuple of (int, str)
        Number of each command of this tick, and why it was refused (empty: obeyed).
    clear_mask : int
        Which of the board's own latches to clear: all on a person's word, the watchdog's by the resume rule.
    """

    command: BenchCommand
    row: TelemetryRow
    events: tuple[Event, ...]
    finished: Exit | None
    answers: tuple[tuple[int, str], ...] = ()
    clear_mask: int = 0
