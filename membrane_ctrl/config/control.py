"""The tables of the loops and of safety: `[loop]`, `[pump]`, `[limits]`, `[states]`, `[resume]`,
`[shape]`, `[estimator]`.
"""

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from firmware_iface.settings import Fraction, Micrometres, Section
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS

# Keys of `[loop]` that are no gains: the setpoint has its own command, and what a run holds stays
KEYS_BESIDE_GAINS = ("setpoint_um", "holds", "reference_figure_um")


class LoopConfig(Section):
    """The inner loop. The manipulated value is the pump's flow as a
    speed of the mirror's centre.
    """

    rate_hz: Annotated[float, Field(ge=1, le=200)] = 50.0
    """Ticks per second. Lower it for devices that answer slowly, and tune again."""
    setpoint_um: Micrometres = 0.0
    """Displacement to hold. Change it to hold another depth; in a running hold use `ctl setpoint`.
    """
    kp_per_s: Annotated[float, Field(ge=0, le=20)] = 0.61
    """Proportional gain; SIMC with the time constant of least predicted variance
    (docs/explanation/physics.md, inner loop). Change it with `tune`: a larger gain follows gusts
    faster and passes more laser noise."""
    ti_s: Annotated[float, Field(gt=0.05, le=3600)] = 6.5
    """Integral time. Change it with `tune`, together with `kp_per_s`."""
    td_s: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Derivative time; 0 for none. Leave it at 0: the film is an integrator, and a derivative only
    adds noise.
    """
    setpoint_weight: Fraction = 1.0
    """Share of the setpoint in the proportional term. Leave it at 1: the setpoint only ever ramps.
    """
    measurement_filter_s: Annotated[float, Field(ge=0, le=10)] = 0.2
    """Time constant of the filter on the laser reading; 0 for none. Change it with `tune`."""
    flow_max_um_per_s: Annotated[float, Field(gt=0, le=100)] = 5.3
    """Largest flow that the loop may command; a measured curve brings its own.
    Lower it to inflate or correct more gently."""
    flow_rate_limit_um_per_s2: Annotated[float, Field(gt=0, le=1000)] = 100.0
    """Fastest change of the flow; the default takes a third of the pump's lag from none to full.
    Lower it for a drive that must not be stepped: 20 costs a fifth in gusts, and starts the pump
    half as often."""
    setpoint_ramp_um_per_s: Annotated[float, Field(gt=0, le=100)] = 3.5
    """Speed of the setpoint, upwards; downwards no faster than the leak. Lower it for a weaker
    pump.
    """
    feedforward_barometer: bool = True
    """Correct for the barometer's changes. Set it to false on a bench without a barometer."""
    feedforward_temperature: bool = True
    """Correct for the air thermometer's changes. Set it to false on a bench without a thermometer.
    """
    barometer_gain_um_per_pa: Annotated[float, Field(ge=-10, le=10)] = -0.358
    """Motion of the centre per pascal of ambient pressure. Change it if it was measured on another
    film.
    """
    temperature_gain_um_per_k: Annotated[float, Field(ge=-2000, le=2000)] = 123.0
    """Motion of the centre per kelvin of gas temperature. Change it if it was measured on another
    film.
    """
    gas_follows_air_s: Annotated[float, Field(ge=0, le=3600)] = 12.0
    """Time constant with which the gas follows the air's temperature. Change it for another depth
    or volume.
    """
    feedforward_filter_s: Annotated[float, Field(ge=0, le=60)] = 0.2
    """Filter on the weather sensors. Raise it for noisy sensors, at the cost of a later correction.
    """
    bleed_fraction: Fraction = 0.0
    """Opening of the vent during a hold. Raise it for a mirror that is too tight (leak below 0.4
    µm/s).
    """

    holds: Literal["vertex", "focus", "best_fit"] = "vertex"
    """Which scalar of the figure stays constant: the centre; the radius of the best sphere over
    `analysis_radius_mm`; or the depth of least RMS against `reference_figure_um`. Set it to `focus`
    or `best_fit` on a bench with a camera whose film changes its figure, with climate or creep
    (docs/how-to/hold-a-figure.md)."""
    reference_figure_um: Annotated[tuple[Micrometres, ...], Field(max_length=ZERNIKE_TERMS)] = ()
    """Zernike terms, in Noll's order, of the figure that `best_fit` holds at the setpoint 0; empty:
    the first figures of the run, at its setpoint. Set it to `zernike.coeffs_um` of the
    `result.json` of a set."""
    held_offset_max_um: Annotated[float, Field(gt=0, le=1000)] = 50.0
    """How far `focus` and `best_fit` may move the centre from the setpoint. Raise it for a film
    whose figure changes more, within the limits of the displacement."""
    held_keep_s: Annotated[float, Field(gt=0, le=1e6)] = 3600.0
    """Time without usable figures for which the last offset counts as known; after it the notice
    `held_offset` appears, and the centre stays. Change it to how long your climate is steady."""

    def flow_most_um_per_s(self, pump: "PumpConfig") -> float:
        """The largest flow that the loop commands: within its own limit and the pump's."""
        return min(self.flow_max_um_per_s, pump.flow_full_um_per_s)

    @model_validator(mode="after")
    def _require_all_terms(self) -> "LoopConfig":
        if len(self.reference_figure_um) not in (0, ZERNIKE_TERMS):
            raise ValueError(
                f"reference_figure_um has {len(self.reference_figure_um)} terms; give all "
                f"{ZERNIKE_TERMS}"
            )
        return self

    @model_validator(mode="after")
    def _filter_slower_than_tick(self) -> "LoopConfig":
        if 0 < self.measurement_filter_s < 0.5 / self.rate_hz:
            raise ValueError(
                "measurement_filter_s is shorter than half a tick: use 0 to switch it off"
            )
        return self


