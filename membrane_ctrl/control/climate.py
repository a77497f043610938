"""Strains of film and ring by temperature and humidity. Pure.

    strain of the film   s_f = a_f T_film + b m       dm/dt = (H - m) / T_m
    strain of the ring   s_r = a_r T_ring
    excess               e = s_f - s_r, less that at the reference

T_film, T_ring and the moisture m (as the relative humidity at which the film would be in balance)
are the states. Each follows its sensor; without one the film follows the air, the ring the air with
a lag, and the moisture stays. What is not measured makes the error larger with time.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.config.climate import ClimateConfig
from membrane_ctrl.control.filters import LowPass, lag_step_fraction
from membrane_ctrl.model.state_tree import StateNode

# Change of the height at equal sag for an excess strain e, by e a^2 / sag: RMS over the mirror, and
# Noll 11 (`metrology.film.climate_figure`, Poisson's ratio 0.38)
CHANGE_RMS = 0.030539
CHANGE_SPHERICAL = 0.012199
# The same, RMS, for a patch of 0.18 radii (1 sigma) that is strained alone, mean over its places
# (`sim.warm_patch`: 1.6 to 2.1 µm for 1 K of the paper's film)
CHANGE_PATCH = 0.0150
# Rise of the centre at equal pressure for an excess strain e, by e a^2 / sag (the same law)
CHANGE_CENTRE = 0.51226
# Noise of a thermometer or hygrometer is no change of the film. Laser and gauge, whose comparison
# uses the strains, are smoothed equally (`film_monitor`).
_SMOOTH_S = 10.0
# A slow instrument may miss minutes. A state that is unseen for longer is not fresh.
_FRESH_S = 300.0
# Without its sensor a state wanders by this, 1 sigma, in the square root of an hour, and by at most
# a room's daily change (assumed)
_WANDER_K = 0.5
_WANDER_PERCENT = 3.0
_WANDER_LIMIT_H = 12.0
# A film without a thermometer is as warm as the air, but for the light that it absorbs (assumed)
_FILM_AS_AIR_K = 0.3
# A ring without a thermometer is as warm as the air behind its lag (assumed)
_RING_AS_AIR_K = 0.5
# The ring's expansion is that of a metal, known to (assumed)
RING_SIGMA = 0.03


@dataclass(frozen=True, slots=True)
class ClimateReadings:
    """Usable readings of one tick; NaN for missing ones."""

    film_c: float
    ring_c: float
    humidity_percent: float
    air_c: float


@dataclass(frozen=True, slots=True)
class ClimateStrain(StateNode):
    """Strains since the reference, in 1e-6.

    Attributes
    ----------
    film_ppm, ring_ppm : float
        NaN as long as no reading shows them.
    excess_ppm, sigma_ppm : float
        Strain of the film above that of the ring, and its standard deviation.
    """

    film_ppm: float = math.nan
    ring_ppm: float = math.nan
    excess_ppm: float = math.nan
    sigma_ppm: float = math.nan


@dataclass(frozen=True, slots=True)
class StrainParts(StateNode):
    """Strains by their causes, in 1e-6, from an arbitrary zero; NaN for one that no fresh sensor
    shows.

    Attributes
    ----------
    heat_ppm, water_ppm : float
        Of the film.
    ring_ppm : float
    """

    heat_ppm: float = math.nan
    water_ppm: float = math.nan
    ring_ppm: float = math.nan


@dataclass(slots=True)
class FollowedState(StateNode):
    """A temperature or the moisture: its value, at the reference, and how long it is unseen."""

    value: LowPass = field(default_factory=LowPass)
    reference: float = math.nan
    unseen_s: float = 0.0
    shift: float = 0.0  # steps of the value that another sensor made, not the climate
    # Share of the error of the first value that remains, now and at the reference
    start_share: float = 1.0
    start_share_at_reference: float = 1.0

    def follow(self, reading: float, dt_s: float, lag_s: float) -> None:
        """Follow a reading; NaN leaves the value and counts the time."""
        if not math.isfinite(reading):
            self.unseen_s += dt_s
            return
        # A reading stands for the time since the last one: a slow instrument is smoothed no more
        # than a fast one, and the film has followed the humidity in a gap.
        if math.isfinite(self.value.value):
            dt_s += self.unseen_s
        self.value.update(reading, dt_s, lag_s)
        self.start_share *= 1.0 - lag_step_fraction(dt_s, lag_s)
        self.unseen_s = 0.0

    def change_source(self, reading: float) -> None:
        """Go on with another sensor: by how much the two differ is no change of the climate."""
        if math.isnan(self.value.value):
            return
        step = reading - self.value.value
        self.value.reset(reading)
        self.reference += step
        self.shift += step

    def set_reference(self) -> None:
        """Count changes from the present value."""
        self.reference = self.value.value
        self.start_share_at_reference = self.start_share

    @property
    def fresh_value(self) -> float:
        """The value, from an arbitrary zero; NaN if no sensor has shown it for minutes."""
        if self.unseen_s > _FRESH_S:
            return math.nan
        return self.value.value - self.shift

    @property
    def start_error(self) -> float:
        """Share of the first value's error that has entered the change since the reference."""
        return self.start_share_at_reference - self.start_share

    @property
    def change(self) -> float:
        """Since the reference; 0 while the state is unknown."""
        if math.isnan(self.value.value) or math.isnan(self.reference):
            return 0.0
        return self.value.value - self.reference


