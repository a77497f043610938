"""The diaphragm pump: adds gas only, sticks at low commands, responds late."""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable

import numpy as np

from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.model.arrays import FloatArray

_LEVELS = 4096  # of a tabulated curve: 12 bits
_PLAY_FRACTION = 0.04  # of the hysteretic pump, either way
# Share of the full flow against the share of the command beyond `dead_fraction`
_SHAPES: dict[str, Callable[[FloatArray], FloatArray]] = {
    "quadratic": np.square,
    "root": np.sqrt,
    "s-shaped": lambda x: x**2 * (3 - 2 * x),
    "saturating": lambda x: np.minimum(x / 0.6, 1.0),
    "hysteretic": lambda x: x,
    "pwm": lambda x: np.floor(x * 255) / 255,
}


class PumpModel:
    """A pump with dead zone, lag and transport, advanced in fixed steps.

    q = q_full (d - dead) / (1 - dead) once running; it starts at `start_fraction` and stalls below
    `stall_fraction`. Or a curve through the configuration's points, or of `twin.pump_shape`; two
    branches give the flow play.

    Parameters
    ----------
    config : PumpConfig
        Fractions and points of the curve.
    flow_full_ml_per_s : float
        Flow at full command.
    step_s : float
        Length of a step.
    twin : TwinConfig or None
        Lag, transport and shape; None: the defaults.

    Raises
    ------
    ValueError
        The pump delivers nothing at any command.
    """

    def __init__(
        self,
        config: PumpConfig,
        flow_full_ml_per_s: float,
        step_s: float,
        twin: TwinConfig | None = None,
    ) -> None:
        if config.dead_fraction >= 1:
            raise ValueError(
                "pump.dead_fraction = 1: a pump that never delivers; it must be below 1"
            )
        twin = twin or TwinConfig()
        self._dead = config.dead_fraction
        self._start = config.start_fraction
        self._stall = config.stall_fraction
        self._ml_per_s_per_fraction = flow_full_ml_per_s / (1 - config.dead_fraction)
        self._branches = _make_branches(config, twin.pump_shape, flow_full_ml_per_s)
        self._play_ml_per_s = 0.0
        self._follow = -math.expm1(-step_s / twin.pump_lag_s)
        self._running = False
        self._flow_ml_per_s = 0.0
        self._tube = deque([0.0] * round(twin.pump_delay_s / step_s))

    def settle_at_flow(self, flow_ml_per_s: float) -> float:
        """Settle at the command that delivers this flow, and return it.

        The pump stays off if the flow is too small to keep it running.
        """
        command = self._dead + flow_ml_per_s / self._ml_per_s_per_fraction
        if self._branches is not None:
            rising = self._branches[0]
            command = bisect_left(rising, flow_ml_per_s) / _LEVELS
        self._running = self._stall <= command <= 1
        self._flow_ml_per_s = self._play_ml_per_s = flow_ml_per_s if self._running else 0.0
        self._tube = deque([self._flow_ml_per_s] * len(self._tube))
        return command if self._running else 0.0

    def run_steps(self, command: float, steps: int) -> list[float]:
        """Run some time steps with one command.

        Parameters
        ----------
        command : float
            From 0 to 1.
        steps : int
            How many.

        Returns
        -------
        list of float
            The flow that reaches the films in each step, mL/s.
        """
        # A second step changes neither whether the pump runs nor the play.
        self._running = command >= (self._stall if self._running else self._start)
        if self._branches is None:
            delivers = self._running and command > self._dead
            target = 0.0
            if delivers:
                target = self._ml_per_s_per_fraction * (command - self._dead)
        else:
            rising, falling = self._branches
            level = round(command * _LEVELS)
            target = 0.0
            if self._running:
                target = min(max(self._play_ml_per_s, rising[level]), falling[level])
            self._play_ml_per_s = target
        flow_ml_per_s = self._flow_ml_per_s
        reached = []
        for _ in range(steps):
            flow_ml_per_s += (target - flow_ml_per_s) * self._follow
            self._tube.append(flow_ml_per_s)
            reached.append(self._tube.popleft())
        self._flow_ml_per_s = flow_ml_per_s
        return reached


def _make_branches(
    config: PumpConfig, shape: str, full_ml_per_s: float
) -> tuple[list[float], list[float]] | None:
    """Flow in mL/s at each level of the command, rising and falling; None for the straight line."""
    command = np.arange(_LEVELS + 1) / _LEVELS
    if shape != "configured":
        # A shape of the share beyond the dead band; hysteresis shifts the two branches apart
        play = _PLAY_FRACTION if shape == "hysteretic" else 0.0
        branches = []
        for shift in (-play, play):
            share = (command + shift - config.dead_fraction) / (1 - config.dead_fraction)
            branches.append(full_ml_per_s * _SHAPES[shape](np.clip(share, 0.0, 1.0)))
        rising, falling = branches
        falling[0] = 0.0
        return rising.tolist(), falling.tolist()
    if not config.curve_fraction:
        return None
    # The measured points, joined by SciPy's monotone cubic; no flow below the first of them
    from scipy.interpolate import PchipInterpolator

    points = np.array(config.curve_fraction)
    scale = full_ml_per_s / config.flow_full_um_per_s
    within = np.clip(command, points[0], points[-1])
    branches = []
    for flows in (config.curve_um_per_s, config.curve_falling_um_per_s or config.curve_um_per_s):
        curve = PchipInterpolator(points, np.array(flows))
        branches.append(np.where(command < points[0], 0.0, scale * curve(within)))
    rising, falling = branches
    return rising.tolist(), falling.tolist()
