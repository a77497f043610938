"""Predicts from temperature and humidity how the figure changes, and reports when that matters."""

import math
from dataclasses import dataclass, field

from firmware_iface.roles import BenchReading
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control import weather_limits
from membrane_ctrl.control.climate import (
    CHANGE_PATCH,
    CHANGE_RMS,
    CHANGE_SPHERICAL,
    Climate,
    ClimateReadings,
    ClimateState,
    ClimateStrain,
    StrainParts,
)
from membrane_ctrl.control.climate_sensors import (
    ClimateSensor,
    ClimateSensors,
    ClimateSensorsState,
)
from membrane_ctrl.model.events import Event, Maintenance, MaintenanceOver
from membrane_ctrl.model.state_tree import StateNode
from membrane_ctrl.model.telemetry import State

FIGURE_NOTICE = "climate_figure"
_SENSOR_NOTICES = {
    ClimateSensor.FILM: "film_thermometer",
    ClimateSensor.RING: "ring_thermometer",
    ClimateSensor.HUMIDITY: "hygrometer",
}
# The notice ends only when the figure is clearly nearer again
_OVER_SHARE = 0.8


@dataclass(slots=True)
class ClimatePartState(StateNode):
    """What the prediction remembers."""

    sensors: ClimateSensorsState = field(default_factory=ClimateSensorsState)
    climate: ClimateState = field(default_factory=ClimateState)
    strain: ClimateStrain = field(default_factory=ClimateStrain)
    referred: bool = False  # the strains count from the begin of the hold
    reported: bool = False


class ClimatePart:
    """Follows the climate beside the states; commands nothing."""

    def __init__(self, config: Config, memory: ClimatePartState | None = None) -> None:
        self.memory = memory or ClimatePartState()
        mirror = config.optics.mirror
        # For a strain of 1e-6
        unit_um = 1e-3 * mirror.radius_mm**2 / mirror.sag_mm
        self._rms_um_per_ppm = CHANGE_RMS * unit_um
        self._spherical_um_per_ppm = CHANGE_SPHERICAL * unit_um
        # By patches that no thermometer shows
        patch_ppm = config.climate.film_ppm_per_k * config.climate.uneven_k
        self._uneven_um = CHANGE_PATCH * unit_um * patch_ppm
        self._most_um = config.climate.figure_max_um
        self._sensors = ClimateSensors(self.memory.sensors)
        self._climate = Climate(config.climate, self.memory.climate)

    @property
    def figure_um(self) -> float:
        """Predicted change of the figure since the begin of the hold, RMS; NaN if unknown."""
        return abs(self.memory.strain.excess_ppm) * self._rms_um_per_ppm

    @property
    def sigma_um(self) -> float:
        """Standard deviation of that, with what an uneven temperature of the film adds."""
        by_strain_um = self.memory.strain.sigma_ppm * self._rms_um_per_ppm
        return math.hypot(by_strain_um, self._uneven_um)

    @property
    def fresh_strains(self) -> StrainParts:
        """Strains by their causes, as far as fresh sensors show them; all NaN while no climate
        sensor does: the air thermometer alone explains nothing.
        """
        if not self._sensors.any_fresh:
            return StrainParts()
        return self._climate.fresh_parts

    @property
    def _has_sensors(self) -> bool:
        """Whether a film or ring thermometer or a hygrometer has ever given a value."""
        return any(math.isfinite(watch.value) for watch in self.memory.sensors.watches)

    def step(self, reading: BenchReading | None, state: State, dt_s: float) -> list[Event]:
        """Follow one tick; returns the events.

        Parameters
        ----------
        reading : BenchReading or None
            None in a tick without an answer: nothing changes.
        state : State
            The strains count from the moment at which `hold` begins.
        dt_s : float
            Since the last tick.
        """
        if reading is None:
            return []
        events: list[Event] = []
        values = {
            ClimateSensor.FILM: reading.film_temperature_c,
            ClimateSensor.RING: reading.ring_temperature_c,
            ClimateSensor.HUMIDITY: reading.humidity_percent,
        }
        usable: dict[ClimateSensor, float] = {}
        for sensor, value in values.items():
            usable[sensor], news = self._sensors.judge(sensor, value, dt_s)
            if news is not None:
                events.append(_report_sensor(sensor, news))
        # A bench without any of these sensors predicts nothing
        if not self._has_sensors:
            return events
        _, air_c = weather_limits.discard_impossible_weather(math.nan, reading.air_temperature_c)
        readings = ClimateReadings(
            usable[ClimateSensor.FILM],
            usable[ClimateSensor.RING],
            usable[ClimateSensor.HUMIDITY],
            air_c,
        )
        self.memory.strain = self._climate.step(readings, dt_s)
        # The strains count from the beginning of each hold; an experiment does not end it
        held = state == State.HOLD
        if held and not self.memory.referred:
            self._climate.set_reference()
        self.memory.referred = held or (self.memory.referred and state == State.TUNE)
        return events + self._report_figure()

    def telemetry(self) -> dict[str, float]:
        """Columns of a telemetry row; none while no sensor shows the climate."""
        strain = self.memory.strain
        if not math.isfinite(strain.excess_ppm):
            return {}
        return {
            "film_strain_ppm": strain.film_ppm,
            "ring_strain_ppm": strain.ring_ppm,
            "climate_figure_um": self.figure_um,
            "climate_sigma_um": self.sigma_um,
        }

    def _report_figure(self) -> list[Event]:
        """Open or close the notice of a figure that the climate has changed beyond the limit."""
        # It ends at a smaller change than it begins with
        memory = self.memory
        share = _OVER_SHARE if memory.reported else 1.0
        beyond = memory.referred and self.figure_um > share * self._most_um
        if beyond == memory.reported:
            return []
        memory.reported = beyond
        strain = memory.strain
        if not beyond:
            message = f"the figure is predicted to be {self.figure_um:.1f} µm RMS from its first"
            return [MaintenanceOver(FIGURE_NOTICE, message)]
        spherical_um = abs(strain.excess_ppm) * self._spherical_um_per_ppm
        message = (
            f"the film is {strain.excess_ppm:+.0f} +- {strain.sigma_ppm:.0f} ppm longer than its "
            "ring since the hold began: the figure is predicted to have changed by "
            f"{self.figure_um:.1f} +- {self.sigma_um:.1f} µm RMS, {spherical_um:.1f} µm of it "
            "spherical, however well the centre is held. Keep temperature and humidity steady, or "
            "measure a new reference"
        )
        return [Maintenance(FIGURE_NOTICE, message)]


def _report_sensor(sensor: ClimateSensor, fault: str) -> Event:
    name = _SENSOR_NOTICES[sensor]
    if fault:
        return Maintenance(
            name, f"{fault}; prediction of the figure and comparison with the gauge do without it"
        )
    return MaintenanceOver(name, "the sensor is back")
