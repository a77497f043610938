"""The three settings of the sliders, and the gains that they stand for."""

from __future__ import annotations

from dataclasses import dataclass

from tuning.identification import closed_loop, plant_model
from tuning.proposal import tuning_rules

# Shortest and longest closed-loop time constant that the slider offers, in delays of the plant;
# SIMC recommends 1.
DELAYS = (0.3, 30.0)
# Integral time in closed-loop time constants: 4 is SIMC's, critically damped; 2 oscillates, 16
# forgives much
DAMPINGS = (2.0, 16.0)
FILTERS_S = (0.01, 2.0)


@dataclass(frozen=True, slots=True)
class Sliders:
    """What a person sets."""

    closed_loop_s: float  # time constant wanted of the closed loop
    damping: float  # integral time over (closed-loop time constant + delay)
    filter_s: float

    def make_gains(self, model: plant_model.PlantModel, dt_s: float) -> closed_loop.Gains:
        """Return the gains of a setting: K = 1 / (k (tc + d)), Ti = c (tc + d), SIMC for c = 4
        (Skogestad 2003).

        Parameters
        ----------
        model : PlantModel
            The plant, with its gain k; d is its effective delay.
        dt_s : float
            Period of a tick.
        """
        slowed_s = self.closed_loop_s + tuning_rules.compute_effective_delay_s(
            model, dt_s, self.filter_s
        )
        return closed_loop.Gains(
            1 / (model.gain * slowed_s), self.damping * slowed_s, 0.0, self.filter_s
        )

    def within_reach(self, model: plant_model.PlantModel, dt_s: float) -> Sliders:
        """Return the nearest setting that the sliders offer.

        Parameters
        ----------
        model : PlantModel
            Its delay sets the range of time constants.
        dt_s : float
            Period of a tick.
        """
        low_s, high_s = find_time_constants_s(model, dt_s)
        return Sliders(
            _clip(self.closed_loop_s, low_s, high_s),
            _clip(self.damping, *DAMPINGS),
            _clip(self.filter_s, *FILTERS_S),
        )

    @classmethod
    def place_near(
        cls, gains: closed_loop.Gains, model: plant_model.PlantModel, dt_s: float
    ) -> Sliders:
        """Return the setting that gives some gains, as far as the sliders reach.

        Parameters
        ----------
        gains : Gains
            A derivative term is left out: the sliders have none.
        model : PlantModel
            The plant, with its gain and delay.
        dt_s : float
            Period of a tick.
        """
        # The inverse of `make_gains`: tc + d from K, limited to the slider's range, then c from Ti.
        slowed_s = 1 / (model.gain * max(gains.kp_per_s, 1e-9))
        delay_s = tuning_rules.compute_effective_delay_s(model, dt_s, gains.filter_s)
        within = _clip(slowed_s - delay_s, DELAYS[0] * delay_s, DELAYS[1] * delay_s)
        damping = gains.ti_s / (within + delay_s)
        return cls(within, _clip(damping, *DAMPINGS), gains.filter_s)


def find_time_constants_s(model: plant_model.PlantModel, dt_s: float) -> tuple[float, float]:
    """Return the shortest and the longest closed-loop time constant of the slider, in s.

    Parameters
    ----------
    model : PlantModel
        The plant.
    dt_s : float
        Period of a tick.
    """
    delay_s = tuning_rules.compute_effective_delay_s(model, dt_s, 0.0)
    return DELAYS[0] * delay_s, DELAYS[1] * delay_s


def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)
