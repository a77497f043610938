"""States as small functions: each looks at the tick, sets what the pump shall do, and returns the next state.

They decide only what is wanted when all is well. Safety is judged around them on every tick
(`controller.Controller.tick`): no handler can go past it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from membrane_ctrl.config import Config
from membrane_ctrl.control.inner_loop import InnerLoop, LoopInput, LoopOutput
from membrane_ctrl.control.slope import Slope
from membrane_ctrl.errors import Exit
from membrane_ctrl.ladder import Ladder
from membrane_ctrl.names import Rung, State
from membrane_ctrl.observer import Observer

# a pump that someone left running has run down by then: lag 0.15 s, transport 0.1 s (PHYSICS, inner loop)
_PUMP_STANDS_S = 0.5


@dataclass(slots=True)
class Scene:
    """What the handlers share: the loop, this tick's facts, and what they decide."""

    config: Config
    loop: InnerLoop
    observer: Observer
    ladder: Ladder
    # this tick
    now_s: float = 0.0
    dt_s: float = 0.02
    state_age_s: float = 0.0  # 0 exactly in the first tick of a state
    trim_um: float = 0.0
    hold_wanted: bool = False
    stop_wanted: bool = False
    stop_exit: Exit = Exit.DONE
    stop_asked_by: str = ""
    # memory of the states
    good_since_s: float = math.nan
    sinking: Slope = field(default_factory=Slope)  # of the mirror with the pump off, seen in `check`
    ramp_from_fraction: float = 0.0
    last_pump_fraction: float = 0.0
    # decisions of this tick
    output: LoopOutput | None = None
    pump_fraction: float = 0.0
    vent_fraction: float = 0.0
    why: str = ""
    overdue: str = ""
    finished: Exit | None = None

    def stay_good(self, good: bool) -> float:
        """How long `good` has been true without a break, in seconds."""
        if not good:
            self.good_since_s = math.nan
            return 0.0
        if math.isnan(self.good_since_s):
            self.good_since_s = self.now_s
        return self.now_s - self.good_since_s


def standby(scene: Scene) -> State:
    """Pump off until someone wants the mirror held."""
    if scene.stop_wanted:
        return _stop(scene)
    if scene.hold_wanted:
        scene.why = "asked to hold the mirror"
        return State.CHECK
    scene.why = "standby: nobody has asked to hold the mirror"
    return State.STANDBY


def check(scene: Scene) -> State:
    """Every sensor must have been good for a while before the pump may run; how fast the mirror sinks is the leak."""
    if scene.stop_wanted:
        return _stop(scene)
    if scene.state_age_s > _PUMP_STANDS_S:
        scene.sinking.add(scene.now_s, scene.observer.displacement_um)
    missing = _missing(scene)
    scene.why = f"checking the sensors: {missing}" if missing else "checking the sensors: all good so far"
    check_s = scene.config.states.check_s
    if scene.stay_good(not missing) >= check_s:
        # the flow that balances the leak, so that the integrator need not find it first
        leak_um_per_s = max(0.0, -scene.sinking.per_s)
        scene.loop.start(scene.observer.displacement_um, leak_um_per_s)
        scene.why = f"all sensors good for {check_s:g} s; the mirror sinks by {leak_um_per_s:.2f} um/s"
        return State.INFLATE
    if scene.state_age_s > scene.config.states.check_timeout_s:
        scene.overdue = f"sensors not good after {scene.config.states.check_timeout_s:g} s: {missing}"
    return State.CHECK


def inflate(scene: Scene) -> State:
    """Ramp from where the mirror is to the setpoint."""
    if scene.stop_wanted:
        return _stop(scene)
    output = _drive(scene)
    to_go_um = scene.config.loop.setpoint_um - output.filtered_um
    scene.why = f"inflating: {to_go_um:.1f} um to go"
    ramp_left_um = scene.config.loop.setpoint_um + scene.trim_um - output.setpoint_um
    if max(abs(ramp_left_um), abs(to_go_um)) < scene.config.limits.band_um:
        return State.SETTLE
    if scene.state_age_s > scene.config.states.inflate_timeout_s:
        scene.overdue = f"still {to_go_um:.0f} um from the setpoint"
    return State.INFLATE


