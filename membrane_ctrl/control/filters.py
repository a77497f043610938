"""First-order filters for unequal steps: exact for an input held over the step."""

from __future__ import annotations

import math


def smoothing(dt_s: float, time_constant_s: float) -> float:
    """Share of the way a first-order lag goes in one step, 1 - exp(-dt / T); 1 without a lag."""
    return -math.expm1(-dt_s / time_constant_s) if time_constant_s > 0 else 1.0


class LowPass:
    """First-order lag that starts at its first input.

    Parameters
    ----------
    time_constant_s : float
        0 passes the input through.
    """

    def __init__(self, time_constant_s: float) -> None:
        self.time_constant_s = time_constant_s
        self.value = math.nan

    def reset(self, value: float) -> None:
        """Stand still at `value`; NaN: start at the next input."""
        self.value = value

    def update(self, given: float, dt_s: float) -> float:
        """Output after `given` was there for `dt_s`."""
        if math.isnan(self.value):
            self.value = given
        self.value += smoothing(dt_s, self.time_constant_s) * (given - self.value)
        return self.value


class LagRate:
    """Rate of change of a signal behind a first-order lag, (x - lag(x)) / T, that survives the signal's absence.

    The mean rate over a step is what the lag moved, divided by the step, so that the rate integrates to exactly
    the lag's own movement. While the signal is absent (NaN) the last value stands and the rate dies away; when it
    is back, the lag is placed where the rate goes on from its present value, whatever the signal did meanwhile:
    neither is a bump. A step that the signal cannot have made is taken for an absence.

    Parameters
    ----------
    time_constant_s : float
        0: the bare difference quotient.
    step_max : float
        The largest that the signal can make from one value to the next.
    """

    def __init__(self, time_constant_s: float, step_max: float = math.inf) -> None:
        self.time_constant_s = time_constant_s
        self.rate_per_s = 0.0
        self._step_max = step_max
        self._input = math.nan
        self._lag = math.nan
        self._absent = True

    def update(self, given: float, dt_s: float) -> float:
        """Mean rate per second over the step; `given` may be NaN."""
        share = smoothing(dt_s, self.time_constant_s)
        if math.isfinite(given):
            if self._absent or abs(given - self._input) > self._step_max:
                self._lag = given - self.rate_per_s * dt_s / share
            self._input = given
        self._absent = not math.isfinite(given)
        if math.isfinite(self._input):
            moved = share * (self._input - self._lag)
            self._lag += moved
            self.rate_per_s = moved / dt_s
        return self.rate_per_s
