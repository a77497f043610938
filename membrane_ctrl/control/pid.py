"""PI(D) on a filtered measurement, with back-calculation and a clamped integrator. Pure.

    P = K (r - y)          D = -K Td dy/dt          u = P + I + D
    dI/dt = K / Ti (r - y) + (v - u) / Tt,    Tt = Ti,    0 <= I <= v_max

v is u within the pump's range [0, v_max].
Source: Astrom and Hagglund, Advanced PID Control (2006), sections 3.4 and 3.5.

The feed-forward is added afterwards, and the integrator ignores what the limits cut from it. Gusts
are cut on one side only, as the pump removes no gas. In the steady state dI/dt = 0, so
back-calculation would turn a mean cut (v - u) into a mean error -(v - u) / K: measured with gusts,
0.18 µm with the feed-forward inside the back-calculation, and 0.00 as here.
"""

from dataclasses import dataclass

from membrane_ctrl.model.state_tree import StateNode


@dataclass(frozen=True, slots=True)
class PidGains:
    """Gains: K in 1/s (µm/s of flow per µm), times in s."""

    kp_per_s: float
    ti_s: float
    td_s: float


@dataclass(frozen=True, slots=True)
class PidTerms:
    """The three terms of one step, µm/s."""

    p_um_per_s: float
    i_um_per_s: float
    d_um_per_s: float

    @property
    def sum_um_per_s(self) -> float:
        """P + I + D."""
        return self.p_um_per_s + self.i_um_per_s + self.d_um_per_s


@dataclass(slots=True)
class PidState(StateNode):
    """The integrator, and the last error and measurement rate (for bumpless changes)."""

    integral_um_per_s: float = 0.0
    error_um: float = 0.0
    rate_um_per_s: float = 0.0


class Pid:
    """PI(D) with the present gains.

    The integrator stays between 0, as the pump removes no gas, and `flow_max_um_per_s`.
    """

    def __init__(
        self, gains: PidGains, flow_max_um_per_s: float, memory: PidState | None = None
    ) -> None:
        self.gains = gains
        self.flow_max_um_per_s = flow_max_um_per_s
        self.memory = memory or PidState()

    @property
    def integral_um_per_s(self) -> float:
        """The integrator: the mean flow."""
        return self.memory.integral_um_per_s

    def place(self, integral_um_per_s: float) -> None:
        """Set the integrator, within its range, and forget the last error."""
        self.memory.integral_um_per_s = self._clamp_flow(integral_um_per_s)
        self.memory.error_um = 0.0
        self.memory.rate_um_per_s = 0.0

    def terms(self, error_um: float, measured_rate_um_per_s: float) -> PidTerms:
        """Return P, I and D.

        Parameters
        ----------
        error_um : float
            Setpoint less (filtered) measurement.
        measured_rate_um_per_s : float
            Rate of the filtered measurement, for D.
        """
        self.memory.error_um = error_um
        self.memory.rate_um_per_s = measured_rate_um_per_s
        return self._compute_terms()

    def integrate(self, dt_s: float) -> None:
        """Advance the integrator by the last error, back-calculated where the terms leave the
        pump's range.
        """
        wanted_um_per_s = self._compute_terms().sum_um_per_s
        back_um_per_s = self._clamp_flow(wanted_um_per_s) - wanted_um_per_s
        drive_um_per_s = self.gains.kp_per_s * self.memory.error_um + back_um_per_s
        integral_um_per_s = self.memory.integral_um_per_s + drive_um_per_s * dt_s / self.gains.ti_s
        self.memory.integral_um_per_s = self._clamp_flow(integral_um_per_s)

    def set_gains(self, gains: PidGains) -> None:
        """Change the gains and let the integrator take up the difference, so that the sum does not
        jump.
        """
        before = self._compute_terms()
        self.gains = gains
        self.memory.integral_um_per_s = self._clamp_flow(
            self.memory.integral_um_per_s + before.sum_um_per_s - self._compute_terms().sum_um_per_s
        )

    def _compute_terms(self) -> PidTerms:
        kp, td_s = self.gains.kp_per_s, self.gains.td_s
        memory = self.memory
        return PidTerms(
            kp * memory.error_um, memory.integral_um_per_s, -kp * td_s * memory.rate_um_per_s
        )

    def _clamp_flow(self, flow_um_per_s: float) -> float:
        return min(max(flow_um_per_s, 0.0), self.flow_max_um_per_s)
