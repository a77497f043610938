"""The invariants of the campaign, looked at on every tick."""

from __future__ import annotations

import json
import math

from campaign_cases import DISPLACEMENT_MAX_UM, GAUGE_PRESSURE_MAX_PA, Case

from firmware_iface.emulators.board_state import GAUGE_PRESSURE_LIMIT_PA
from membrane_ctrl.config import Config
from membrane_ctrl.names import Rung, State
from membrane_ctrl.safety import MOVING, TABLE
from membrane_ctrl.virtual.bench import VirtualBench
from membrane_ctrl.virtual.run import VirtualRun, VirtualTick

_NAMES = {float(rule.code): rule.name for rule in TABLE}
_MAY_PUMP = MOVING | {State.CHECK, State.FAULT}
_WATCHDOG_S = 0.5
# two looks and the tick between at full pump, its lag, and three sigma of the reading
_OVERSHOOT_UM = 6.0
_GAUGE_SLACK_PA = 1.5  # three sigma of the gauge
_EVENT_BYTES = 4096


class Watch:
    """Looks at controller, board and truth, and writes down what must not be.

    Attributes
    ----------
    violations : list of str
    state : State
    code : float
        Of the first fault since the injection.
    deepest : Rung
    reaction_s : float
        From the injection to the first safe rung.
    """

    def __init__(self, case: Case, bench: VirtualBench, config: Config) -> None:
        self._case, self._bench = case, bench
        self._tick_s = 1.0 / config.loop.rate_hz
        self._begun_s = math.nan
        self._state_then = State.STANDBY
        self._rung = Rung.NONE
        self._last_tick_s = 0.0
        self._fault_pump = math.inf
        self._fault_code = 0.0
        self._met = False
        self.violations: list[str] = []
        self.state = State.STANDBY
        self.code = 0.0
        self.deepest = Rung.NONE
        self.reaction_s = math.nan

    def begins(self, now_s: float) -> None:
        """The fault sets in."""
        self._begun_s, self._state_then = now_s, self.state

    def look(self, tick: VirtualTick | None, now_s: float) -> None:
        """After every period, whether the control process ran or not."""
        if tick is not None:
            self._last_tick_s = now_s
            self._look_at_tick(tick, now_s)
        self._look_at_board(now_s)
        self._look_at_truth(now_s)
        self._look_at_reaction(now_s)

    def ends(self, run: VirtualRun) -> None:
        """After the last tick."""
        reaction = self._case.reaction(self._state_then)
        stopped = "stalled" in self._case.wrong
        if reaction is not None and not stopped and not self._met:
            self._say(run.now_s, f"never came to {reaction.rung.name}; got to {self.deepest.name}")
        if self._state_then == State.FAULT:
            return  # the first cause is another one, and stays
        if self._case.harmless and self.code:
            self._say(run.now_s, f"{_NAMES[self.code]} although nothing dangerous was wrong")
        if self.code and not self._case.harmless and _NAMES[self.code] not in self._case.said:
            self._say(run.now_s, f"called {_NAMES[self.code]}")

    def _say(self, now_s: float, what: str) -> None:
        if len(self.violations) < 10:
            self.violations.append(f"{now_s:.2f} s in {self.state.name.lower()}: {what}")

    def _look_at_tick(self, tick: VirtualTick, now_s: float) -> None:
        row = tick.row
        self.state, rung = State(int(row.state)), Rung(int(row.rung))
        if not (0.0 <= row.pump_fraction <= 1.0 and 0.0 <= row.vent_fraction <= 1.0):
            self._say(now_s, f"wrote pump {row.pump_fraction} and vent {row.vent_fraction}")
        if row.pump_fraction > 0 and self.state not in _MAY_PUMP:
            self._say(now_s, f"pump at {row.pump_fraction:.2f}")
        if rung >= Rung.PUMP_OFF and row.pump_fraction > 0:
            self._say(now_s, f"pump at {row.pump_fraction:.2f} on {rung.name}")
        if rung == Rung.VENT and row.vent_fraction < 1:
            self._say(now_s, "vent shut on VENT")
        if rung < self._rung and self._rung > Rung.HOLD_FLOW:
            self._say(now_s, f"went up from {self._rung.name} to {rung.name}")
        if (rung > Rung.HOLD_FLOW) != (self.state == State.FAULT):
            self._say(now_s, f"{rung.name} in {self.state.name}")
        if (row.fault == 0) != (rung == Rung.NONE):
            self._say(now_s, f"{rung.name} with fault code {row.fault:g}")
        self._look_at_fault(row.pump_fraction, row.fault, now_s)
        self._rung = rung
        self.deepest = max(self.deepest, rung)
        if not self.code and not math.isnan(self._begun_s):
            self.code = row.fault
        for event in tick.events:
            if len(json.dumps(event, allow_nan=False, default=str)) > _EVENT_BYTES:
                self._say(now_s, f"an event of kind {event['kind']} is too long to be recorded")

    def _look_at_fault(self, pump_fraction: float, code: float, now_s: float) -> None:
        """In `fault` the first cause stays and the pump only ever slows down."""
        if self.state != State.FAULT:
            self._fault_pump, self._fault_code = math.inf, 0.0
            return
        if self._fault_code and code != self._fault_code:
            self._say(now_s, f"first cause {self._fault_code:g} became {code:g}")
        if pump_fraction > self._fault_pump:
            self._say(now_s, "the pump sped up")
        self._fault_pump, self._fault_code = pump_fraction, code

    def _look_at_board(self, now_s: float) -> None:
        board, wrong = self._bench.board, self._bench.wrong
        quiet_s = now_s - self._last_tick_s
        if quiet_s > _WATCHDOG_S + 2 * self._tick_s and board.pump_fraction > 0:
            self._say(now_s, f"no tick for {quiet_s:.2f} s and the board still pumps")
        if self._rung >= Rung.PUMP_OFF and board.pump_fraction > 0 and not wrong.unreachable and quiet_s == 0.0:
            self._say(now_s, f"the board pumps on {self._rung.name}")

    def _look_at_truth(self, now_s: float) -> None:
        truth, case = self._bench.plant.truth(), self._case
        watched = now_s - self._last_tick_s < 5.0
        if truth.gauge_pressure_pa > GAUGE_PRESSURE_LIMIT_PA + _GAUGE_SLACK_PA:
            self._say(now_s, f"gauge pressure {truth.gauge_pressure_pa:.1f} Pa")
        seen = watched and not case.laser_lies and "no_light" not in case.wrong
        if seen and truth.displacement_um > DISPLACEMENT_MAX_UM + _OVERSHOOT_UM:
            self._say(now_s, f"the bowl is at {truth.displacement_um:.1f} um")
        if watched and not case.gauge_lies and truth.gauge_pressure_pa > GAUGE_PRESSURE_MAX_PA + _GAUGE_SLACK_PA:
            self._say(now_s, f"gauge pressure {truth.gauge_pressure_pa:.1f} Pa")

    def _look_at_reaction(self, now_s: float) -> None:
        if math.isnan(self._begun_s):
            return
        if self._rung > Rung.NONE and math.isnan(self.reaction_s):
            self.reaction_s = now_s - self._begun_s
        reaction = self._case.reaction(self._state_then)
        if reaction is None or self._met or "stalled" in self._case.wrong:
            return
        if self._rung >= reaction.rung:
            self._met = True
        elif now_s - self._begun_s > reaction.within_s + 1e-9:
            self._met = True  # say it once
            self._say(now_s, f"on {self._rung.name}, not on {reaction.rung.name} {reaction.within_s:.2f} s after")
