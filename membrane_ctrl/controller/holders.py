"""The estimate of the centre in the loop: what it gets, when it holds the mirror, which sensors it follows."""

import math
from collections.abc import Collection

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.control import inner_loop
from membrane_ctrl.control.centre import LOCK_FRAMES, CentreFilter
from membrane_ctrl.control.centre_estimate import CentreEstimate, CentreReadings, Sensor
from membrane_ctrl.controller.scene import Scene
from membrane_ctrl.controller.sensor_consistency import SensorConsistency
from membrane_ctrl.controller.tick import TickInputs
from membrane_ctrl.model.events import Event, HeldBy
from membrane_ctrl.model.states import ShapeState, State

# in `inflate` the film's gain may still be another one
_ESTIMATED = frozenset({State.SETTLE, State.HOLD, State.MANUAL, State.TUNE})
_STANDS_S = 1.0  # a sensor that comes and goes within this is not reported


class Holders:
    """Runs the estimate beside the states if `estimator.process_value` asks for it."""

    def __init__(self, config: Config) -> None:
        self._wanted = config.estimator.process_value == "estimate"
        self._filter = CentreFilter(config.estimator, config.loop)
        self._running = self._locking = False
        self._told: tuple[int, ...] | None = None
        self._news_s = math.nan
        self.estimate: CentreEstimate | None = None

    @property
    def optics_hold(self) -> bool:
        """Whether the mirror is held without a laser: the optics see it."""
        return self.estimate is not None and self._filter.frames >= LOCK_FRAMES and self._sees(Sensor.OPTICS)

    def set_gains(self, loop: LoopConfig) -> None:
        """Take the feed-forward's gains from other settings."""
        self._filter.set_gains(loop)

    def step(
        self,
        inputs: TickInputs,
        state: State,
        scene: Scene,
        last: inner_loop.LoopOutput,
        shape: ShapeState,
        consistency: SensorConsistency,
    ) -> list[Event]:
        """One tick, after the sensors were judged; returns what is news."""
        flow_um_per_s, laser_um = last.flow_um_per_s, scene.observer.displacement_um
        if not self._wanted or state not in _ESTIMATED or not math.isfinite(flow_um_per_s):
            self.estimate, self._running, self._told = None, False, None
            return []
        if consistency.laser_lies:
            laser_um = math.nan
        if not self._running:
            start_um = last.filtered_um if math.isfinite(last.filtered_um) else laser_um
            if not math.isfinite(start_um):
                return []
            self._filter.start(start_um, scene.loop.mean_flow_um_per_s, scene.trim_um)
            self._running = True
        if shape == ShapeState.OFF:
            self._locking = True
        elif self._locking:
            self._filter.relock()
            self._locking = False
        figure = inputs.estimate
        if shape == ShapeState.OFF or consistency.camera_lies or (figure and figure.verdict == "rejected"):
            figure = None
        reading = inputs.reading
        readings = CentreReadings(
            now_s=inputs.now_s,
            flow_um_per_s=flow_um_per_s,
            laser_um=laser_um,
            ambient_pressure_pa=reading.ambient_pressure_pa if reading else math.nan,
            air_temperature_c=reading.air_temperature_c if reading else math.nan,
            sag_um=figure.sag_um if figure else math.nan,
            sag_sigma_um=figure.sag_sigma_um if figure else math.nan,
            sag_time_s=figure.time_s if figure else math.nan,
        )
        self.estimate = self._filter.step(readings, scene.dt_s)
        scene.trim_um = self.estimate.mount_um
        return self._news(inputs.now_s, self.estimate.jumped)

    def _sees(self, sensor: Sensor) -> bool:
        return self.estimate is not None and self.estimate.sensors[sensor].fresh

    def _news(self, now_s: float, jumped: Collection[str]) -> list[Event]:
        """Report the sensors once they have stood for a second, and every jump."""
        seeing = tuple(int(sensor) for sensor in Sensor if self._sees(sensor))
        if seeing == self._told:
            self._news_s = math.nan
        elif math.isnan(self._news_s):
            self._news_s = now_s
        stands = not math.isnan(self._news_s) and now_s - self._news_s >= _STANDS_S
        if not stands and not jumped:
            return []
        self._told, self._news_s = seeing, math.nan
        return [HeldBy(", ".join(Sensor(n).name.lower() for n in seeing), ", ".join(jumped))]
