"""The safety table: turns a tick's observation into a verdict. No I/O, no clock.
docs/reference/faults.md is made from it.

`Observation` is what a tick shows. Each `Rule` names a cause, how many of the last ticks must show
it (N of M), its limit and the safe level it enters. It is judged on every tick in the states where
it applies. Of several tripped rules the deepest level wins; the operator sees the first cause of a
fault.
"""

import math
from dataclasses import dataclass, field

from firmware_iface.roles import FOREIGN_CLAIM, FOREIGN_PERIOD
from membrane_ctrl.config.schema import LimitsConfig
from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.safety_rule import Rule, join_seen
from membrane_ctrl.controller.state_sets import (
    ALWAYS,
    AT_SETPOINT,
    CONNECTED,
    ESTIMATED,
    GAS_MOVES,
    HOLDING,
    MOVING,
    NOT_YET_FAULT,
)
from membrane_ctrl.model.state_tree import Count, StateNode
from membrane_ctrl.model.telemetry import SafeLevel, State

_FOREIGN = {
    FOREIGN_CLAIM: "another claim is active",
    FOREIGN_PERIOD: "another watchdog period is active",
}
# One bit error must not vent a mirror that takes two hours to fill; in two ticks the pump moves the
# film by 0.2 µm
_TWICE = (2, 3)
# The pump follows with its lag (0.15 s) and a tick or two; the loop's noise hides a constant
# difference in some ticks
_FOLLOWED = (40, 50)
_A_FEW = (3, 3)  # one repeated sample of a busy device is not a fault


