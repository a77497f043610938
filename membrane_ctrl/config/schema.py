"""The whole configuration: frozen, validated, unit-suffixed, one TOML file.

Every field that holds a quantity ends in its unit. Values that no real bench could have are refused,
so that a wrong unit (metres for millimetres) shows when the file is read and not at the mirror.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from firmware_iface.settings import AravisCameraConfig, Section, UvcCameraConfig
from membrane_ctrl.config.devices import DevicesConfig
from membrane_ctrl.config.optics import ScreenPoseConfig
from membrane_ctrl.config.port import AlarmsConfig, PortConfig

Positive = Annotated[float, Field(gt=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Vector3 = tuple[float, float, float]


class LoopConfig(Section):
    """The inner loop. The manipulated value is the pump's flow as a speed of the mirror's centre."""

    rate_hz: Annotated[float, Field(ge=1, le=200)] = 50.0
    setpoint_um: float = 0.0
    # SIMC PI with the closed-loop time constant chosen for least predicted variance (docs/physics.md, inner loop)
    kp_per_s: Annotated[float, Field(ge=0, le=20)] = 0.61
    ti_s: Annotated[float, Field(gt=0.05, le=3600)] = 6.5
    td_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    setpoint_weight: Fraction = 1.0  # the setpoint only ever ramps, with its speed fed forward
    measurement_filter_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    flow_max_um_per_s: Annotated[float, Field(gt=0, le=100)] = 5.3
    flow_rate_limit_um_per_s2: Annotated[float, Field(gt=0, le=1000)] = 20.0
    setpoint_ramp_um_per_s: Annotated[float, Field(gt=0, le=100)] = 3.5
    feedforward_barometer: bool = True
    feedforward_temperature: bool = True
    barometer_gain_um_per_pa: Annotated[float, Field(ge=-10, le=10)] = -0.358
    temperature_gain_um_per_k: Annotated[float, Field(ge=-2000, le=2000)] = 123.0
    gas_follows_air_s: Annotated[float, Field(ge=0, le=3600)] = 12.0
    feedforward_filter_s: Annotated[float, Field(ge=0, le=60)] = 0.2
    bleed_fraction: Fraction = 0.0  # vent held this far open during hold, for a mirror that is too tight

    @model_validator(mode="after")
    def _filter_slower_than_tick(self) -> LoopConfig:
        if 0 < self.measurement_filter_s < 0.5 / self.rate_hz:
            raise ValueError("measurement_filter_s is shorter than half a tick: use 0 to switch it off")
        return self


class PumpConfig(Section):
    """Flow of the pump against its command (docs/physics.md, film and gas)."""

    flow_full_um_per_s: Annotated[float, Field(gt=0, le=100)] = 5.3
    dead_fraction: Fraction = 0.10
    start_fraction: Fraction = 0.22
    stall_fraction: Fraction = 0.15


class LimitsConfig(Section):
    """Limits the mirror must never exceed."""

    displacement_min_um: float = -2000.0
    displacement_max_um: float = 500.0
    gauge_pressure_max_pa: Annotated[float, Field(gt=0, le=5000)] = 750.0
    stale_s: Annotated[float, Field(gt=0, le=10)] = 0.3
    # a film is never still: a reading identical for this long means that the sensor has stopped
    stuck_s: Annotated[float, Field(gt=0, le=600)] = 5.0
    lateness_max_ms: Annotated[float, Field(gt=0, le=10000)] = 100.0
    step_max_um: Annotated[float, Field(gt=0, le=10000)] = 50.0  # per tick; no film jumps this far
    # noise of 0.5 Pa in steps of 0.001 Pa never repeats this long, nor does a slow gauge that updates every second; a
    # gauge that filters its noise below its own resolution repeats itself on a held mirror, and needs more
    gauge_stuck_s: Annotated[float, Field(gt=0, le=1e5)] = 20.0
    # a slammed door (100 Pa) moves the film by 36 um, 2 Pa; a storm of 250 Pa by 5 Pa
    gauge_step_max_pa: Annotated[float, Field(gt=0, le=5000)] = 30.0
    # 20 um are 1 Pa: 30 sigma of a gauge's ten-second mean, 5 times the drift in two minutes of a mount at 2 um/min
    laser_gauge_apart_max_um: Annotated[float, Field(gt=0, le=10000)] = 20.0
    # over hours: a gauge's zero drifts by 1 Pa/K (20 um/K), a fresh film's creep is 31 um (control/film.py)
    laser_gauge_drift_max_um: Annotated[float, Field(gt=0, le=10000)] = 100.0
    # a leak that doubles is a leak; a film that takes more than this, seen by no camera, may be running away
    leak_growth_max: Annotated[float, Field(gt=1, le=1000)] = 2.2
    following_error_max_um: Annotated[float, Field(gt=0, le=10000)] = 60.0
    band_um: Positive = 2.0


class StatesConfig(Section):
    """How long states and safe levels may last."""

    check_s: Annotated[float, Field(ge=0.1, le=600)] = 2.0  # good readings required before the pump may run
    check_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 15.0
    actuator_test: bool = True  # pump up, pump off, vent, before a hold: does the film answer?
    inflate_timeout_s: Annotated[float, Field(gt=0, le=1e6)] = 14_400.0  # a fill from flat takes two hours
    inflate_pause_um: Annotated[float, Field(gt=0, le=1e4)] = 10.0  # the ramp waits if the centre lags further
    # a pump of 1.2 times the leak lifts the mirror by its band in 40 s; one that lifts it no more is dead or too weak
    inflate_stall_s: Annotated[float, Field(gt=0, le=1e6)] = 300.0
    settle_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.5  # within the band before `hold` begins
    settle_timeout_s: Annotated[float, Field(gt=0, le=1e6)] = 600.0
    # 10 s of laser loss cost 1.6 um on average (docs/physics.md); longer is not a glitch
    hold_flow_max_s: Annotated[float, Field(gt=0, le=600)] = 12.0
    ramp_down_s: Annotated[float, Field(gt=0, le=600)] = 10.0
    pump_off_max_s: Annotated[float, Field(gt=0, le=1e6)] = 3600.0
    lower_timeout_s: Annotated[float, Field(gt=0, le=600)] = 3.0  # by then a pump commanded off must have stopped
    pause_max_s: Annotated[float, Field(gt=0, le=1e5)] = 600.0
    manual_max_s: Annotated[float, Field(gt=0, le=1e5)] = 600.0  # after the last `manual` the loop holds again
    manual_range_um: Annotated[float, Field(gt=0, le=1e4)] = 50.0  # likewise beyond this distance from the setpoint
    vented_pressure_pa: Annotated[float, Field(ge=0, le=5000)] = 100.0  # `vent` is done below this
    latch_twin_faults: bool = False  # let a trip of the twin block the next run, as a real one does
    stay_after_trip: bool = False  # wait in `fault` for `ctl ack` instead of ending the run


class ResumeConfig(Section):
    """Which latched faults may clear automatically once their cause has gone."""

    faults: tuple[str, ...] = ()
    wait_s: Annotated[float, Field(ge=1, le=1e5)] = 30.0
    most_per_day: Annotated[int, Field(ge=0, le=1000)] = 3


class ShapeConfig(Section):
    """The measurement cycle and the shape loop."""

    enabled: bool = True
    period_s: Annotated[float, Field(ge=0.2, le=3600)] = 2.0
    frame_interval_s: Annotated[float, Field(ge=0.0, le=10)] = 0.1
    bin_px: Annotated[int, Field(ge=1, le=16)] = 4
    # then a laser mount that starts to drift at 2 um/min is followed within 0.5 um (control/filters.py)
    time_constant_s: Annotated[float, Field(ge=1, le=1e5)] = 40.0
    trim_rate_max_um_per_s: Annotated[float, Field(gt=0, le=10)] = 0.1
    trim_max_um: Annotated[float, Field(gt=0, le=1000)] = 100.0
    fresh_s: Annotated[float, Field(gt=0, le=3600)] = 15.0
    disagreement_max_um: Annotated[float, Field(gt=0, le=1000)] = 10.0


class PatternConfig(Section):
    """Fringes on the screen (docs/interfaces.md)."""

    steps: Annotated[int, Field(ge=3, le=64)] = 4
    periods: Annotated[int, Field(ge=1, le=8)] = 8
    period_mm: Annotated[float, Field(ge=1, le=2000)] = 49.82


class CameraPoseConfig(Section):
    """Any camera pose: pinhole in world; rotation rows are the camera's x right, y down, z forward in world."""

    position_mm: Vector3
    rotation: tuple[Vector3, Vector3, Vector3]

    @model_validator(mode="after")
    def _is_rotation(self) -> CameraPoseConfig:
        rows = np.array(self.rotation)
        # 1e-6: rounding to seven digits
        if not np.allclose(rows @ rows.T, np.eye(3), atol=1e-6) or np.linalg.det(rows) < 0:
            raise ValueError("rotation is not a rotation matrix (rows: right, down, forward in world)")
        return self


