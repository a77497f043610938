"""The diaphragm pump: adds gas only, sticks at low command, answers late."""

from __future__ import annotations

import math
from collections import deque

from membrane_ctrl.config import PumpConfig

LAG_S = 0.15  # motor and diaphragm
TRANSPORT_S = 0.075  # gas in the tube


class Pump:
    """q = q_full (d - dead) / (1 - dead) once running; starts at `start_fraction`, stalls below `stall_fraction`.

    Parameters
    ----------
    config : PumpConfig
        Where it starts, stalls and begins to deliver.
    flow_full_ml_per_s : float
        Flow at command 1.
    step_s : float
        Time step.

    Raises
    ------
    ValueError
        If the pump delivers nothing at any command.
    """

    def __init__(self, config: PumpConfig, flow_full_ml_per_s: float, step_s: float) -> None:
        if config.dead_fraction >= 1:
            raise ValueError("pump.dead_fraction = 1: a pump that never delivers; it must be below 1")
        self._dead = config.dead_fraction
        self._start = config.start_fraction
        self._stall = config.stall_fraction
        self._ml_per_s_per_fraction = flow_full_ml_per_s / (1 - config.dead_fraction)
        self._follow = -math.expm1(-step_s / LAG_S)
        self._running = False
        self._flow_ml_per_s = 0.0
        self._tube = deque([0.0] * round(TRANSPORT_S / step_s))

    def hold(self, flow_ml_per_s: float) -> float:
        """Stand where the pump delivers this flow for ever, and return that command.

        A flow so small that the pump would stall leaves it off.
        """
        command = self._dead + flow_ml_per_s / self._ml_per_s_per_fraction
        self._running = self._stall <= command <= 1
        self._flow_ml_per_s = flow_ml_per_s if self._running else 0.0
        self._tube = deque([self._flow_ml_per_s] * len(self._tube))
        return command if self._running else 0.0

    def step(self, command: float) -> float:
        """One time step with the command 0..1; the flow that reaches the films in it, mL/s."""
        self._running = command >= (self._stall if self._running else self._start)
        delivers = self._running and command > self._dead
        target = self._ml_per_s_per_fraction * (command - self._dead) if delivers else 0.0
        self._flow_ml_per_s += (target - self._flow_ml_per_s) * self._follow
        self._tube.append(self._flow_ml_per_s)
        return self._tube.popleft()