TABLE: tuple[Rule, ...] = (
    Rule(
        code=20,
        name="over_pressure",
        cause="gauge pressure above its limit",
        limit="limits.gauge_pressure_max_pa",
        safe_level=SafeLevel.VENT,
        seen_in=_TWICE,
        states=ALWAYS,
        remedy="find what over-filled the mirror before it is inflated again",
        seen=lambda o: f"{o.gauge_pressure_pa:.1f} Pa",
        broken=lambda o, c: o.gauge_pressure_pa > c.gauge_pressure_max_pa,
        unseen=lambda o: math.isnan(o.gauge_pressure_pa),
    ),
    Rule(
        code=21,
        name="over_displacement",
        cause="the bowl is deeper than its limit",
        limit="limits.displacement_max_um",
        safe_level=SafeLevel.VENT,
        seen_in=_TWICE,
        states=ALWAYS,
        remedy="check the laser against a ruler, then the setpoint and the limits",
        seen=lambda o: f"{o.deepest_um:.1f} µm",
        broken=lambda o, c: o.deepest_um > c.displacement_max_um,
        unseen=lambda o: math.isnan(o.deepest_um),
    ),
    Rule(
        code=35,
        name="pump_runs_on",
        cause="the pump does not stop when it is commanded off",
        limit="states.lower_timeout_s",
        safe_level=SafeLevel.VENT,
        states=ALWAYS,
        remedy="cut the pump's power or shut its gas; then check its drive and wiring",
        seen=lambda o: o.runs_on,
        broken=lambda o, c: bool(o.runs_on),
    ),
    Rule(
        code=36,
        name="gas_comes_in",
        cause="the mirror rises although the pump is commanded off",
        limit="30 µm in 20 s beyond what the weather explains",
        safe_level=SafeLevel.VENT,
        states=ALWAYS - MOVING,
        remedy="cut the pump's power or shut its gas: its read-back may be wrong, or gas comes "
        "another way",
        seen=lambda o: o.inflow,
        broken=lambda o, c: bool(o.inflow),
    ),
    Rule(
        code=51,
        name="locked",
        cause="a person has locked the mirror",
        limit="ctl unlock",
        safe_level=SafeLevel.PUMP_OFF,
        states=CONNECTED | {State.FAULT},
        remedy="ask the person who locked it whether the mirror may move, then `ctl unlock`",
        seen=lambda o: o.locked,
        broken=lambda o, c: bool(o.locked),
    ),
    # 1 of 1: an open circuit is a demand to stop. A bouncing contact is to be filtered in its own
    # hardware
    Rule(
        code=60,
        name="interlock_open",
        cause="the circuit of an interlock is open, or its signal is lost",
        limit="devices.interlocks",
        safe_level=SafeLevel.RAMP_DOWN,
        states=GAS_MOVES | {State.FAULT},
        remedy="follow the interlock's text, close its circuit, then acknowledge the fault",
        seen=lambda o: o.interlock_words,
        broken=lambda o, c: o.open_interlocks != 0,
        deepens=lambda o: o.interlock_level,
        enters="its own: ramp_down, pump_off or vent",
    ),
    Rule(
        code=50,
        name="tick_error",
        cause="the control code raised an error",
        limit="none may happen",
        safe_level=SafeLevel.PUMP_OFF,
        states=NOT_YET_FAULT,
        remedy="report it with the run folder",
        seen=lambda o: o.tick_error,
        broken=lambda o, c: bool(o.tick_error),
    ),
    Rule(
        code=41,
        name="dead_task",
        cause="a task of the control process ended",
        limit="none may end",
        safe_level=SafeLevel.PUMP_OFF,
        states=NOT_YET_FAULT,
        remedy="report it with the run folder",
        seen=lambda o: ", ".join(o.dead_tasks),
        broken=lambda o, c: bool(o.dead_tasks),
    ),
    Rule(
        code=30,
        name="link_lost",
        cause="the link to the pump board is down",
        limit="must be up",
        safe_level=SafeLevel.PUMP_OFF,
        states=CONNECTED,
        may_resume=True,
        remedy="check cable, power and address; a board's watchdog stops its pump",
        seen=lambda o: o.link.message,
        broken=lambda o, c: not o.link_up,
    ),
    Rule(
        code=31,
        name="device_silent",
        cause="the link is up, but the device gave no valid answer in time",
        limit="limits.stale_s",
        safe_level=SafeLevel.PUMP_OFF,
        states=CONNECTED,
        may_resume=True,
        remedy="mend the link as its message states; a board's watchdog stops its pump",
        seen=lambda o: join_seen(f"{o.reading_age_s:.2f} s", o.link.message),
        broken=lambda o, c: o.reading_age_s > c.stale_s,
    ),
    Rule(
        code=37,
        name="board_taken",
        cause="the board's claim or watchdog is no longer as this run set it",
        limit="as set by this run",
        safe_level=SafeLevel.PUMP_OFF,
        states=NOT_YET_FAULT,
        remedy="find the other program that controls the board, and stop one of the two",
        seen=lambda o: " and ".join(words for bit, words in _FOREIGN.items() if o.foreign & bit),
        broken=lambda o, c: o.foreign != 0,
    ),
    # before `watchdog_tripped`: the same, with the cause that the link's own times show
    Rule(
        code=38,
        name="watchdog_by_link",
        cause="the board's watchdog stopped the pump while the link held up the program",
        limit="limits.lateness_max_ms",
        safe_level=SafeLevel.PUMP_OFF,
        states=CONNECTED,
        may_resume=True,
        remedy="find why the device or the network answers late; this machine is not the cause",
        seen=lambda o: join_seen(o.link.explain_wait(), o.link.message),
        broken=lambda o, c: (
            o.watchdog_tripped and (o.link.wait_ms > c.lateness_max_ms or bool(o.link.message))
        ),
    ),
    Rule(
        code=32,
        name="watchdog_tripped",
        cause="the board's watchdog stopped the pump",
        limit="must not trip",
        safe_level=SafeLevel.PUMP_OFF,
        states=CONNECTED,
        may_resume=True,
        remedy="check the lateness in the recording; the machine may be overloaded",
        broken=lambda o, c: o.watchdog_tripped,
    ),
    Rule(
        code=33,
        name="board_fault",
        cause="the board has latched a fault",
        limit="must be 0",
        safe_level=SafeLevel.PUMP_OFF,
        states=CONNECTED,
        remedy="read the board's fault bits (docs/reference/registers.md)",
        seen=lambda o: f"bits {o.board_faults:#x}",
        broken=lambda o, c: o.board_faults != 0,
    ),
    Rule(
        code=34,
        name="pump_mismatch",
        cause="the pump's read-back does not follow its command",
        limit="0.05 of full scale",
        safe_level=SafeLevel.PUMP_OFF,
        seen_in=_FOLLOWED,
        remedy="check the pump's drive and its limits on the board",
        broken=lambda o, c: o.pump_mismatch > 0.05,
    ),
    Rule(
        code=12,
        name="displacement_frozen",
        cause="the device answers, but its samples do not advance",
        limit="limits.stale_s",
        safe_level=SafeLevel.HOLD_FLOW,
        may_resume=True,
        remedy="restart the sensor",
        seen=lambda o: f"{o.advance_age_s:.2f} s",
        broken=lambda o, c: o.advance_age_s > c.stale_s,
    ),
    Rule(
        code=11,
        name="film_unseen",
        cause="no figure of the film on a bench held without a laser",
        limit="1 s, or 5 frames",
        safe_level=SafeLevel.HOLD_FLOW,
        may_resume=True,
        remedy="look at camera and screen; nothing else sees the film well enough to hold it",
        seen=lambda o: o.unseen_film,
        broken=lambda o, c: bool(o.unseen_film),
    ),
    Rule(
        code=14,
        name="laser_implausible",
        cause="camera and gauge agree that the laser is wrong",
        limit="shape.disagreement_max_um",
        safe_level=SafeLevel.HOLD_FLOW,
        states=ESTIMATED,
        remedy="look for a knocked laser mount; then take a new reference with `ctl shape off` and "
        "`ctl shape on`",
        seen=lambda o: o.laser_fault_text,
        broken=lambda o, c: bool(o.laser_fault_text) and not o.held_by_optics,
    ),
    Rule(
        code=18,
        name="laser_gauge_apart",
        cause="laser (or optics, without a laser) and gauge contradict each other",
        limit="limits.laser_gauge_apart_max_um (2 min), laser_gauge_drift_max_um (1 h), "
        "laser_gauge_day_max_um (24 h); pressure within a factor of 2 of the sag's",
        safe_level=SafeLevel.RAMP_DOWN,
        states=CONNECTED,
        remedy="find which of them is wrong: laser mount, gauge hose, units; for another film set "
        "[optics.mirror] "
        "sag_mm and pressure_pa; if temperature or humidity of the room have changed, wait until "
        "they are steady, and connect a film thermometer and a hygrometer",
        seen=lambda o: o.laser_gauge_apart,
        broken=lambda o, c: bool(o.laser_gauge_apart),
    ),
    Rule(
        code=16,
        name="gauge_stuck",
        cause="the gauge repeats one value to the last bit",
        limit="limits.gauge_stuck_s",
        safe_level=SafeLevel.RAMP_DOWN,
        remedy="restart the gauge; if it filters its noise below its own resolution raise "
        "limits.gauge_stuck_s",
        seen=lambda o: f"{o.gauge_pressure_pa:.1f} Pa for {o.gauge_same_s:.0f} s",
        broken=lambda o, c: o.gauge_same_s > c.gauge_stuck_s,
        unseen=lambda o: math.isnan(o.gauge_pressure_pa),
    ),
    Rule(
        code=19,
        name="gas_excess",
        cause="the film takes far more gas than before, and no camera sees it stand still",
        limit="limits.leak_growth_max",
        safe_level=SafeLevel.RAMP_DOWN,
        states=HOLDING,
        remedy="look for an opening seam, then for a laser that creeps: compare it with a ruler",
        seen=lambda o: o.gas_excess,
        broken=lambda o, c: bool(o.gas_excess),
    ),
    Rule(
        code=17,
        name="gauge_jump",
        cause="the gauge reading jumped further than a film can",
        limit="limits.gauge_step_max_pa",
        safe_level=SafeLevel.HOLD_FLOW,
        seen_in=(5, 10),
        remedy="look at the gauge's hose and plug",
        seen=lambda o: f"{o.gauge_pressure_pa:.1f} Pa",
        broken=lambda o, c: o.gauge_jumps > 0,
    ),
    Rule(
        code=15,
        name="displacement_stuck",
        cause="the laser repeats one value to the last bit",
        limit="limits.stuck_s",
        safe_level=SafeLevel.HOLD_FLOW,
        remedy="restart the sensor; with coarse steps and a calm mirror raise limits.stuck_s",
        seen=lambda o: f"{o.same_s:.1f} s",
        broken=lambda o, c: o.displacement_valid and o.same_s > c.stuck_s and not o.held_by_optics,
    ),
    Rule(
        code=13,
        name="displacement_jump",
        cause="the laser reading jumped further than a film can",
        limit="limits.step_max_um",
        safe_level=SafeLevel.HOLD_FLOW,
        seen_in=(5, 10),
        may_resume=True,
        remedy="look for something in the beam or a bumped laser",
        broken=lambda o, c: o.jumps > 0 and not o.held_by_optics,
    ),
    # before `displacement_missing`: the laser is judged only by its answers
    Rule(
        code=27,
        name="no_answer",
        cause="no valid answer from the device that measures the displacement, or from the pump",
        limit="3 ticks in a row",
        safe_level=SafeLevel.HOLD_FLOW,
        seen_in=_A_FEW,
        may_resume=True,
        remedy="mend the link as its message states; nothing is known of the laser",
        seen=lambda o: o.link.explain_silence("displacement"),
        broken=lambda o, c: o.is_unanswered,
    ),
    Rule(
        code=10,
        name="displacement_missing",
        cause="no valid laser reading",
        limit="3 ticks in a row",
        safe_level=SafeLevel.HOLD_FLOW,
        seen_in=_A_FEW,
        may_resume=True,
        remedy="check the laser's aim and its error code",
        broken=lambda o, c: not o.displacement_valid,
    ),
    Rule(
        code=24,
        name="pressure_missing",
        cause="no gauge pressure",
        limit="every tick",
        safe_level=SafeLevel.RAMP_DOWN,
        seen_in=(10, 10),
        may_resume=True,
        remedy="check the pressure sensor: without it over-pressure is not seen",
        seen=lambda o: o.link.explain_silence("gauge_pressure"),
        broken=lambda o, c: not math.isfinite(o.gauge_pressure_pa) and o.reading_age_s == 0,
        unseen=lambda o: o.reading_age_s > 0,
    ),
    Rule(
        code=22,
        name="under_displacement",
        cause="the bowl is shallower than its limit",
        limit="limits.displacement_min_um",
        safe_level=SafeLevel.RAMP_DOWN,
        seen_in=_TWICE,
        states=HOLDING,
        remedy="look for a leak or a laser that was moved",
        seen=lambda o: f"{o.shallowest_um:.1f} µm",
        broken=lambda o, c: o.shallowest_um < c.displacement_min_um,
        unseen=lambda o: math.isnan(o.shallowest_um),
    ),
    Rule(
        code=23,
        name="following_error",
        cause="the mirror does not follow its setpoint",
        limit="limits.following_error_max_um",
        safe_level=SafeLevel.RAMP_DOWN,
        seen_in=(100, 100),
        states=AT_SETPOINT,
        remedy="look for a leak, a stuck pump or a mirror that is too tight",
        seen=lambda o: f"{o.error_um:.1f} µm",
        broken=lambda o, c: abs(o.error_um) > c.following_error_max_um,
        unseen=lambda o: math.isnan(o.error_um),
    ),
    Rule(
        code=25,
        name="overdue",
        cause="a state took too long",
        limit="[states] time-outs",
        safe_level=SafeLevel.RAMP_DOWN,
        states=CONNECTED,
        remedy="check what it waited for; a fill from flat needs states.inflate_timeout_s of hours",
        seen=lambda o: o.overdue,
        broken=lambda o, c: bool(o.overdue),
    ),
    Rule(
        code=26,
        name="actuator_test",
        cause="the film does not respond to pump or vent",
        limit="3 s (vent), 5 s (pump)",
        safe_level=SafeLevel.PUMP_OFF,
        states={State.CHECK},
        remedy="check hoses, valve and pump, and where the laser points",
        seen=lambda o: o.unfit,
        broken=lambda o, c: bool(o.unfit),
    ),
    # before `late`: without the waiting, the tick would be in time
    Rule(
        code=42,
        name="link_slow",
        cause="the devices answer so late that the mirror cannot be controlled",
        limit="limits.lateness_max_ms",
        safe_level=SafeLevel.RAMP_DOWN,
        seen_in=(5, 10),
        may_resume=True,
        remedy="find why the device or the network answers late; this machine is not the cause",
        seen=lambda o: join_seen(o.link.explain_wait(), o.link.message),
        broken=lambda o, c: o.is_late_by_link(c.lateness_max_ms),
    ),
    Rule(
        code=40,
        name="late",
        cause="ticks start too late to control the mirror",
        limit="limits.lateness_max_ms",
        safe_level=SafeLevel.RAMP_DOWN,
        seen_in=(5, 10),
        may_resume=True,
        remedy="move other work off this machine",
        seen=lambda o: join_seen(f"{o.lateness_ms:.0f} ms", o.link.explain_wait()),
        broken=lambda o, c: o.lateness_ms > c.lateness_max_ms,
    ),
)
RULES: dict[int, Rule] = {rule.code: rule for rule in TABLE}