class GeometryConfig(Section):
    """Camera and screen: the paper's a, b, alpha, or two general poses (docs/interfaces.md).

    In either form, `screen` may give the departure of the screen's face from its plane.
    """

    a_mm: Annotated[float, Field(ge=100, le=100_000)] | None = None
    b_mm: Annotated[float, Field(ge=100, le=100_000)] | None = None
    alpha_deg: Annotated[float, Field(gt=0, lt=180)] | None = None
    a_sigma_mm: Annotated[float, Field(ge=0)] | None = None
    b_sigma_mm: Annotated[float, Field(ge=0)] | None = None
    alpha_sigma_deg: Annotated[float, Field(ge=0)] | None = None
    reference_displacement_um: float | None = None
    camera: CameraPoseConfig | None = None
    screen: ScreenPoseConfig | None = None

    @model_validator(mode="after")
    def _one_form(self) -> GeometryConfig:
        short = (self.a_mm, self.b_mm, self.alpha_deg)
        general = (self.camera, None if self.screen is None else self.screen.pose)
        if all(v is not None for v in short) and all(v is None for v in general):
            return self
        if all(v is None for v in short) and all(v is not None for v in general):
            return self
        raise ValueError("give either a_mm, b_mm and alpha_deg, or both [camera] and [screen] poses")


