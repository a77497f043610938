"""Runs the estimate of the centre beside the states, if `estimator.process_value` requires it."""

import math
from collections.abc import Collection
from dataclasses import dataclass, field, replace

from membrane_ctrl.config.schema import Config, EstimatorConfig, LoopConfig
from membrane_ctrl.control import (
    camera_mount,
    inner_loop,
    weather_limits,
)
from membrane_ctrl.control.camera_mount import CameraMountGrowth
from membrane_ctrl.control.centre import LOCK_FRAMES, CentreFilter, CentreState
from membrane_ctrl.control.centre_estimate import CentreEstimate, CentreReadings, Sensor
from membrane_ctrl.control.filters import LowPass
from membrane_ctrl.control.plausibility import (
    REFERENCE_S,
    SLOW_REFERENCE_S,
)
from membrane_ctrl.controller import state_sets
from membrane_ctrl.controller.mount_drift import MountDrift, MountDriftState
from membrane_ctrl.controller.sensor_consistency import SensorConsistency
from membrane_ctrl.controller.tick import TickInputs
from membrane_ctrl.controller.tick_context import TickContext
from membrane_ctrl.model.events import (
    Event,
    Maintenance,
    MaintenanceOver,
    SensorsUsed,
)
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.state_tree import StateNode
from membrane_ctrl.model.telemetry import ShapeState, State

# Share of the band: a growth of the camera mount that may be this large is reported
_MOUNT_SHARE = 0.25
# a sensor that comes and goes within this, as a slower camera does at first, is not reported
_STANDS_S = 1.5
# So long may the estimate be held by pump, gas and weather alone, beyond the time in which a sensor
# counts as fresh: a start without a figure yet. At the pump's full flow the film moves by 5 µm.
_BLIND_S = 1.0


@dataclass(slots=True)
class CentreEstimationState(StateNode):
    """What the estimate remembers from tick to tick."""

    centre: CentreState | None = None  # None while the estimate does not run
    locking: bool = False
    # Means of the mount while laser and camera agree: what the filter gave to the mount after that
    # was the film's. The slow one serves if a slow drift of the camera is to be undone.
    agreed_mount: LowPass = field(default_factory=LowPass)
    slowly_agreed_mount: LowPass = field(default_factory=LowPass)
    mount_drift: MountDriftState = field(default_factory=MountDriftState)
    mount_growth: camera_mount.CameraMountState = field(
        default_factory=camera_mount.CameraMountState
    )
    mount_growth_reported: bool = False
    reported_sensors: tuple[int, ...] | None = None  # the sensors, as reported
    sensors_changed_s: float = math.nan
    estimate: CentreEstimate | None = None
    blind_since_s: float = math.nan  # the estimate follows neither laser nor optics since then
    blind: bool = False  # it has done so for too long