@dataclass(slots=True)
class ClimateState(StateNode):
    """What the estimate of the strains remembers."""

    film: FollowedState = field(default_factory=FollowedState)
    ring: FollowedState = field(default_factory=FollowedState)
    moisture: FollowedState = field(default_factory=FollowedState)
    has_film_sensor: bool = False
    has_ring_sensor: bool = False
    ring_unseen_s: float = 0.0  # by its own sensor


class Climate:
    """Follows the strains, tick by tick."""

    def __init__(self, config: ClimateConfig, memory: ClimateState | None = None) -> None:
        self._config = config
        self.memory = memory or ClimateState()

    def set_reference(self) -> None:
        """From now on the strains count from the present ones."""
        memory = self.memory
        for state in (memory.film, memory.ring, memory.moisture):
            state.set_reference()

    def step(self, given: ClimateReadings, dt_s: float) -> ClimateStrain:
        """Follow the readings of one tick.

        Parameters
        ----------
        given : ClimateReadings
            Those that may be used; NaN without one.
        dt_s : float
            Since the last tick, above 0.

        Returns
        -------
        ClimateStrain
        """
        memory, config = self.memory, self._config
        self._follow_film(given, dt_s)
        self._follow_ring(given, dt_s)
        memory.moisture.follow(given.humidity_percent, dt_s, config.film_follows_humidity_s)
        # A state that is seen for the first time is its own reference
        for state in (memory.film, memory.ring, memory.moisture):
            if math.isnan(state.reference):
                state.set_reference()
        return self._make_strain()

    def _follow_film(self, given: ClimateReadings, dt_s: float) -> None:
        """Follow the film's sensor; a film that never had one has the air's temperature at once."""
        # A bench that ever had a film sensor does not fall back to the air: that would be a step
        memory = self.memory
        film_c = given.film_c
        if math.isfinite(film_c) and not memory.has_film_sensor:
            memory.film.change_source(film_c)
            memory.has_film_sensor = True
        if not memory.has_film_sensor:
            film_c = given.air_c
        memory.film.follow(film_c, dt_s, _SMOOTH_S)

    def _follow_ring(self, given: ClimateReadings, dt_s: float) -> None:
        """Follow the ring's sensor; a ring that no sensor has shown for minutes follows the air
        slowly.
        """
        memory = self.memory
        if math.isfinite(given.ring_c):
            if not memory.has_ring_sensor:
                memory.ring.change_source(given.ring_c)
                memory.has_ring_sensor = True
            elif not self._sees_ring:
                memory.ring.value.reset(given.ring_c)
            memory.ring_unseen_s = 0.0
            memory.ring.follow(given.ring_c, dt_s, _SMOOTH_S)
            return
        memory.ring_unseen_s += dt_s
        if self._sees_ring:
            memory.ring.follow(math.nan, dt_s, _SMOOTH_S)
        else:
            memory.ring.follow(given.air_c, dt_s, self._config.ring_follows_air_s)

    @property
    def _sees_ring(self) -> bool:
        """Whether the ring's own sensor has shown it within minutes."""
        return self.memory.has_ring_sensor and self.memory.ring_unseen_s <= _FRESH_S

    @property
    def fresh_parts(self) -> StrainParts:
        """Strains by their causes, as far as fresh sensors show them."""
        memory, config = self.memory, self._config
        ring_c = memory.ring.fresh_value
        # The air predicts the ring of a bench that has lost its sensor, but excuses nothing
        if memory.has_ring_sensor and not self._sees_ring:
            ring_c = math.nan
        return StrainParts(
            config.film_ppm_per_k * memory.film.fresh_value,
            config.film_ppm_per_percent * memory.moisture.fresh_value,
            config.ring_ppm_per_k * ring_c,
        )

    def _make_strain(self) -> ClimateStrain:
        """Strains of film and ring since the reference, and the error of their difference."""
        memory, config = self.memory, self._config
        if math.isnan(memory.film.value.value) and math.isnan(memory.moisture.value.value):
            return ClimateStrain()
        # Strains by heat and by water since the lock.
        by_heat_ppm = config.film_ppm_per_k * memory.film.change
        by_water_ppm = config.film_ppm_per_percent * memory.moisture.change
        ring_ppm = config.ring_ppm_per_k * memory.ring.change
        # Temperatures may have wandered where no sensor shows them.
        film_k = _wander(_WANDER_K, memory.film.unseen_s)
        if not memory.has_film_sensor:
            film_k = math.hypot(film_k, _FILM_AS_AIR_K)
        ring_k = _wander(_WANDER_K, memory.ring.unseen_s)
        if not self._sees_ring:
            ring_k = math.hypot(ring_k, _RING_AS_AIR_K)
        # Independent errors: of the expansions, of unseen changes, of the start.
        parts = (
            config.film_sigma_relative * by_heat_ppm,
            config.film_sigma_relative * by_water_ppm,
            RING_SIGMA * ring_ppm,
            config.film_ppm_per_k * film_k,
            config.ring_ppm_per_k * ring_k,
            config.film_ppm_per_percent * _wander(_WANDER_PERCENT, memory.moisture.unseen_s),
            config.film_ppm_per_percent * _WANDER_PERCENT * memory.moisture.start_error,
        )
        film_ppm = by_heat_ppm + by_water_ppm
        return ClimateStrain(film_ppm, ring_ppm, film_ppm - ring_ppm, math.hypot(*parts))


def _wander(per_root_hour: float, unseen_s: float) -> float:
    """Standard deviation of a state that no sensor has shown for a time."""
    return per_root_hour * math.sqrt(min(unseen_s / 3600.0, _WANDER_LIMIT_H))