class CameraConfig(Section):
    """Sensor and lens."""

    width_px: Annotated[int, Field(ge=8, le=20_000)] = 2448
    height_px: Annotated[int, Field(ge=8, le=20_000)] = 2048
    focal_mm: Annotated[float, Field(ge=1, le=1000)] = 16.0
    pixel_um: Annotated[float, Field(ge=0.5, le=500)] = 3.45
    principal_px: tuple[float, float] | None = None  # (column, row); the sensor's middle when absent
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]
    noise_adu: Annotated[float, Field(ge=0)] = 0.4
    bits: Annotated[int, Field(ge=8, le=16)] = 8

    @property
    def principal(self) -> tuple[float, float]:
        """Principal point as (column, row) in pixels."""
        return self.principal_px or ((self.width_px - 1) / 2, (self.height_px - 1) / 2)


class MirrorConfig(Section):
    """The film's rim and its measured part."""

    radius_mm: Annotated[float, Field(ge=10, le=50_000)] = 500.0
    analysis_radius_mm: Annotated[float, Field(ge=10, le=50_000)] = 475.0
    sag_mm: Annotated[float, Field(ge=0.1, le=10_000)] = 37.1  # depth of the bowl at displacement 0
    pressure_pa: Annotated[float, Field(ge=0, le=5000)] = 600.0  # gauge reading at displacement 0; 0: unknown

    @model_validator(mode="after")
    def _inside(self) -> MirrorConfig:
        if self.analysis_radius_mm > self.radius_mm:
            raise ValueError("analysis_radius_mm is larger than radius_mm")
        return self