class PumpConfig(Section):
    """Flow of the pump against its command (docs/explanation/physics.md, film and gas); measure it
    with `tune pump`.
    """

    flow_full_um_per_s: Annotated[float, Field(gt=0, le=100)] = 5.3
    """Flow at full drive, as a speed of the centre. Change it to the measured one."""
    dead_fraction: Fraction = 0.10
    """Command at which the extrapolated flow is zero. Set it to 0 for a flow controller."""
    start_fraction: Fraction = 0.22
    """Command from which a pump at rest starts. Set it to 0 for a flow controller."""
    stall_fraction: Fraction = 0.15
    """Command below which a running pump stops. Set it to 0 for a flow controller."""
    curve_fraction: Annotated[tuple[Fraction, ...], Field(max_length=100)] = ()
    """Commands of a measured curve, which replaces the straight line; none beyond the last one is
    given. Set it with `tune pump` for a pump that is not straight."""
    curve_um_per_s: tuple[Annotated[float, Field(ge=0, le=100)], ...] = ()
    """Flow of a running pump at each of these commands. Set it with `tune pump`."""
    curve_falling_um_per_s: tuple[Annotated[float, Field(ge=0, le=100)], ...] = ()
    """Flow when a command is reached from a larger one. Set it with `tune pump` for a pump with
    hysteresis.
    """
    probe_um: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Amplitude of a sine of 5 s by which a hold moves the centre to learn the pump's drift from
    its curve; 0: none. Set it to half the centre's standard deviation: 0.1 gives 5 % after three
    hours at 1 µm of laser noise."""
    change_max: Annotated[float, Field(gt=0, le=1)] = 0.12
    """Drift of the pump from its curve that causes the notice `pump_drift`. Raise it for a pump
    that varies.
    """
    stroke_hz: Annotated[float, Field(ge=0, le=100)] = 0.0
    """Strokes a second in a usual hold; a tracking hold warns when they coincide with a mirror
    vibration. 0: unknown. Set it for a diaphragm pump."""

    @model_validator(mode="before")
    @classmethod
    def _set_full_flow(cls, table: Any) -> Any:
        """The full flow of a measured curve is its last one."""
        flows = None
        if isinstance(table, dict):
            flows = table.get("curve_um_per_s")
        if isinstance(flows, list | tuple) and flows and isinstance(flows[-1], int | float):
            return {"flow_full_um_per_s": flows[-1], **table}
        return table

    @model_validator(mode="after")
    def _require_rising_curve(self) -> "PumpConfig":
        """Refuse a measured curve that has no inverse."""
        # What the inverse needs: rising commands, flows that do not fall, and play of one sign
        commands = self.curve_fraction
        flows = self.curve_um_per_s
        falling = self.curve_falling_um_per_s
        if not (commands or flows or falling):
            return self
        if (
            len(commands) < 2
            or len(commands) != len(flows)
            or (falling and len(falling) != len(flows))
        ):
            counts = (
                f"curve_fraction has {len(commands)} commands, curve_um_per_s {len(flows)} flows"
            )
            if falling:
                counts += f", curve_falling_um_per_s {len(falling)}"
            raise ValueError(f"{counts}: give a flow for each of at least two commands")
        if any(later <= earlier for earlier, later in pairwise(commands)):
            raise ValueError("curve_fraction must rise from each command to the next")
        for name, branch in (("curve_um_per_s", flows), ("curve_falling_um_per_s", falling)):
            if any(later < earlier for earlier, later in pairwise(branch)):
                raise ValueError(f"{name} must not fall towards larger commands")
        if any(above < below for below, above in zip(flows, falling or flows, strict=True)):
            raise ValueError(
                "curve_falling_um_per_s must not be below curve_um_per_s at any command"
            )
        if self.flow_full_um_per_s != flows[-1]:
            raise ValueError(
                f"flow_full_um_per_s must be the last flow of the curve ({flows[-1]:g}), or absent"
            )
        return self


class LimitsConfig(Section):
    """Limits the mirror must never exceed."""

    displacement_min_um: Micrometres = -2000.0
    """Shallowest bowl while held (`under_displacement`). Change it to the laser's range and the
    optics' use.
    """
    displacement_max_um: Micrometres = 500.0
    """Deepest bowl (`over_displacement`). Change it to what the film and the laser can take."""
    gauge_pressure_max_pa: Annotated[float, Field(gt=0, le=5000)] = 750.0
    """Highest gauge pressure; above it the mirror is vented. Change it for another film, below what
    tears it.
    """
    stale_s: Annotated[float, Field(gt=0, le=10)] = 0.3
    """Time without a reading that counts as a loss. Raise it only for devices that answer that
    rarely.
    """
    stuck_s: Annotated[float, Field(gt=0, le=600)] = 5.0
    """Identical readings for this long mean a dead laser: no film is still. Raise it for a laser of
    coarse steps.
    """
    lateness_max_ms: Annotated[float, Field(gt=0, le=10000)] = 100.0
    """Lateness of a tick that counts as missed control. Leave it, and move other work off a late
    machine.
    """
    step_max_um: Annotated[float, Field(gt=0, le=10000)] = 50.0
    """Largest jump of the laser reading in a tick; no film jumps that far. Raise it at low tick
    rates.
    """
    gauge_stuck_s: Annotated[float, Field(gt=0, le=1e5)] = 20.0
    """Identical gauge readings for this long mean a dead gauge: noise of 0.5 Pa in steps of 0.001
    Pa never repeats so long, nor does a gauge that updates every second. Raise it for a gauge that
    filters its noise below its own resolution, which repeats itself on a held mirror."""
    gauge_step_max_pa: Annotated[float, Field(gt=0, le=5000)] = 30.0
    """Largest jump of the gauge: a slammed door (100 Pa) moves it by 2 Pa, a storm of 250 Pa by 5
    Pa. Raise it for a noisier gauge."""
    laser_gauge_apart_max_um: Annotated[float, Field(gt=0, le=10000)] = 20.0
    """Largest contradiction of laser and gauge within minutes. 20 µm are 1 Pa: 30 sigma of a
    gauge's ten-second mean, 5 times the drift in two minutes of a mount at 2 µm/min. Sensors of the
    climate add what they explain, at most 30 µm. Raise it for a noisier gauge."""
    laser_gauge_drift_max_um: Annotated[float, Field(gt=0, le=10000)] = 120.0
    """The same within an hour: a day of +-2 K and +-10 % relative humidity moves the film by up to
    99 µm against an hour before (control/film_monitor.py). Sensors of the climate add what they
    explain, at most 120 µm. Raise it for a room that changes faster and has none."""
    laser_gauge_day_max_um: Annotated[float, Field(gt=0, le=10000)] = 700.0
    """The same within a day: such a climate moves the film by up to 624 µm. The true centre may be
    off by as much. Lower it for a room with a steady climate; a third of it raises the notice
    `slow_drift`."""
    leak_growth_max: Annotated[float, Field(gt=1, le=1000)] = 2.2
    """Factor by which the gas consumption may grow while no camera sees the film: a doubled leak is
    a leak, more may be a runaway. Raise it for a film whose leak varies."""
    following_error_max_um: Annotated[float, Field(gt=0, le=10000)] = 60.0
    """Largest distance from the setpoint. Raise it where gusts move the mirror farther."""
    band_um: Annotated[float, Field(gt=0, le=1e4)] = 2.0
    """Distance from the setpoint within which the mirror counts as held. Change it to what your
    optics need.
    """


class StatesConfig(Section):
    """How long states and safe levels may last."""

    check_s: Annotated[float, Field(ge=0.1, le=600)] = 2.0
    """Duration of good readings required before the pump may run. Raise it for slow sensors."""
    check_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 15.0
    """Longest wait for those readings. Raise it for sensors that warm up."""
    actuator_test: bool = True
    """Try vent and pump before a hold: the film must respond within 3 s and 5 s. Leave it on,
    except to debug a bench."""
    actuator_size: Literal["stated", "any"] = "stated"
    """How strong that test wants the pump: 0.3 to 3 times its curve, or any pump that lifts the
    mirror, up to 8 times the default curve. A hold whose file states neither the full flow nor a
    curve of the pump takes `any`. Set it to `stated` for a pump that is the default one."""
    observe: bool = False
    """Read, estimate, measure and record, and never command pump or vent. `hold --observe` sets it,
    for the first day on real hardware, or beside another controller. Set it to true for a bench
    that this program must not drive."""
    inflate_timeout_s: Annotated[float, Field(gt=0, le=1e6)] = 14_400.0
    """Longest inflation; a fill from flat takes two hours. Change it to twice the fill time of your
    mirror.
    """
    inflate_pause_um: Annotated[float, Field(gt=0, le=1e4)] = 10.0
    """The ramp waits if the centre lags further. Raise it where gusts stop the ramp too often."""
    inflate_stall_s: Annotated[float, Field(gt=0, le=1e6)] = 300.0
    """Time in which an inflation must lift the mirror by its band: a pump of 1.2 times the leak
    takes 40 s, one that takes longer than this is dead or too weak. Raise it for a weaker pump."""
    settle_s: Annotated[float, Field(ge=0.1, le=3600)] = 1.5
    """Time within the band before `hold` begins. Raise it where the mirror overshoots."""
    settle_timeout_s: Annotated[float, Field(gt=0, le=1e6)] = 600.0
    """Longest settling. Raise it for slow loops."""
    hold_flow_max_s: Annotated[float, Field(gt=0, le=600)] = 12.0
    """Longest hold of the mean flow without a reading. 10 s cost 1.6 µm on average
    (docs/explanation/physics.md); longer is no glitch. Raise it where a longer loss is known to be
    harmless."""
    ramp_down_s: Annotated[float, Field(gt=0, le=600)] = 10.0
    """Time in which the flow then ramps down. Leave it, except for a film that must be lowered more
    slowly.
    """
    pump_off_max_s: Annotated[float, Field(gt=0, le=1e6)] = 3600.0
    """Time with the pump off after which the mirror is vented. Lower it if it must be empty sooner
    after a fault.
    """
    lower_timeout_s: Annotated[float, Field(gt=0, le=600)] = 3.0
    """Time by which a pump commanded off must have stopped. Raise it for a pump that runs down
    slowly.
    """
    pause_max_s: Annotated[float, Field(gt=0, le=1e5)] = 600.0
    """Longest `pause`; then the loop holds again. Raise it for longer work on the optics."""
    manual_max_s: Annotated[float, Field(gt=0, le=1e5)] = 600.0
    """Time after the last `manual` until the loop holds again. Raise it for longer experiments."""
    manual_range_um: Annotated[float, Field(gt=0, le=1e4)] = 50.0
    """Distance from the setpoint at which `manual` and `pause` end. Raise it for larger
    experiments.
    """
    vented_pressure_pa: Annotated[float, Field(ge=0, le=5000)] = 100.0
    """Gauge pressure below which `vent` is done. Change it for a gauge whose zero is uncertain."""
    latch_twin_faults: bool = False
    """Let a trip or a lock of the twin block the next run, as a real one does. Set it to practise
    recovery.
    """
    stay_after_trip: bool = False
    """Wait in `fault` for `ctl ack` instead of ending the run. Set it to true to acknowledge
    remotely.
    """


class ResumeConfig(Section):
    """Which latched faults may clear automatically once their cause has gone."""

    faults: tuple[str, ...] = ()
    """Names of those faults (docs/reference/faults.md, "may resume"). Set it for known harmless
    causes, e.g. `link_lost`.
    """
    wait_s: Annotated[float, Field(ge=1, le=1e5)] = 30.0
    """Time without the cause before a resume. Raise it for causes that come and go."""
    most_per_day: Annotated[int, Field(ge=0, le=1000)] = 3
    """Most resumes in a day. Leave it low: a fault that returns needs a person."""


class ShapeConfig(Section):
    """The measurement cycle and the shape loop."""

    enabled: bool = True
    """Measure the shape and trim the setpoint. Set it to false on a bench without a camera."""
    mode: Literal["auto", "cycle", "track"] = "cycle"
    """`cycle` takes the frames of a figure one pattern after the other; `track` shows crossed
    fringes that do not change, so that every frame gives a figure. `auto`: `track` if camera and
    processor give five figures a second, decided at the start of the hold; it is the default of a
    hold without a file, and `config init` writes it. A file without this key means `cycle`: other
    patterns on the screen must not begin with another version of the program. Set it to `track` for
    a figure at the camera's rate (docs/how-to/tracking.md)."""
    period_s: Annotated[float, Field(ge=0.2, le=3600)] = 2.0
    """Interval between cycles. Raise it for a camera or machine that needs longer."""
    frame_interval_s: Annotated[float, Field(ge=0.0, le=10)] = 0.1
    """Interval between the frames of a cycle. Raise it for a display that settles slowly."""
    bin_px: Annotated[int, Field(ge=1, le=16)] = 4
    """Side of the squares of camera pixels that are averaged. Lower it for more detail at more
    computing.
    """
    time_constant_s: Annotated[float, Field(ge=1, le=1e5)] = 40.0
    """Memory of the trim's tracker: a mount that starts to drift at 2 µm/min is followed within 0.5
    µm (control/drift_tracker.py). Change it with `tune outer`; noisier frames need a longer one."""
    trim_rate_max_um_per_s: Annotated[float, Field(gt=0, le=10)] = 0.1
    """Fastest trim. Raise it for a mount that moves faster."""
    trim_max_um: Annotated[float, Field(gt=0, le=1000)] = 100.0
    """Largest trim. Raise it for a mount that drifts farther; then check the mount."""
    fresh_s: Annotated[float, Field(gt=0, le=3600)] = 15.0
    """Age up to which a shape is used. Raise it with `period_s`, to several periods."""
    disagreement_max_um: Annotated[float, Field(gt=0, le=1000)] = 10.0
    """Largest jump between camera and laser that the trim follows. Raise it for noisier shapes."""
    track_rate_hz: Annotated[float, Field(ge=0.1, le=200)] = 20.0
    """Figures per second in `track`, if camera and machine give that many. Lower it to leave more
    of the machine to others."""
    track_periods: Annotated[int, Field(ge=2, le=1000)] = 32
    """Periods of the crossed fringes over the pattern; the mirror must show nine at least. Lower it
    for a camera with few pixels; raise it where the screen's light wanders over short distances."""
    track_step_s: Annotated[float, Field(ge=1, le=3600)] = 10.0
    """Interval between steps of the crossed fringes; five steps measure the light again. Lower it
    for a screen whose light changes within a minute."""


