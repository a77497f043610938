"""What the measured climate explains of a difference between displacement and gauge. Pure.

At equal pressure a film that is strained by e above its ring is deeper by

    dw = CHANGE_CENTRE e a^2 / sag,      e = e_heat + e_water - e_ring

so a room whose climate changes moves the gauge against laser and optics, and no sensor is wrong.
The comparisons (`film_monitor`) look at changes ahead of a reference that follows slowly. So must
the strains: each part is counted ahead of the same reference, a high-pass with its time constant.

The climate explains and never accuses: a difference counts from the nearest end of the range
between 0 and what the strains explain, widened by the error of their coefficients. A wrong
thermometer can therefore end no hold. What it can hide is bounded (`MINUTES_MOST_UM`,
`HOUR_MOST_UM`). A part without a fresh sensor adds nothing; what it had explained before fades with
the reference, until the comparison is that of a bench without climate sensors.
"""

import math
from dataclasses import dataclass

from membrane_ctrl.config.climate import ClimateConfig
from membrane_ctrl.config.schema import MirrorConfig
from membrane_ctrl.control.climate import CHANGE_CENTRE, RING_SIGMA, StrainParts
from membrane_ctrl.control.filters import lag_step_fraction
from membrane_ctrl.model.state_tree import StateNode

# Most that the climate may explain, and so most that a wrong climate sensor may hide beyond the
# limit. An air conditioner of +-0.5 K each quarter of an hour moves the film of the paper by 18 µm
# ahead of a reference of two minutes (the twin's `hvac`), one of +-0.8 K by 30 µm.
MINUTES_MOST_UM = 30.0
# A day of +-2 K whose humidity of +-10 % changes twice moves it by 122 µm ahead of a reference of
# an hour (the twin's `day`).
HOUR_MOST_UM = 120.0
# The limit of a day contains a day's climate already (`limits.laser_gauge_day_max_um`).
DAY_MOST_UM = 0.0
_SIGMAS = 2.0


@dataclass(slots=True)
class StrainAhead(StateNode):
    """Strains ahead of a reference that follows them, in 1e-6."""

    heat_ppm: float = 0.0
    water_ppm: float = 0.0
    ring_ppm: float = 0.0

    def follow(self, gained: StrainParts, dt_s: float, follow_s: float) -> None:
        """Add what the strains have gained since the last tick; the reference follows.

        Parameters
        ----------
        gained : StrainParts
            Finite.
        dt_s : float
            Since the last tick.
        follow_s : float
            Time constant of the reference.
        """
        kept = 1.0 - lag_step_fraction(dt_s, follow_s)
        self.heat_ppm = kept * (self.heat_ppm + gained.heat_ppm)
        self.water_ppm = kept * (self.water_ppm + gained.water_ppm)
        self.ring_ppm = kept * (self.ring_ppm + gained.ring_ppm)


@dataclass(frozen=True, slots=True)
class ClimateAllowance:
    """By how much the climate may move displacement and gauge apart.

    Attributes
    ----------
    um_per_ppm : float
        Rise of the displacement at equal pressure for an excess strain of 1e-6.
    film_sigma : float
        Share by which the film's expansions may be wrong, 1 sigma.
    most_um : float
        Bound of the allowance.
    """

    um_per_ppm: float
    film_sigma: float
    most_um: float

    @classmethod
    def from_config(
        cls, mirror: MirrorConfig, climate: ClimateConfig, most_um: float
    ) -> "ClimateAllowance":
        """Return that of a mirror's film."""
        um_per_ppm = 1e-3 * CHANGE_CENTRE * mirror.radius_mm**2 / mirror.sag_mm
        return cls(um_per_ppm, climate.film_sigma_relative, most_um)

    def explain_um(self, ahead: StrainAhead) -> float:
        """Return the expected displacement beyond that of the gauge, without bound."""
        excess_ppm = ahead.heat_ppm + ahead.water_ppm - ahead.ring_ppm
        return self.um_per_ppm * excess_ppm

    def find_range(self, ahead: StrainAhead) -> tuple[float, float]:
        """Return the lowest and highest displacement beyond that of the gauge, µm; 0 is between.

        Parameters
        ----------
        ahead : StrainAhead
            Strains ahead of the comparison's reference.
        """
        explained_um = self.explain_um(ahead)
        sigma_ppm = math.hypot(
            self.film_sigma * ahead.heat_ppm,
            self.film_sigma * ahead.water_ppm,
            RING_SIGMA * ahead.ring_ppm,
        )
        margin_um = _SIGMAS * self.um_per_ppm * sigma_ppm
        low_um = max(min(explained_um - margin_um, 0.0), -self.most_um)
        high_um = min(max(explained_um + margin_um, 0.0), self.most_um)
        return low_um, high_um


def find_distance(value: float, between: tuple[float, float]) -> float:
    """Return the distance of a value from the nearest point of a range; 0 inside it."""
    return max(between[0] - value, value - between[1], 0.0)


def find_gain(now: StrainParts, before: StrainParts) -> StrainParts:
    """Return by how much each part has grown; 0 for a part that is not known at both times."""
    return StrainParts(
        _subtract_known(now.heat_ppm, before.heat_ppm),
        _subtract_known(now.water_ppm, before.water_ppm),
        _subtract_known(now.ring_ppm, before.ring_ppm),
    )


def _subtract_known(now: float, before: float) -> float:
    difference = now - before
    if math.isfinite(difference):
        return difference
    return 0.0