class OpticsConfig(Section):
    """What deflectometry must know about the bench."""

    geometry: GeometryConfig = GeometryConfig(a_mm=2672.0, b_mm=2871.0, alpha_deg=80.9)
    camera: CameraConfig = CameraConfig()
    pattern: PatternConfig = PatternConfig()
    mirror: MirrorConfig = MirrorConfig()
    geometry_file: Path | None = None  # written by `calibrate`; replaces `geometry` (relative path)

    @model_validator(mode="after")
    def _map_covers_pattern(self) -> OpticsConfig:
        half_mm = self.pattern.periods * self.pattern.period_mm / 2
        if self.geometry.screen is not None and not self.geometry.screen.covers(half_mm):
            raise ValueError(
                f"geometry.screen.height_map must reach over the pattern, {half_mm:g} mm from O' each way"
            )
        return self


class TwinConfig(Section):
    """The simulated bench. The defaults are assumptions, explained in docs/physics.md."""

    port: Annotated[int, Field(ge=0, le=65535)] = 5020  # 0: any free one
    scenario: Literal["calm", "quiet", "typical", "gusty"] = "typical"
    seed: Annotated[int, Field(ge=0)] = 1
    from_flat: bool = False
    start_error_um: Annotated[float, Field(ge=-500, le=500)] = -25.0
    laser_noise_um: Annotated[float, Field(ge=0, le=100)] = 1.0
    laser_resolution_um: Annotated[float, Field(ge=0, le=100)] = 0.1
    laser_drift_um_per_min: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    leak_time_constant_s: Annotated[float, Field(ge=10, le=1e8)] = 1.0e4
    barometer_noise_pa: Annotated[float, Field(ge=0, le=100)] = 0.05
    thermometer_noise_k: Annotated[float, Field(ge=0, le=10)] = 0.002
    geometry: GeometryConfig | None = None  # true camera and screen poses; none: those of [optics.geometry]


class RecordingConfig(Section):
    """Where runs are stored and what they contain."""

    logs_dir: str = "logs"
    min_free_mb: Annotated[float, Field(ge=1)] = 500.0
    thumbnails: bool = True
    raw_every_cycles: Annotated[int, Field(ge=0, le=1_000_000)] = 0  # keep the frames of every n-th cycle; 0: none
    raw_before_fault_cycles: Annotated[int, Field(ge=0, le=20)] = 2  # and always of the last before a fault
    segment_s: Annotated[float, Field(ge=10, le=86_400)] = 3600.0  # a crash leaves at most this much unoptimised
    quiet_hz: Annotated[float, Field(ge=0.1, le=200)] = 1.0  # viewer rows per second while nothing happens
    keep_gb: Annotated[float, Field(ge=0.1, le=1e6)] | None = None  # delete old runs beyond this; none: never
    keep_days: Annotated[float, Field(ge=0.1, le=1e5)] | None = None


class Config(Section):
    """The whole configuration of a run."""

    loop: LoopConfig = LoopConfig()
    pump: PumpConfig = PumpConfig()
    limits: LimitsConfig = LimitsConfig()
    states: StatesConfig = StatesConfig()
    resume: ResumeConfig = ResumeConfig()
    shape: ShapeConfig = ShapeConfig()
    optics: OpticsConfig = OpticsConfig()
    devices: DevicesConfig | None = None
    twin: TwinConfig = TwinConfig()
    recording: RecordingConfig = RecordingConfig()
    port: PortConfig = PortConfig()
    alarms: AlarmsConfig = AlarmsConfig()

    @model_validator(mode="after")
    def _consistent(self) -> Config:
        limits = self.limits
        if limits.displacement_min_um >= limits.displacement_max_um:
            raise ValueError("limits.displacement_min_um must be below limits.displacement_max_um")
        if not limits.displacement_min_um < self.loop.setpoint_um < limits.displacement_max_um:
            raise ValueError(
                f"loop.setpoint_um = {self.loop.setpoint_um:g} is outside the limits "
                f"({limits.displacement_min_um:g} .. {limits.displacement_max_um:g} um)"
            )
        if self.devices is not None and isinstance(self.devices.camera, AravisCameraConfig | UvcCameraConfig):
            bits = self.devices.camera.bits
            if bits != self.optics.camera.bits:
                raise ValueError(f"optics.camera.bits = {self.optics.camera.bits}, but devices.camera gives {bits}")
        return self
