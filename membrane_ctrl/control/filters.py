"""First-order lags of a signal with unequal steps, and its rate of change behind one. Pure."""

import math
from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode


def lag_step_fraction(dt_s: float, time_constant_s: float) -> float:
    """Return the share of a step that a first-order lag follows in one tick, 1 - exp(-dt / T).

    Parameters
    ----------
    dt_s : float
        Duration of the tick.
    time_constant_s : float
        T; 0 means no lag, and a share of 1.
    """
    if time_constant_s > 0:
        return -math.expm1(-dt_s / time_constant_s)
    return 1.0


@dataclass(slots=True)
class LowPass(StateNode):
    """First-order lag that starts at its first input; a time constant of 0 passes the input
    through.
    """

    value: float = math.nan
    age_s: float = math.inf  # of a mean of all inputs; infinite without one

    @classmethod
    def with_early_mean(cls) -> "LowPass":
        """A lag that is the plain mean of its inputs at first, of which none weighs more than the
        others.
        """
        return cls(age_s=0.0)

    def reset(self, value: float) -> None:
        """Stand still at `value`; NaN: start at the next input."""
        self.value = value

    def update(self, given: float, dt_s: float, time_constant_s: float) -> float:
        """Return the output after one step.

        Parameters
        ----------
        given : float
            Input that was applied since the last step.
        dt_s : float
            For how long.
        time_constant_s : float
            0: the output is the input.
        """
        self.age_s += dt_s
        if math.isnan(self.value):
            self.value = given
        share = dt_s / self.age_s if dt_s > 0 else 0.0
        self.value += max(lag_step_fraction(dt_s, time_constant_s), share) * (given - self.value)
        return self.value


@dataclass(slots=True)
class LagRate(StateNode):
    """Rate of change of a signal behind a first-order lag, (x - lag(x)) / T, that survives the
    signal's absence.

    The mean rate over a step is the lag's change divided by the step, so that the rate integrates
    exactly to the lag's own movement; T = 0 gives the plain difference quotient. While the signal
    is absent (NaN) the last value stands and the rate decays; on its return the lag is placed so
    that the rate continues from its present value: neither makes a bump. A step of more than
    `step_max` counts as an absence.
    """

    rate_per_s: float = 0.0
    input: float = math.nan
    lag: float = math.nan
    absent: bool = True

    def update(
        self, given: float, dt_s: float, time_constant_s: float, step_max: float = math.inf
    ) -> float:
        """Return the mean rate of the filtered input over the step.

        Parameters
        ----------
        given : float
            The input; NaN while it is absent.
        dt_s : float
            For how long.
        time_constant_s : float
            Of the lag.
        step_max : float
            A larger change counts as an absence: the rate continues.

        Returns
        -------
        float
            In units of the input per second.
        """
        share = lag_step_fraction(dt_s, time_constant_s)
        if math.isfinite(given):
            # Back after an absence: the lag is placed where the step below gives the present rate
            if self.absent or abs(given - self.input) > step_max:
                self.lag = given - self.rate_per_s * dt_s / share
            self.input = given
        self.absent = not math.isfinite(given)
        # An absent input stays at its last value: the lag approaches it, and the rate decays
        if math.isfinite(self.input):
            moved = share * (self.input - self.lag)
            self.lag += moved
            self.rate_per_s = moved / dt_s
        return self.rate_per_s
