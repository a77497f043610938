"""The closed loop in the frequency domain, with its exact delay.

    L = C F P,   P = k exp(-j w (theta + h / 2)) / (j w (1 + j w T)),
    C = K (1 + 1 / (j w Ti) + j w Td),   F = 1 / (1 + j w Tf)

theta is the dead time from a reading to the first gas, h / 2 the mean delay of a command held for a
sample. A Pade approximation would shift the margins by as much as the designs differ; a frequency
response needs none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config.schema import LoopConfig
from membrane_ctrl.model.arrays import ComplexArray
from tuning.identification.plant_model import PlantModel
from tuning.identification.record import Series

SLOWEST_RAD_PER_S = 1e-4


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of a controller.

    Attributes
    ----------
    kp_per_s : float
        K.
    ti_s, td_s : float
        Ti and Td.
    filter_s : float
        Tf of the filter, which precedes all three terms.
    """

    kp_per_s: float
    ti_s: float
    td_s: float = 0.0
    filter_s: float = 0.0

    @classmethod
    def from_config(cls, loop: LoopConfig) -> Gains:
        """Gains of a configured loop."""
        return cls(loop.kp_per_s, loop.ti_s, loop.td_s, loop.measurement_filter_s)

    def round_to_four_digits(self) -> Gains:
        """To four digits: more mean nothing, and people copy them."""
        values = (self.kp_per_s, self.ti_s, self.td_s, self.filter_s)
        return Gains(*(float(f"{value:.4g}") for value in values))

    def applied_to(self, loop: LoopConfig) -> LoopConfig:
        """The loop with these gains, validated. Raises pydantic.ValidationError outside the
        permitted range.
        """
        times = {"ti_s": self.ti_s, "td_s": self.td_s, "measurement_filter_s": self.filter_s}
        return LoopConfig.model_validate(loop.model_dump() | times | {"kp_per_s": self.kp_per_s})


def make_frequencies(dt_s: float, points: int = 400) -> Series:
    """Return angular frequencies from far below any loop to Nyquist, evenly in their logarithm.

    Parameters
    ----------
    dt_s : float
        Period of a tick.
    points : int
        How many.

    Returns
    -------
    (points,) array
        rad/s.
    """
    return np.geomspace(SLOWEST_RAD_PER_S, np.pi / dt_s, points)


def compute_pump_response(model: PlantModel, w_rad_per_s: Series, dt_s: float) -> ComplexArray:
    """Compute the response from commanded flow to the speed of the centre, without the leak.

    Parameters
    ----------
    model : PlantModel
        k, theta and T.
    w_rad_per_s : (n,) array
        Angular frequencies.
    dt_s : float
        Sample time h.

    Returns
    -------
    (n,) complex array
        j w P.
    """
    s = 1j * w_rad_per_s
    delay_s = model.dead_time_s + dt_s / 2
    delayed = model.gain * np.exp(-s * delay_s)
    return np.asarray(delayed / (1 + s * model.lag_s))


def compute_controller_response(gains: Gains, w_rad_per_s: Series) -> ComplexArray:
    """Compute the response from error to commanded flow, C F of the module's equation.

    Parameters
    ----------
    gains : Gains
        Of the PID and its filter.
    w_rad_per_s : (n,) array
        Angular frequencies.

    Returns
    -------
    (n,) complex array
        1/s.
    """
    s = 1j * w_rad_per_s
    three_terms = 1 + 1 / (s * gains.ti_s) + s * gains.td_s
    return np.asarray(gains.kp_per_s * three_terms / (1 + s * gains.filter_s))


def compute_loop_response(
    gains: Gains, model: PlantModel, w_rad_per_s: Series, dt_s: float
) -> ComplexArray:
    """Compute the response of the open loop.

    Parameters
    ----------
    gains : Gains
        Of the PID and its filter.
    model : PlantModel
        The plant, P.
    w_rad_per_s : (n,) array
        Angular frequencies.
    dt_s : float
        Sample time of the loop.

    Returns
    -------
    (n,) complex array
        L = C F P.
    """
    integrator = 1 / (1j * w_rad_per_s)
    return (
        compute_controller_response(gains, w_rad_per_s)
        * compute_pump_response(model, w_rad_per_s, dt_s)
        * integrator
    )