def settle(scene: Scene) -> State:
    """Stay inside the band for a while before the state is called hold."""
    if scene.stop_wanted:
        return _stop(scene)
    output = _drive(scene)
    inside = abs(output.error_um) < scene.config.limits.band_um
    settled_s = scene.stay_good(inside)
    scene.why = f"settling: inside the band for {settled_s:.0f} s"
    if settled_s >= scene.config.states.settle_s:
        scene.why = f"inside +-{scene.config.limits.band_um:g} um for {settled_s:.1f} s"
        return State.HOLD
    if scene.state_age_s > scene.config.states.settle_timeout_s:
        scene.overdue = f"not inside +-{scene.config.limits.band_um:g} um for {scene.config.states.settle_s:g} s"
    return State.SETTLE


def hold(scene: Scene) -> State:
    """The main job."""
    if scene.stop_wanted:
        return _stop(scene)
    scene.why = _why_hold(scene, _drive(scene))
    return State.HOLD


def lower(scene: Scene) -> State:
    """The clean way out: pump off, seen to be off, then done. The leak lets the mirror down by itself."""
    reading = scene.observer.reading
    scene.why = "stopping: pump off"
    if _pump_seen_off(scene) or scene.state_age_s > scene.config.states.lower_timeout_s:
        scene.finished = scene.stop_exit if reading is not None else Exit.DEVICE_FAILED
    return State.LOWER


def fault(scene: Scene) -> State:
    """Down the ladder, latched: only a person clears it, after this run."""
    rung = scene.ladder.step(scene.now_s)
    scene.why = f"fault: {rung.name.lower().replace('_', ' ')}"
    if rung == Rung.RAMP_DOWN:
        if scene.state_age_s == 0:
            scene.ramp_from_fraction = scene.last_pump_fraction
        left = max(0.0, 1.0 - scene.ladder.age_s(scene.now_s) / scene.config.states.ramp_down_s)
        scene.pump_fraction = left * scene.ramp_from_fraction
        return State.FAULT
    scene.vent_fraction = 1.0 if rung == Rung.VENT else 0.0
    if _pump_seen_off(scene) or scene.ladder.age_s(scene.now_s) > scene.config.states.lower_timeout_s:
        scene.finished = Exit.SAFETY_TRIP
    return State.FAULT


HANDLERS: dict[State, Callable[[Scene], State]] = {
    State.STANDBY: standby,
    State.CHECK: check,
    State.INFLATE: inflate,
    State.SETTLE: settle,
    State.HOLD: hold,
    State.LOWER: lower,
    State.FAULT: fault,
}


def _stop(scene: Scene) -> State:
    scene.why = f"stop asked for by {scene.stop_asked_by}"
    return State.LOWER


def _drive(scene: Scene) -> LoopOutput:
    """Let the loop drive the pump: automatic with a valid reading, the held mean flow without one."""
    if math.isfinite(scene.observer.displacement_um):
        output = scene.loop.step(_given(scene), scene.dt_s)
    else:
        output = scene.loop.stale(scene.dt_s)
    scene.output = output
    scene.pump_fraction = output.pump_fraction
    scene.vent_fraction = scene.config.loop.bleed_fraction
    return output


def _given(scene: Scene) -> LoopInput:
    reading = scene.observer.reading
    return LoopInput(
        target_um=scene.config.loop.setpoint_um,
        trim_um=scene.trim_um,
        displacement_um=scene.observer.displacement_um,
        ambient_pressure_pa=reading.ambient_pressure_pa if reading else math.nan,
        air_temperature_c=reading.air_temperature_c if reading else math.nan,
    )


def _missing(scene: Scene) -> str:
    reading = scene.observer.reading
    if reading is None:
        return "no answer from the device"
    if not math.isfinite(scene.observer.displacement_um):
        return f"no valid laser reading (quality {reading.displacement_quality})"
    if not math.isfinite(reading.gauge_pressure_pa):
        return "no gauge pressure"
    if reading.latched_faults:
        return f"the board has latched faults {reading.latched_faults:#x}"
    return ""


def _pump_seen_off(scene: Scene) -> bool:
    reading = scene.observer.reading
    return scene.state_age_s > 0 and reading is not None and reading.pump_fraction <= 0.001


def _why_hold(scene: Scene, output: LoopOutput) -> str:
    if scene.ladder.rung == Rung.HOLD_FLOW:
        return "holding the last mean flow until the laser is back"
    if output.too_tight:
        return "holding, but the mirror is too tight: open a bleed (loop.bleed_fraction)"
    if output.saturated:
        side = (
            "more gas than the pump has" if output.flow_wanted_um_per_s > output.flow_um_per_s else "less than none"
        )
        return f"holding, pump at its limit: the loop wants {side}"
    return "holding: the pump replaces what leaks"