@dataclass(frozen=True, slots=True)
class Verdict:
    """The rule that tripped (None: safe) and the observed value in words."""

    rule: Rule | None
    seen: str = ""
    safe_level: SafeLevel = SafeLevel.NONE  # that it enters


@dataclass(slots=True)
class SafetyState(StateNode):
    """The last M relevant ticks of each rule."""

    # By the rule's code: bit i is set if the i-th last tick showed the cause. Rules without a set
    # bit are not in it.
    history: dict[Count, Count] = field(default_factory=dict)


class SafetyTable:
    """Judges observations by the table; remembers only the last M relevant ticks of each rule."""

    def __init__(
        self,
        limits: LimitsConfig,
        table: tuple[Rule, ...] = TABLE,
        memory: SafetyState | None = None,
    ) -> None:
        self._limits = limits
        self._applying = {
            state: tuple(rule for rule in table if state in rule.states) for state in State
        }
        self._codes = {
            state: {rule.code for rule in rules} for state, rules in self._applying.items()
        }
        self.memory = memory or SafetyState()

    def judge(self, state: State, observation: Observation) -> Verdict:
        """Judge an observation by all rules: every history is complete.

        Returning simply the first would let a lost laser, which only holds the flow, hide a lost
        pressure sensor.

        Parameters
        ----------
        state : State
            Of the controller: each rule states in which ones it applies.
        observation : Observation
            What this tick shows; each rule keeps the history that its window needs.

        Returns
        -------
        Verdict
            The tripped rule with the deepest level, the first of equals.
        """
        tripped: Rule | None = None
        deepest = SafeLevel.NONE
        histories = self.memory.history
        # A rule that does not apply forgets.
        for code in list(histories):
            if code not in self._codes[state]:
                del histories[code]
        for rule in self._applying[state]:
            broken = rule.broken(observation, self._limits)
            if not broken and rule.code not in histories:
                continue  # nearly always
            if rule.unseen(observation):
                continue
            # A bit for each tick of the rule's window.
            history = ((histories.pop(rule.code, 0) << 1) | broken) & ((1 << rule.window) - 1)
            if history:
                histories[rule.code] = history
            # N of M ticks: the deepest level wins, then the first rule.
            safe_level = rule.find_safe_level(observation)
            if history.bit_count() >= rule.needed_ticks and safe_level > deepest:
                tripped, deepest = rule, safe_level
        return Verdict(tripped, tripped.seen(observation) if tripped else "", deepest)
