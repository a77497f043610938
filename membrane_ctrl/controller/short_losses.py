"""Counts faults that are over within a second once they repeat, instead of listing each. Pure.

A laser that loses a few samples every minute trips a rule that only holds the flow, and clears it,
20 times an hour. After some of them in ten minutes one event states that they repeat. From then on
a fault of the same rule is listed only if it lasts longer than a second or reaches a deeper safe
level; an event an hour has the count of the others. What the tick does is the same.
"""

import math
from dataclasses import dataclass, field

from membrane_ctrl.controller.recent_count import RecentCount
from membrane_ctrl.controller.safety import RULES
from membrane_ctrl.model.events import Event, Fault, ShortLosses
from membrane_ctrl.model.state_tree import Count, StateNode

_SHORT_S = 1.0
# More than so many in ten minutes, and they repeat
_REPEATS = 3
_REPORT_S = 3600.0


@dataclass(slots=True)
class ShortLossesState(StateNode):
    """What is counted.

    Attributes
    ----------
    code : int
        Rule of the last short fault; 0 before the first.
    recent : RecentCount
        When its last ones ended.
    counts : bool
        They repeat, and are counted.
    count : int
        Since the last report.
    reported_s : float
        When that was.
    began_s : float
        Begin of the present fault; NaN without one.
    withheld : bool
        It is not listed yet.
    """

    code: Count = 0
    recent: RecentCount = field(default_factory=RecentCount)
    counts: bool = False
    count: Count = 0
    reported_s: float = math.nan
    began_s: float = math.nan
    withheld: bool = False


class ShortLossCounter:
    """Decides which faults that hold the flow are listed.

    Parameters
    ----------
    memory : ShortLossesState, optional
        From the snapshot of an earlier controller; else every fault is listed.
    """

    def __init__(self, memory: ShortLossesState | None = None) -> None:
        self.memory = memory or ShortLossesState()

    def begin_fault(self, fault: Fault, now_s: float) -> list[Event]:
        """Note that a fault that holds the flow begins.

        Parameters
        ----------
        fault : Fault
            The event that would list it.
        now_s : float
            Time of the tick, from which its duration counts.

        Returns
        -------
        list of Event
            The fault; empty while such faults are counted.
        """
        memory = self.memory
        memory.began_s = now_s
        memory.withheld = memory.counts and fault.code == memory.code
        return [] if memory.withheld else [fault]

    def must_list(self, now_s: float, is_deeper: bool) -> bool:
        """Whether a withheld fault is to be listed in this tick.

        Parameters
        ----------
        now_s : float
            Time of the tick: a loss that lasts is listed.
        is_deeper : bool
            Whether the safe level is deeper than that which holds the flow.
        """
        memory = self.memory
        if not memory.withheld or not (is_deeper or now_s - memory.began_s > _SHORT_S):
            return False
        memory.withheld = False
        return True

    def end_fault(self, code: int, ended: Event, now_s: float) -> list[Event]:
        """Note that the cause of a fault that held the flow has gone.

        Parameters
        ----------
        code : int
            Of the fault.
        ended : Event
            What to list.
        now_s : float
            Time of the tick.

        Returns
        -------
        list of Event
            `ended`, or none if the fault is counted.
        """
        memory = self.memory
        events = [] if memory.withheld else [ended]
        if now_s - memory.began_s <= _SHORT_S:
            events += self._count_loss(code, now_s)
        memory.began_s = math.nan
        memory.withheld = False
        return events

    def report_count(self, now_s: float) -> list[Event]:
        """Report once an hour how many were counted; without any, the next ones are listed."""
        memory = self.memory
        if not memory.counts or now_s - memory.reported_s < _REPORT_S:
            return []
        events: list[Event] = []
        if memory.count:
            events.append(self._make_report(now_s - memory.reported_s))
        else:
            memory.counts = False
            memory.recent = RecentCount()
        memory.count = 0
        memory.reported_s = now_s
        return events

    def _count_loss(self, code: int, now_s: float) -> list[Event]:
        """Count a short loss; returns the report with which listing ends, at the first too many."""
        # Only one fault is counted: another one starts its own count, and is listed
        memory = self.memory
        if code != memory.code:
            memory.code = code
            memory.counts = False
            memory.recent = RecentCount()
        if memory.counts:
            memory.count += 1
            return []
        # Each has been listed so far; too many within the hour, and from now on they are counted
        memory.recent.add(now_s, _REPEATS)
        if not memory.recent.too_many(now_s, _REPEATS):
            return []
        memory.counts = True
        memory.count = len(memory.recent.times_s)
        report = self._make_report(now_s - memory.recent.times_s[0])
        memory.count = 0
        memory.reported_s = now_s
        return [report]

    def _make_report(self, over_s: float) -> ShortLosses:
        memory = self.memory
        return ShortLosses(RULES[memory.code].name, memory.count, round(over_s / 60.0, 1))