class CentreEstimation:
    """Runs the estimate beside the states if `estimator.process_value` requires it."""

    def __init__(self, config: Config, memory: CentreEstimationState | None = None) -> None:
        self.memory = memory or CentreEstimationState()
        self._config = config.estimator
        self._loop = config.loop
        self._wanted = config.estimates_centre
        self._by_optics = config.by_optics
        self._sag_zero_um = 1e3 * config.optics.mirror.sag_mm if config.by_optics else math.nan
        centre = self.memory.centre
        self._filter = (
            None if centre is None else CentreFilter(config.estimator, config.loop, centre)
        )
        self._tracks = config.shape.mode == "track"
        self._mount_drift = MountDrift(config.shape, self.memory.mount_drift)
        self._camera_mount = CameraMountGrowth(config.estimator, self.memory.mount_growth)
        self._mount_growth_max_um = _MOUNT_SHARE * config.limits.band_um

    @property
    def estimate(self) -> CentreEstimate | None:
        """The newest estimate; None while it does not run."""
        return self.memory.estimate

    @property
    def held_by_optics(self) -> bool:
        """Whether the mirror is held without a laser: the optics see it."""
        if self.memory.estimate is None or self._filter is None:
            return False
        return self._filter.frames >= LOCK_FRAMES and self._follows_sensor(Sensor.OPTICS)

    @property
    def blind(self) -> bool:
        """Whether the estimate has followed neither laser nor optics for a second: it then only
        predicts the centre by pump and weather, and nothing may be held by it.
        """
        return self.memory.blind

    @property
    def optics_left_out(self) -> bool:
        """Whether figures are not used until a person accepts the optics again."""
        return self._mount_drift.beyond_limit

    def set_gains(self, loop: LoopConfig) -> None:
        """Take the feed-forward's gains from other settings."""
        self._loop = loop
        if self._filter is not None:
            self._filter.set_gains(loop)

    def set_estimator(self, config: EstimatorConfig) -> None:
        """Take the settings of the estimates that begin from now on."""
        self._config = config

    def step(
        self,
        inputs: TickInputs,
        state: State,
        context: TickContext,
        last: inner_loop.LoopOutput,
        shape: ShapeState,
        consistency: SensorConsistency,
    ) -> list[Event]:
        """Run one tick, after the sensors were judged.

        Parameters
        ----------
        inputs : TickInputs
            Readings of the tick.
        state : State
            Of the controller.
        context : TickContext
            Observer, figure and command of the tick.
        last : LoopOutput
            What the loop put out in the tick before: the flow since then.
        shape : ShapeState
            Of the shape loop.
        consistency : SensorConsistency
            Which sensors are to be left out.

        Returns
        -------
        list of Event
            What has changed: sensors in use, jumps, a choice of the process value.
        """
        # Only while the mirror is held or moved: elsewhere the flow does not explain the motion
        flow_um_per_s, seen_um = last.flow_um_per_s, context.observer.displacement_um
        figures = context.observer.figures
        is_moved = state in state_sets.ESTIMATED or context.config.states.observe
        if not self._wanted or not is_moved or not math.isfinite(flow_um_per_s):
            self._stop_estimate()
            if self._by_optics and state not in state_sets.MOVING:
                self._mount_drift.start(0.0)  # a resumed hold judges the optics by itself
            return []
        laser_um = math.nan if consistency.laser_fault_text else context.observer.moving_laser_um
        # Start at the best displacement known; without one, wait
        if self._filter is None:
            start_um = last.filtered_um if math.isfinite(last.filtered_um) else seen_um
            if not math.isfinite(start_um):
                return []
            self._filter = self._start_estimate(start_um, context)
        if self._is_anchor(inputs.estimate):
            # another anchor shows the same film up to a micrometre higher or lower
            self._filter.relock()
        # Which figure, if any, the filter may use in this tick
        figure = self._select_figure(
            self._filter, figures.accepted, context.dt_s, shape, consistency
        )
        reading = inputs.reading
        # A camera mount that grows with temperature changes the measured sag
        self._camera_mount.step(
            weather_limits.discard_impossible_weather(math.nan, reading.air_temperature_c)[1]
            if reading
            else math.nan,
            context.dt_s,
        )
        if self._filter.frames < LOCK_FRAMES:
            self._camera_mount.lock()
        # Predict, then correct with each sensor that has a new value
        readings = CentreReadings(
            now_s=inputs.now_s,
            flow_um_per_s=flow_um_per_s,
            laser_um=laser_um,
            ambient_pressure_pa=reading.ambient_pressure_pa if reading else math.nan,
            air_temperature_c=reading.air_temperature_c if reading else math.nan,
            sag_um=figure.sag_um - self._camera_mount.um if figure else math.nan,
            sag_change_sigma_um=figure.sag_change_sigma_um if figure else math.nan,
            sag_time_s=figure.time_s if figure else math.nan,
            judged=consistency.compares_sensors,
        )
        self.memory.estimate = estimate = self._filter.step(readings, context.dt_s)
        self._note_blindness(inputs.now_s)
        context.trim_um = estimate.mount_um
        # Report what has changed: sensors in use, growth of the camera's mount, drift of the
        # laser's mount
        events = [
            *self._report_sensors_in_use(inputs.now_s, estimate.jumped),
            *self._report_mount_growth(),
        ]
        events += self._mount_drift.step(
            estimate.mount_um,
            estimate.jumped_sensors,
            inputs.now_s,
            context.dt_s,
            has_laser=self._follows_sensor(Sensor.LASER),
        )
        # The error of the mount's growth is common to all figures: no averaging reduces it
        if self._follows_sensor(Sensor.OPTICS):
            sigma_um = math.hypot(estimate.sigma_um, self._camera_mount.sigma_um)
            self.memory.estimate = replace(estimate, sigma_um=sigma_um)
        return events

    def _stop_estimate(self) -> None:
        self._filter = None
        self.memory.centre = None
        self.memory.estimate = None
        self.memory.reported_sensors = None
        self.memory.blind_since_s = math.nan
        self.memory.blind = False

    def _note_blindness(self, now_s: float) -> None:
        """Note since when neither laser nor optics correct the estimate."""
        memory = self.memory
        if self._follows_sensor(Sensor.LASER) or self._follows_sensor(Sensor.OPTICS):
            memory.blind_since_s = math.nan
        elif math.isnan(memory.blind_since_s):
            memory.blind_since_s = now_s
        # false while `blind_since_s` is NaN
        memory.blind = now_s - memory.blind_since_s > _BLIND_S

    def _start_estimate(self, start_um: float, context: TickContext) -> CentreFilter:
        """Begin an estimate at a displacement."""
        memory = self.memory
        memory.centre = CentreState()
        begun = CentreFilter(self._config, self._loop, memory.centre)
        begun.start(
            start_um,
            context.loop.mean_flow_um_per_s,
            context.trim_um,
            self._find_sag_zero_um(context),
        )
        memory.agreed_mount.reset(context.trim_um)
        memory.slowly_agreed_mount.reset(context.trim_um)
        self._mount_drift.start(context.trim_um)
        self._camera_mount.lock()
        return begun

    def _find_sag_zero_um(self, context: TickContext) -> float:
        """Sag at true centre 0, where the optics replace the laser; NaN where they are to be
        locked.
        """
        if self._by_optics:
            return self._sag_zero_um
        observer = context.observer
        return (
            observer.figures.zero_um + context.trim_um
            if observer.optics_replace_laser
            else math.nan
        )

    def _is_anchor(self, figure: ShapeEstimate | None) -> bool:
        """Whether a figure is a full set that the tracking's next frames count from."""
        return (
            figure is not None
            and self._tracks
            and figure.kind == "full"
            and figure.verdict != "rejected"
        )

    def _select_figure(
        self,
        centre: CentreFilter,
        figure: ShapeEstimate | None,
        dt_s: float,
        shape: ShapeState,
        consistency: SensorConsistency,
    ) -> ShapeEstimate | None:
        """The tick's figure if the filter may use it; locks the filter again where its reference
        ended.
        """
        memory = self.memory
        # A shape loop that is switched on again has another reference.
        off = shape == ShapeState.OFF and not self._by_optics
        if memory.locking and not off:
            centre.relock()
            self._mount_drift.start(memory.estimate.mount_um if memory.estimate else 0.0)
        memory.locking = off
        # While all sensors agree, the mount is known: a jump of the camera is undone to it.
        if consistency.sensors_agree and memory.estimate is not None:
            memory.agreed_mount.update(memory.estimate.mount_um, dt_s, REFERENCE_S)
            memory.slowly_agreed_mount.update(memory.estimate.mount_um, dt_s, SLOW_REFERENCE_S)
        elif consistency.camera_fault_text and centre.frames and not self._by_optics:
            agreed = (
                memory.slowly_agreed_mount if consistency.camera_drifts else memory.agreed_mount
            )
            centre.undo_optics_jump(agreed.value)
        # Figures that a fault of the camera has moved are of no use.
        unusable = off or bool(consistency.camera_fault_text) or self._mount_drift.beyond_limit
        return None if unusable else figure

    def _report_mount_growth(self) -> list[Event]:
        """Report once that the camera mount's growth may be an error of the figure, and its end by
        a new lock.
        """
        sigma_um, warmed_k = self._camera_mount.sigma_um, self._camera_mount.warmed_k
        memory = self.memory
        far = sigma_um > self._mount_growth_max_um / (2 if memory.mount_growth_reported else 1)
        if far == memory.mount_growth_reported:
            return []
        memory.mount_growth_reported = far
        warming = f"the camera mount is {warmed_k:+.1f} K from the reference"
        if not far:
            return [MaintenanceOver("camera_mount_growth", warming)]
        remedy = (
            "calibrate the optics again"
            if self._by_optics
            else "`ctl shape off` and `on` accept it"
        )
        error = f"the figure may be off by {sigma_um:.1f} µm"
        return [Maintenance("camera_mount_growth", f"{warming}: {error}; {remedy}")]

    def _follows_sensor(self, sensor: Sensor) -> bool:
        estimate = self.memory.estimate
        return estimate is not None and estimate.sensors[sensor].fresh

    def _report_sensors_in_use(self, now_s: float, jumped: Collection[str]) -> list[Event]:
        """Report the sensors once they have stood for a second, and every jump."""
        # Since when the sensors differ from the reported ones; a jump is reported at once
        seeing = tuple(int(sensor) for sensor in Sensor if self._follows_sensor(sensor))
        memory = self.memory
        if seeing == memory.reported_sensors:
            memory.sensors_changed_s = math.nan
        elif math.isnan(memory.sensors_changed_s):
            memory.sensors_changed_s = now_s
        is_unchanged = (
            not math.isnan(memory.sensors_changed_s)
            and now_s - memory.sensors_changed_s >= _STANDS_S
        )
        if not is_unchanged and not jumped:
            return []
        memory.reported_sensors = seeing
        memory.sensors_changed_s = math.nan
        return [SensorsUsed(tuple(Sensor(n).name.lower() for n in seeing), tuple(jumped))]
