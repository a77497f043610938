"""The climate of the simulated room: temperature and humidity, and how they strain film and ring.

The film follows the air within a minute, the ring within hours, the moisture of the film the
humidity within half an hour. What the film is then longer than its ring is a pre-strain below 0 of
a film without pre-strain, solved by the least energy of `stretched_film`.

A lamp warms a patch of the film. Its mean over the mirror moves centre and figure as a temperature
of the whole film would; the rest changes the figure only (`figure_changes`).
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from membrane_ctrl.config.schema import TwinConfig
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.sim.film import NOMINAL_SAG_MM, RADIUS_MM
from membrane_ctrl.sim.gas import REFERENCE_K
from membrane_ctrl.sim.stretched_film import solve_stretched_film

DAY_S = 86_400.0
HVAC_S = 900.0
LAMP_EVERY_S = 3600.0
LAMP_S = 600.0
_ZERO_C_K = 273.15
HUMIDITY_PERCENT = 45.0
# True expansions of the simulated film and ring; the configured ones are those of makers
FILM_PPM_PER_K = 18.5
FILM_PPM_PER_PERCENT = 6.9
RING_PPM_PER_K = 23.4
FILM_FOLLOWS_AIR_S = 60.0
RING_FOLLOWS_AIR_S = 9000.0
FILM_FOLLOWS_HUMIDITY_S = 1800.0
# A patch of 90 mm (1 sigma) that a lamp warms by 1 K is 6.5 % of the area
LAMP_K = 1.0
LAMP_SHARE = 0.065
LAMP_SIGMA_MM = 90.0
LAMP_PLACE_MM = (150.0, 90.0)
POISSON_RATIO = 0.38
_STEP = 2e-5  # of the pre-strain, for the derivative
_THICKNESS_RATIO = 5.0  # of mirror and back film


@dataclass(frozen=True)
class ClimateBlock:
    """The climate in a block of steps; arrays (steps,)."""

    air_k: FloatArray  # deviation of the air
    film_c: FloatArray
    ring_c: FloatArray
    humidity_percent: FloatArray
    excess_ppm: FloatArray
    patch_k: FloatArray  # warming of the middle of a lamp's patch
    mirror_factor: FloatArray  # on sag and volume of the mirror at equal pressure
    back_factor: FloatArray

    def truth_at(self, index: int) -> dict[str, Any]:
        """Fields of `Truth` in one step."""
        return {
            "film_temperature_c": float(self.film_c[index]),
            "ring_temperature_c": float(self.ring_c[index]),
            "humidity_percent": float(self.humidity_percent[index]),
            "excess_strain_ppm": float(self.excess_ppm[index]),
            "patch_k": float(self.patch_k[index]),
        }


class Room:
    """The room of a simulated bench; equal times have equal climates."""

    def __init__(self, twin: TwinConfig) -> None:
        self._kind = twin.climate
        self._phase = 2 * math.pi * float(np.random.default_rng([twin.seed, 5]).random())

    @property
    def is_steady(self) -> bool:
        """Whether the room's climate does not change."""
        return self._kind == "steady"

    def make_block(self, time_s: FloatArray) -> ClimateBlock:
        """The climate at plant times, (steps,)."""
        # The room's waves, and film and ring that follow them.
        zero_c = REFERENCE_K - _ZERO_C_K
        air_k, film_k, ring_k, humidity, moisture = self._waves(time_s)

        # A lamp warms a patch of the film while it is on; the patch cools with the same lag.
        patch_k = np.zeros_like(time_s)
        if self._kind == "lamp":
            lit = time_s % LAMP_EVERY_S
            warming = np.where(
                lit < LAMP_S,
                -np.expm1(-lit / FILM_FOLLOWS_AIR_S),
                np.exp(-(lit - LAMP_S) / FILM_FOLLOWS_AIR_S),
            )
            patch_k = LAMP_K * warming
            film_k = film_k + LAMP_SHARE * patch_k

        # The excess strain of the film over its ring changes the sag at equal pressure (sections 1
        # and 3 of docs/explanation/climate.md).
        film_ppm = FILM_PPM_PER_K * film_k + FILM_PPM_PER_PERCENT * moisture
        excess_ppm = film_ppm - RING_PPM_PER_K * ring_k
        mirror_factor = 1.0 + compute_sag_change_per_ppm() * excess_ppm

        # The back film is thinner: the pressure strains it more, and this therefore less.
        back = compute_sag_change_per_ppm() / _THICKNESS_RATIO ** (2 / 3)
        return ClimateBlock(
            air_k,
            zero_c + film_k,
            zero_c + ring_k,
            HUMIDITY_PERCENT + humidity,
            excess_ppm,
            patch_k,
            mirror_factor,
            1.0 + back * excess_ppm,
        )

    def _waves(
        self, time_s: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Deviations of air, film, ring, humidity and moisture: waves, and what follows them."""
        # Period and amplitudes of the kind.
        period_s = DAY_S
        kelvin = 0.0
        percent = 0.0
        if self._kind == "day":
            kelvin = 2.0
            percent = 10.0
        elif self._kind == "hvac":
            period_s = HVAC_S
            kelvin = 0.5
            percent = -2.0

        # Temperature, and humidity, which over a day has two waves: air is exchanged twice.
        rate = 2 * math.pi / period_s
        angle = 2 * math.pi * time_s / period_s + self._phase
        humid = angle
        humid_rate = rate
        if self._kind == "day":
            humid = angle * 2
            humid_rate = rate * 2

        # What follows a wave with a lag is a smaller and later wave.
        return (
            kelvin * np.cos(angle),
            kelvin * _follow(angle, rate * FILM_FOLLOWS_AIR_S),
            kelvin * _follow(angle, rate * RING_FOLLOWS_AIR_S),
            percent * np.cos(humid),
            percent * _follow(humid, humid_rate * FILM_FOLLOWS_HUMIDITY_S),
        )


def _follow(angle: FloatArray, rate_times_lag: float) -> FloatArray:
    """A cosine behind a lag, settled."""
    return np.asarray(np.cos(angle - math.atan(rate_times_lag)) / math.hypot(1.0, rate_times_lag))


@cache
def compute_sag_change_per_ppm() -> float:
    """Relative change of the sag at equal pressure, for an excess strain of 1e-6."""
    depth = NOMINAL_SAG_MM / RADIUS_MM
    load = {s: solve_stretched_film(depth, s * _STEP, POISSON_RATIO)[0] for s in (-1, 1)}
    deeper = solve_stretched_film(1.001 * depth, 0.0, POISSON_RATIO)[0]
    shallower = solve_stretched_film(0.999 * depth, 0.0, POISSON_RATIO)[0]
    # At equal load: d ln(depth) = -(dq / de) de / (dq / d ln(depth))
    by_strain = (load[1] - load[-1]) / (2 * _STEP)
    by_depth = (deeper - shallower) / 0.002
    return 1e-6 * by_strain / by_depth


@cache
def compute_profile_change_per_ppm() -> FloatArray:
    """Change of the height at equal sag for an excess strain of 1e-6, µm.

    Coefficients (k,) of powers of v = (r / radius)^2. Heights are upward, 0 at vertex and rim.
    """
    depth = NOMINAL_SAG_MM / RADIUS_MM
    heights = []
    for sign in (-1, 1):
        profile = np.array(solve_stretched_film(depth, sign * _STEP, POISSON_RATIO)[1])
        # From 0 at the vertex to 1 at the rim, whatever the profile counts from
        scale = profile.sum() - profile[0]
        profile[0] = 0.0
        heights.append(profile / scale)
    return np.asarray(1e3 * NOMINAL_SAG_MM * (heights[0] - heights[1]) / (2 * _STEP) * 1e-6)
