"""The invariants of the campaign, checked from outside after every period, to the end of a run.

The true mirror counts: its pressure, its sag, and the drive of the pump's motor and of the valve.
The controller's own reports (state, safe level, cause) are checked too, but excuse nothing. Limits
and times are the campaign's own: a limit that changes in the code under test changes none here.
"""

from __future__ import annotations

import json
import math

from campaign_cases import MOVING, Case, Situation
from campaign_times import (
    BOARD_PRESSURE_MAX_PA,
    DISPLACEMENT_MAX_UM,
    HOLD_FLOW_S,
    OFF_AFTER_S,
    PUMP_OFF_S,
    RAMP_S,
    RESUME_WAIT_S,
    RESUMES_A_DAY,
    VENTS_AFTER_S,
    WATCHDOG_S,
)
from campaign_world import WatchedPlant

from firmware_iface.register_map import load_default_map
from membrane_ctrl.hold.child_processes import EVENT_BYTES
from membrane_ctrl.hold.virtual_run import VirtualRun, VirtualTick
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.telemetry import SafeLevel, State
from membrane_ctrl.sim.virtual_bench import VirtualBench

_STILL = {State.STANDBY, State.LOWER}
_LATCHED_FAULTS = load_default_map().register("latched_faults").address
# two readings and the tick between at full pump, its lag, and three sigma of the reading
_OVERSHOOT_UM = 8.0
# 22 s on the mean flow and down again, in the strongest weather
_BLIND_UM = 40.0
_GAUGE_SLACK_PA = 2.0  # four sigma of the gauge
_SLACK_S = 0.25  # six ticks
_HELD_UM = 10.0  # an undisturbed mirror, in the strongest weather
_STEADY = 0.02
_REPEATED_TICKS = 5  # an event that is raised in so many ticks in a row floods alarms and record