class EstimatorConfig(Section):
    """The estimate of the centre from laser, optics, barometer and
    thermometer (docs/explanation/estimator.md).
    """

    process_value: Literal["auto", "laser", "estimate", "optics"] = "laser"
    """What the inner loop holds: the laser's reading, the estimate of the centre, or that without a
    laser: `optics` uses none, fitted or not. `auto`: the estimate once dead time and lag of the
    pump are known, with a camera or a barometer, and the laser until then and where the estimate is
    worse. A hold whose file does not have this key uses `auto`. Change it to hold by the optics
    alone, or to forbid one of the two.
    """
    gain_per_s: Annotated[float, Field(gt=0, le=20)] = 16.0
    """Speed at which the loop removes an error of the estimate. Lower it for a pump whose delay is
    uncertain.
    """
    pump_response: Literal["stated", "identified"] = "stated"
    """Origin of the pump's dead time and lag: the two keys below, or the test of the actuators at
    each start, with the two keys until then. A hold whose file has none of the three keys
    identifies them. Set it to `stated` for a start that is two seconds shorter."""
    pump_delay_s: Annotated[float, Field(ge=0, le=10)] = 0.08
    """Dead time from command to gas. Change it to what `tune` found."""
    pump_lag_s: Annotated[float, Field(ge=0, le=10)] = 0.15
    """Time constant of the pump. Change it to what `tune` found."""
    laser_noise_um: Annotated[float, Field(gt=0, le=100)] = 1.0
    """Noise of a laser reading; a hold learns it within a factor of 5. Change it to your laser's.
    """
    optics_noise_um: Annotated[float, Field(gt=0, le=100)] = 0.01
    """Noise of a measured sag beyond the one that its message states. Raise it for optics that
    tremble.
    """
    barometer_noise_pa: Annotated[float, Field(gt=0, le=100)] = 0.05
    """Noise of the barometer; a hold learns it within a factor of 5. Change it to your barometer's.
    """
    thermometer_noise_k: Annotated[float, Field(gt=0, le=10)] = 0.002
    """Noise of the air thermometer; a hold learns it within a factor of 5. Change it to your
    thermometer's.
    """
    pressure_walk_pa_per_root_s: Annotated[float, Field(gt=0, le=100)] = 0.3
    """Random walk of the air pressure; learned from a barometer. Change it for a bench without
    one."""
    air_walk_k_per_root_s: Annotated[float, Field(gt=0, le=10)] = 0.004
    """Random walk of the air's temperature; learned from a thermometer. Change it for a bench
    without one.
    """
    centre_walk_um_per_root_s: Annotated[float, Field(gt=0, le=100)] = 0.01
    """Random walk of the centre that no weather explains; a hold learns it. Raise it for a shaken
    bench.
    """
    leak_walk_um_per_s_per_root_s: Annotated[float, Field(gt=0, le=10)] = 0.0005
    """Random walk of the leak between its sudden changes, which the filter detects; a hold learns
    walks of up to 25 times that. Raise it for a leak that changes slowly from the start of a hold
    on."""
    camera_mount_um_per_k: Annotated[float, Field(ge=-100, le=100)] = 0.0
    """Apparent change of sag for each kelvin by which the camera mount is warmer; it is subtracted.
    Set it to the measured one: a steel mount has about 0.34 at 2.7 m, invar near 0.03."""
    camera_mount_sigma_um_per_k: Annotated[float, Field(ge=0, le=100)] = 0.4
    """How far that may be wrong, 1 sigma; it is part of the estimate's. Lower it for a mount that
    was measured.
    """
    camera_mount_follows_air_s: Annotated[float, Field(ge=0, le=1e5)] = 1800.0
    """Time constant with which the camera mount follows the air. Change it for a lighter or heavier
    mount.
    """
    mount_walk_um_per_root_s: Annotated[float, Field(ge=0, le=10)] = 0.0033
    """Walk of the laser's mount: 0.2 µm in an hour. Change it to your mount's."""
