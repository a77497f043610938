"""The closed loop in the frequency domain, with its exact delay.

    L = C F P,   P = k exp(-j w (theta + h / 2 + write)) / (j w (1 + j w T)),
    C = K (1 + 1 / (j w Ti) + j w Td),   F = 1 / (1 + j w Tf)

h / 2 is the mean delay of a command held for a sample. A Pade approximation would shift the margins
by as much as the designs differ; a frequency response needs none.
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
    """A controller: K in 1/s, times in s; the filter precedes all three terms."""

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
        return Gains(
            *(
                float(f"{value:.4g}")
                for value in (self.kp_per_s, self.ti_s, self.td_s, self.filter_s)
            )
        )

    def applied_to(self, loop: LoopConfig) -> LoopConfig:
        """The loop with these gains, validated. Raises pydantic.ValidationError outside the
        permitted range.
        """
        times = {"ti_s": self.ti_s, "td_s": self.td_s, "measurement_filter_s": self.filter_s}
        return LoopConfig.model_validate(loop.model_dump() | times | {"kp_per_s": self.kp_per_s})


def make_frequencies(dt_s: float, points: int = 400) -> Series:
    """Angular frequencies from far below any loop to Nyquist, evenly in their logarithm."""
    return np.geomspace(SLOWEST_RAD_PER_S, np.pi / dt_s, points)


def compute_pump_response(model: PlantModel, w_rad_per_s: Series, dt_s: float) -> ComplexArray:
    """From commanded flow to speed of the centre, without the leak."""
    s = 1j * w_rad_per_s
    return np.asarray(
        model.gain * np.exp(-s * (model.dead_time_s + dt_s / 2)) / (1 + s * model.lag_s)
    )


def compute_controller_response(gains: Gains, w_rad_per_s: Series) -> ComplexArray:
    """From error to commanded flow."""
    s = 1j * w_rad_per_s
    return np.asarray(
        gains.kp_per_s * (1 + 1 / (s * gains.ti_s) + s * gains.td_s) / (1 + s * gains.filter_s)
    )


def compute_loop_response(
    gains: Gains, model: PlantModel, w_rad_per_s: Series, dt_s: float
) -> ComplexArray:
    """L."""
    integrator = 1 / (1j * w_rad_per_s)
    return (
        compute_controller_response(gains, w_rad_per_s)
        * compute_pump_response(model, w_rad_per_s, dt_s)
        * integrator
    )