class Watch:
    """Monitors controller, board and truth, and notes violations.

    Attributes
    ----------
    violations : list of str
    state : State
    code : float
        Of the first fault since the injection.
    deepest : SafeLevel
    reaction_s : float
        From the injection to the first safe level.
    wrong_s : float
        When the fault was there last.
    """

    def __init__(
        self,
        case: Case,
        at: Situation,
        bench: VirtualBench,
        gauge_max_pa: float,
        tick_s: float,
        resumes: bool,
    ) -> None:
        assert isinstance(bench.plant, WatchedPlant)
        self._case, self._at, self._bench, self._plant = case, at, bench, bench.plant
        self._gauge_max_pa, self._tick_s, self._resumes = gauge_max_pa, tick_s, resumes
        self._begun_s = math.nan
        self._state_then = State.STANDBY
        self._safe_level = SafeLevel.NONE
        self._last_tick_s = 0.0
        self._fault_code = 0.0
        self._fault_s = self._blind_s = math.nan
        self._fault_pump = self._blind_um = 0.0
        self._still_ticks, self._met = 0, False
        self._vented = self._board_vents = self._ended = False
        self._restarts = self._held_ticks = 0
        self._held_pump = 0.0
        self._ticks_in_a_row: dict[str, int] = {}  # by the kind of the event
        self.wrong_s = math.nan
        self.names: dict[float, str] = {0.0: ""}
        self.violations: list[str] = []
        self.state = State.STANDBY
        self.code = 0.0
        self.deepest = SafeLevel.NONE
        self.reaction_s = math.nan

    def begins(self, now_s: float) -> None:
        """The fault sets in."""
        self._begun_s, self._state_then = now_s, self.state

    def look(self, tick: VirtualTick | None, now_s: float) -> None:
        """After every period, whether the control process ran or not."""
        if tick is not None:
            self._last_tick_s = now_s
            self._look_at_tick(tick, now_s)
        self._ended = tick is None and not self._bench.wrong.stalled
        self._look_at_board(now_s)
        self._look_at_pressure_and_sag(now_s)
        self._look_at_the_way_down(now_s)
        self._look_at_reaction(now_s)

    def before_the_stop(self, now_s: float) -> None:
        """Check at the end of the aftermath, before any command."""
        reaction = self._case.reaction(self._state_then)
        if reaction is not None and not self._met and "stalled" not in self._case.wrong:
            self._say(
                now_s, f"never came to {reaction.safe_level.name}; got to {self.deepest.name}"
            )
        if self._case.harmless and self._at.held and not self._case.lies:
            off_um = self._plant.truth().displacement_um - self._at.target_um
            if abs(off_um) > _HELD_UM:
                self._say(now_s, f"the mirror is {off_um:.1f} µm from its setpoint")
        if self._state_then == State.FAULT:
            return  # the first cause is another one, and stays
        cause = self.names.get(self.code, f"code {self.code:g}")
        if self._case.harmless and self.code:
            self._say(now_s, f"{cause} although nothing dangerous was wrong")
        if self.code and not self._case.harmless and cause not in self._case.causes:
            self._say(now_s, f"called {cause}")

    def after_the_stop(self, run: VirtualRun) -> None:
        """Check after a stop was commanded and awaited."""
        wrong = self._bench.wrong
        if wrong.stalled:
            return
        runs = self._plant.pump_given > 0
        if runs and self._obeys:
            self._say(run.now_s, "the pump runs after the stop")
        if run.finished is None and not wrong.unreachable and not wrong.silent and self._obeys:
            self._say(run.now_s, "the stop does not end")
        if run.finished is not None and int(run.finished) in (0, 130) and not self._believable:
            self._say(run.now_s, f"{run.finished.name}, although the pump does not obey")
        if (
            not self._believable
            and math.isnan(wrong.vent_stuck_fraction)
            and self._plant.vent_given < 1
        ):
            self._say(run.now_s, "the pump does not obey the stop, and the vent is shut")

    @property
    def _obeys(self) -> bool:
        return math.isnan(self._bench.wrong.pump_stuck_fraction)

    @property
    def _believable(self) -> bool:
        """The pump stands where it should, as far as its read-back shows."""
        readback = self._bench.wrong.readback_fraction
        return math.isnan(readback) or readback == 0

    def _say(self, now_s: float, what: str) -> None:
        if len(self.violations) < 10:
            self.violations.append(f"{now_s:.2f} s in {self.state.name.lower()}: {what}")

    def _look_at_tick(self, tick: VirtualTick, now_s: float) -> None:
        row, before = tick.row, self.state
        self.state, safe_level = State(int(row.state)), SafeLevel(int(row.safe_level))
        self._look_for_repeated_events({event.kind for event in tick.events}, now_s)
        for event in tick.events:
            if isinstance(event, Fault):
                self.names[float(event.code)] = event.name
            if len(json.dumps(event.to_dict(), allow_nan=False, default=str)) > EVENT_BYTES:
                self._say(now_s, f"an event of kind {event.kind} is too long to be recorded")
        if not (0.0 <= row.pump_fraction <= 1.0 and 0.0 <= row.vent_fraction <= 1.0):
            self._say(now_s, f"wrote pump {row.pump_fraction} and vent {row.vent_fraction}")
        if (
            safe_level < self._safe_level
            and self._safe_level > SafeLevel.HOLD_FLOW
            and self.state == before == State.FAULT
        ):
            self._say(now_s, f"went up from {self._safe_level.name} to {safe_level.name}")
        if (safe_level > SafeLevel.HOLD_FLOW) != (self.state == State.FAULT):
            self._say(now_s, f"{safe_level.name} in {self.state.name}")
        if (row.fault == 0) != (safe_level == SafeLevel.NONE):
            self._say(now_s, f"{safe_level.name} with fault code {row.fault:g}")
        self._look_at_fault(before, row.fault, now_s)
        self._safe_level = safe_level
        self.deepest = max(self.deepest, safe_level)
        if not self.code and not math.isnan(self._begun_s):
            self.code = row.fault

    def _look_for_repeated_events(self, kinds: set[str], now_s: float) -> None:
        self._ticks_in_a_row = {kind: self._ticks_in_a_row.get(kind, 0) + 1 for kind in kinds}
        for kind, ticks in self._ticks_in_a_row.items():
            if ticks == _REPEATED_TICKS:
                self._say(now_s, f"an event of kind {kind} is raised in each tick")

    def _look_at_fault(self, before: State, code: float, now_s: float) -> None:
        """In `fault` the first cause stays; without a person, only the resume rule leads out."""
        if self.state == State.FAULT:
            if before != State.FAULT:
                self._fault_s, self._fault_pump = now_s, self._plant.pump_given
                self._fault_code = code
            if code != self._fault_code:
                self._say(now_s, f"first cause {self._fault_code:g} became {code:g}")
            return
        self._fault_s = math.nan
        if before != State.FAULT:
            return
        self._restarts += 1
        if not self._resumes:
            self._say(now_s, "left the fault, and nobody had asked")
        if self._restarts > RESUMES_A_DAY:
            self._say(now_s, f"resumed {self._restarts} times within a day")
        if self._vented:
            self._say(now_s, "resumed after the vent was open")
        seen = (
            self._state_then in MOVING and not self._case.hidden
        )  # else the fault has another cause
        if now_s - self.wrong_s < RESUME_WAIT_S - _SLACK_S and seen:
            self._say(now_s, f"resumed {now_s - self.wrong_s:.2f} s after its cause")

    def _look_at_board(self, now_s: float) -> None:
        board, wrong, plant = self._bench.board, self._bench.wrong, self._plant
        quiet_s = now_s - self._last_tick_s
        if quiet_s > WATCHDOG_S + 2 * self._tick_s and board.pump_fraction > 0:
            self._say(now_s, f"no tick for {quiet_s:.2f} s and the board still pumps")
        if (
            self.state == State.FAULT
            and plant.vent_given >= 1
            and math.isnan(wrong.vent_stuck_fraction)
        ):
            self._vented = True
        if quiet_s > 0:
            board.read(
                _LATCHED_FAULTS, 1
            )  # another program reads: that proves no living controller
        seen_pa = self._bench.truth.gauge_pressure_pa + wrong.gauge_offset_pa
        if (
            seen_pa > BOARD_PRESSURE_MAX_PA + _GAUGE_SLACK_PA
            and not wrong.gauge_lost
            and not wrong.samples_frozen
        ):
            self._vented = self._board_vents = True
        if self._board_vents and plant.vent_given < 1 and math.isnan(wrong.vent_stuck_fraction):
            self._say(now_s, "the board was above its own limit, and the vent is shut")
        if self._vented and self._obeys and plant.pump_given > 0:
            self._say(now_s, "the pump runs after the vent was open")

    def _look_at_pressure_and_sag(self, now_s: float) -> None:
        truth, case, wrong = self._plant.truth(), self._case, self._bench.wrong
        unseen = not self._obeys and (wrong.unreachable or wrong.stalled)  # nobody can do anything
        hidden_pa = max(0.0, -wrong.gauge_offset_pa) if not wrong.gauge_lost else math.inf
        board_max_pa = max(self._gauge_max_pa, BOARD_PRESSURE_MAX_PA) + hidden_pa + _GAUGE_SLACK_PA
        if truth.gauge_pressure_pa > board_max_pa:
            self._say(
                now_s, f"gauge pressure {truth.gauge_pressure_pa:.1f} Pa, above the board's limit"
            )
        ended = self._ended and not self._obeys  # from then on only the board's own limit protects
        if unseen or ended:
            return
        if not case.gauge_lies and truth.gauge_pressure_pa > self._gauge_max_pa + _GAUGE_SLACK_PA:
            self._say(now_s, f"gauge pressure {truth.gauge_pressure_pa:.1f} Pa")
        blind = wrong.no_light or wrong.silent or wrong.unreachable
        seen = not blind and not case.laser_lies and math.isnan(wrong.vent_stuck_fraction)
        if (
            seen
            and truth.displacement_um > DISPLACEMENT_MAX_UM + _OVERSHOOT_UM
            and self._plant.vent_given < 1
        ):
            self._say(now_s, f"the bowl is at {truth.displacement_um:.1f} µm and the vent is shut")
        if not blind:
            self._blind_s = math.nan
        elif math.isnan(self._blind_s):
            self._blind_s, self._blind_um = now_s, truth.displacement_um
        elif (
            self._obeys and case.door_pa == 0 and truth.displacement_um > self._blind_um + _BLIND_UM
        ):
            self._say(
                now_s,
                f"blind, and the bowl went from {self._blind_um:.1f} to "
                f"{truth.displacement_um:.1f} µm",
            )

    def _look_at_the_way_down(self, now_s: float) -> None:
        """The pump is off where it must be, stops in time, and the vent opens in time."""
        given, wrong = self._plant.pump_given, self._bench.wrong
        reached = not (wrong.unreachable or wrong.stalled) and now_s == self._last_tick_s
        self._still_ticks = (
            self._still_ticks + 1
            if self.state in _STILL or self._safe_level >= SafeLevel.PUMP_OFF
            else 0
        )
        self._look_at_mean_flow(reached, now_s)
        raised = self._case.raises and self._state_then != State.FAULT and now_s > self._begun_s
        if raised and given > 0:
            self._say(now_s, "the code has raised, and the pump is driven")
        if self._obeys and reached and self._still_ticks > 2 and given > 0:
            self._say(now_s, f"the pump is driven with {given:.2f} on {self._safe_level.name}")
        blind_s = 0.0 if math.isnan(self._blind_s) else now_s - self._blind_s
        if (
            blind_s > HOLD_FLOW_S + RAMP_S + _SLACK_S
            and self._obeys
            and given > 0
            and not wrong.stalled
        ):
            self._say(now_s, f"blind for {blind_s:.1f} s and the pump runs")
        if math.isnan(self._fault_s):
            return
        age_s = now_s - self._fault_s
        ramp = self._fault_pump * max(0.0, 1.0 - (age_s - 2 * self._tick_s) / RAMP_S)
        if self._obeys and reached and given > ramp + 1e-3:
            self._say(now_s, f"{age_s:.1f} s in the fault the pump is driven with {given:.2f}")
        self._look_at_vent(
            age_s > RAMP_S + PUMP_OFF_S + _SLACK_S or self._safe_level == SafeLevel.VENT,
            reached,
            now_s,
        )

    def _look_at_mean_flow(self, reached: bool, now_s: float) -> None:
        """On HOLD_FLOW the pump gives its mean flow: after a second for the rate limit, it is
        steady.
        """
        steady = self._safe_level == SafeLevel.HOLD_FLOW and self._obeys and reached
        self._held_ticks = self._held_ticks + 1 if steady else 0
        if self._held_ticks * self._tick_s < 1.0:
            self._held_pump = self._plant.pump_given
        elif abs(self._plant.pump_given - self._held_pump) > _STEADY:
            self._say(
                now_s,
                f"the mean flow went from {self._held_pump:.2f} to {self._plant.pump_given:.2f}",
            )

    def _look_at_vent(self, must_be_open: bool, reached: bool, now_s: float) -> None:
        stuck = not math.isnan(self._bench.wrong.vent_stuck_fraction)
        if must_be_open and reached and not stuck and self._plant.vent_given < 1:
            self._say(now_s, f"the vent is shut on {self._safe_level.name}")

    def _look_at_reaction(self, now_s: float) -> None:
        if math.isnan(self._begun_s):
            return
        if self._safe_level > SafeLevel.NONE and math.isnan(self.reaction_s):
            self.reaction_s = now_s - self._begun_s
        reaction = self._case.reaction(self._state_then)
        if reaction is None or "stalled" in self._case.wrong:
            return
        age_s = now_s - self._begun_s - reaction.within_s
        if self._bench.wrong.unreachable:
            age_s -= WATCHDOG_S  # which stops the pump
        if not self._met and self._safe_level >= reaction.safe_level:
            self._met = True
        elif not self._met and now_s - self._begun_s > reaction.within_s + 1e-9:
            self._met = True  # report it once
            self._say(
                now_s,
                f"on {self._safe_level.name}, not on {reaction.safe_level.name} "
                f"{reaction.within_s:.2f} s after",
            )
        if not self._case.lasting:
            return
        if (
            age_s > OFF_AFTER_S[reaction.safe_level] + _SLACK_S
            and self._obeys
            and self._plant.pump_given > 0
        ):
            self._say(
                now_s,
                f"the pump runs {age_s:.1f} s after it had to be on {reaction.safe_level.name}",
            )
        reached = not self._bench.wrong.unreachable and now_s == self._last_tick_s
        self._look_at_vent(age_s > VENTS_AFTER_S[reaction.safe_level] + _SLACK_S, reached, now_s)
