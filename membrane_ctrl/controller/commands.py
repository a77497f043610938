"""What may be asked of a running hold: by whom, in which states, and why not.

One table for the control port, the command line and the controller. A refusal is a sentence for a person.
"""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.control.experiments.trial import ExperimentSpec
from membrane_ctrl.controller.safety import MOVING
from membrane_ctrl.model.states import State

Kind = Literal[
    "hold", "stop", "pause", "resume", "manual", "setpoint", "gains",
    "shape_on", "shape_off", "mark", "ack", "lower", "vent", "tune", "keep", "latch", "capture",
]  # fmt: skip
Role = Literal["read", "operate", "tune"]

# Who asks for what `hold` begins with
AT_START = "command line"
# Gains on trial are watched by whoever asked for them; longer than this nobody watches.
TRIAL_MAX_S = 7200.0

# Of the commands of one tick these come first, in this order: the safest wins, whoever was first
DOWN: tuple[Kind, ...] = ("latch", "vent", "stop", "lower")
# and in the same tick none of these is obeyed: what lifts the mirror, or lets it be lifted, is asked for again
_OVERRULED: frozenset[str] = frozenset({"hold", "manual", "tune", "resume", "ack"})

ANY = frozenset(State)
RUNNING = MOVING | {State.STANDBY, State.CHECK}


@dataclass(frozen=True, slots=True)
class Command:
    """What a person or program asks for.

    Attributes
    ----------
    kind : str
        One of `TABLE`, or "resumed": a resume within the last day, by an earlier run. Only a run's start tells it.
    who, why : str
        Recorded with it.
    value : float
        `setpoint`: um. `manual`: flow in um/s of the centre. `gains`: seconds until they go back to what they were,
        unless `keep` comes before; NaN: for good. `resumed`: how many seconds ago.
    text : str
        `mark`: what to write on the timeline. `latch`: the fault.
    loop : LoopConfig or None
        `gains`: the loop's new settings, whole.
    experiment : ExperimentSpec or None
        `tune`: what to do.
    number : int
        Given by the asker, returned with the answer.
    """

    kind: Kind | Literal["resumed"]
    who: str
    why: str = ""
    value: float = math.nan
    text: str = ""
    loop: LoopConfig | None = None
    experiment: ExperimentSpec | None = None
    number: int = 0


@dataclass(frozen=True, slots=True)
class Rule:
    """One row: the role it takes, the states where it makes sense."""

    role: Role
    states: Collection[State]


TABLE: dict[Kind, Rule] = {
    "hold": Rule("operate", {State.STANDBY, State.MANUAL, State.TUNE}),
    "stop": Rule("operate", ANY),
    "pause": Rule("operate", {State.HOLD}),
    "resume": Rule("operate", {State.HOLD}),
    "manual": Rule("operate", {State.SETTLE, State.HOLD, State.MANUAL}),
    "setpoint": Rule("operate", RUNNING),
    "gains": Rule("tune", RUNNING),
    "keep": Rule("tune", RUNNING),
    "tune": Rule("tune", {State.HOLD}),
    "shape_on": Rule("operate", ANY),
    "shape_off": Rule("operate", ANY),
    "mark": Rule("operate", ANY),
    "ack": Rule("operate", {State.STANDBY, State.FAULT}),
    "latch": Rule("operate", ANY),  # a fault of an earlier run, or a person's lock: no hold before `ack`
    "lower": Rule("operate", RUNNING),
    "vent": Rule("operate", ANY),
    "capture": Rule("operate", {State.HOLD}),  # a full set, written by the acquisition
}


def in_order(commands: Iterable[Command]) -> list[Command]:
    """The commands of a tick, the safest first; the others as they came."""
    return sorted(commands, key=lambda command: DOWN.index(command.kind) if command.kind in DOWN else len(DOWN))


def overruled(command: Command, obeyed: Collection[str]) -> str:
    """What of this tick's obeyed commands keeps this one from being obeyed, as a refusal; empty if nothing does."""
    winner = next((kind for kind in DOWN if kind in obeyed), "")
    if command.kind not in _OVERRULED or not winner:
        return ""
    return f"{winner} came at the same time and wins; ask again"


def refusal(command: Command, state: State, config: Config) -> str:
    """Why a command cannot be obeyed now; empty if it can."""
    if command.kind == "resumed":
        return "" if command.who == AT_START else "only the start of a run tells of resumes"
    rule = TABLE[command.kind]
    if state not in rule.states:
        where = ", ".join(sorted(s.name.lower() for s in rule.states))
        return f"{command.kind} makes no sense in state {state.name.lower()}; it does in {where}"
    if command.kind == "setpoint":
        low, high = config.limits.displacement_min_um, config.limits.displacement_max_um
        if not low < command.value < high:
            return f"setpoint {command.value:g} um is outside the limits ({low:g} .. {high:g} um)"
    if command.kind == "manual" and not 0.0 <= command.value <= config.loop.flow_max_um_per_s:
        return f"flow {command.value:g} um/s is outside 0 .. {config.loop.flow_max_um_per_s:g} um/s"
    if command.kind == "tune" and command.experiment is None:
        return "tune without an experiment"
    if command.kind == "gains" and command.loop is None:
        return "gains without gains"
    if command.kind == "gains" and not (math.isnan(command.value) or 1.0 <= command.value <= TRIAL_MAX_S):
        return f"gains on trial for {command.value:g} s: 1 .. {TRIAL_MAX_S:g} s are possible"
    if command.kind == "gains" and command.loop is not None and command.loop.rate_hz != config.loop.rate_hz:
        return "the tick rate cannot be changed while it ticks"
    if command.kind == "capture" and not config.shape.enabled:
        return "no camera measures in this run: [shape] enabled = false"
    return ""


# Gains on trial: they go back to the last good ones unless somebody says in time that they may stay.
#
# The one who tries them may lose its connection or be killed; the loop must then not be left with gains that nobody
# has verified (docs/decisions/78-gains-on-trial.md).


class GainsTrial:
    """Remembers the last good gains.

    Parameters
    ----------
    loop : LoopConfig
        The gains that a run begins with are good.
    """

    def __init__(self, loop: LoopConfig) -> None:
        self._good = self._tried = loop
        self._until_s = math.nan

    @property
    def on_trial(self) -> bool:
        """The present gains have not been kept yet."""
        return math.isfinite(self._until_s)

    def begin(self, loop: LoopConfig, now_s: float, trial_s: float) -> None:
        """New gains: for `trial_s` seconds unless kept, or for good if that is NaN."""
        self._tried = loop
        self._until_s = now_s + trial_s
        if not self.on_trial:
            self._good = loop

    def keep(self) -> None:
        """The present gains are good."""
        self._good, self._until_s = self._tried, math.nan

    def overdue(self, now_s: float) -> bool:
        """Nobody has kept them in time."""
        return now_s >= self._until_s

    def revert(self) -> LoopConfig:
        """The last good gains, which are the present ones from now on."""
        self._tried, self._until_s = self._good, math.nan
        return self._good
