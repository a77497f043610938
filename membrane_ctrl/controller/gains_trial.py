"""Gains on trial: they revert to the last good ones unless they are kept in time."""

import math
from dataclasses import dataclass, replace

from membrane_ctrl.config.schema import LoopConfig, PumpConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model.state_tree import StateNode


@dataclass(frozen=True, slots=True)
class GainsInUse(StateNode):
    """All settings that a `gains` command changes."""

    loop: LoopConfig
    shape_time_constant_s: float
    pump: PumpConfig


@dataclass(slots=True)
class GainsState(StateNode):
    """The present settings, and those that a trial restores."""

    good: GainsInUse
    tried: GainsInUse
    until_s: float = math.nan  # end of the trial; NaN: there is none
    # part of the trial; NaN: the setpoint and the shape loop are not
    setpoint_step_um: float = math.nan
    limited: LoopConfig | None = None  # what `limit` has set last


class GainsTrial:
    """Gains, and the pump's curve, on trial revert to the last good ones unless kept in time; a
    run's first are good.

    The client that tries them may lose its connection or be killed: the loop must not keep
    unverified gains (docs/decisions/78-gains-on-trial.md).
    """

    def __init__(self, memory: GainsState) -> None:
        self.memory = memory

    @property
    def on_trial(self) -> bool:
        """The present gains are not kept yet."""
        return math.isfinite(self.memory.until_s)

    def begin(self, loop: LoopConfig, command: Command, now_s: float) -> None:
        """Set a command's gains.

        Parameters
        ----------
        loop : LoopConfig
            The settings with the new gains.
        command : Command
            Its value is the duration of the trial in s; NaN: permanently.
        now_s : float
            Time of the tick, from which the trial counts.
        """
        memory = self.memory
        tried = replace(memory.tried, loop=loop)
        if command.pump is not None:
            tried = replace(tried, pump=command.pump)
        if math.isfinite(command.shape_time_constant_s):
            tried = replace(tried, shape_time_constant_s=command.shape_time_constant_s)
        memory.tried = tried
        memory.setpoint_step_um = command.setpoint_step_um
        memory.until_s = now_s + command.value
        if not self.on_trial:
            self.keep()

    @property
    def present(self) -> GainsInUse:
        """The present settings."""
        return self.memory.tried

    @property
    def setpoint_step_um(self) -> float:
        """The trial's step of the setpoint; NaN: the setpoint and the
        shape loop are no part of it.
        """
        return self.memory.setpoint_step_um

    def keep(self) -> None:
        """Keep the present gains."""
        self.memory.good = self.memory.tried
        self._end_trial()

    def replace_pump(self, pump: PumpConfig, loop: LoopConfig) -> None:
        """Replace the pump's curve, and the loop's settings with it, by others that stay.

        Not during a trial: the caller waits for its end.

        Parameters
        ----------
        pump : PumpConfig
            The curve that the actuator test has found.
        loop : LoopConfig
            The loop's settings on it, in particular the largest flow.
        """
        self.memory.tried = replace(self.memory.tried, pump=pump)
        self.limit(loop)

    def limit(self, loop: LoopConfig) -> None:
        """Replace the loop's settings, which are not on trial, by others that stay."""
        self.memory.tried = replace(self.memory.tried, loop=loop)
        self.memory.limited = loop
        self.keep()

    def is_overdue(self, now_s: float) -> bool:
        """The trial has ended without `keep`."""
        return now_s >= self.memory.until_s

    def revert(self) -> None:
        """Restore the last good settings."""
        self.memory.tried = self.memory.good
        self._end_trial()

    def _end_trial(self) -> None:
        self.memory.until_s = math.nan
        self.memory.setpoint_step_um = math.nan
