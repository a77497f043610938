"""Which interlocks are open in a tick, and which safe level that demands. No I/O, no clock.

A tick without an answer of the bench shows no interlock: the rules `link_lost` and `device_silent`
judge that. A lost signal of a single interlock is a set bit of the reading, as an open circuit is.

In standby the pump is off and an open interlock is no fault: people work at the mirror then. It
prevents a hold. On the way down from standby it stays none, so that a program can be ended while a
door is open.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from firmware_iface.roles import BenchReading
from firmware_iface.settings import InterlockConfig
from membrane_ctrl.model.events import Event, InterlockClosed, InterlockOpened
from membrane_ctrl.model.state_tree import Count, StateNode
from membrane_ctrl.model.telemetry import SafeLevel, State


@dataclass(slots=True)
class InterlocksState(StateNode):
    """Masks of the open interlocks, by earlier readings."""

    standby_mask: Count = 0  # open without a break since standby
    last_mask: Count = 0  # open in the last reading, which may be of an earlier tick


class Interlocks:
    """The interlocks of a configuration; bit i of each mask is the i-th of them.

    Attributes
    ----------
    open_mask : int
        Those that are open in this tick's reading; 0 in a tick without one.
    judged_mask : int
        Of these, the ones that are a fault in a state that judges interlocks.
    seen : bool
        This tick has a reading.
    """

    def __init__(
        self, configured: tuple[InterlockConfig, ...], memory: InterlocksState | None = None
    ) -> None:
        self.memory = memory or InterlocksState()
        self._names: tuple[str, ...] = tuple(interlock.name for interlock in configured)
        self._texts: tuple[str, ...] = tuple(interlock.text for interlock in configured)
        levels = (SafeLevel[interlock.safe_level.upper()] for interlock in configured)
        self._levels: tuple[SafeLevel, ...] = tuple(levels)
        self.open_mask = 0
        self.judged_mask = 0
        self.seen = False

    @property
    def last_mask(self) -> int:
        """Those that were open in the last reading, which may be of an earlier tick."""
        return self.memory.last_mask

    def observe_reading(self, reading: BenchReading | None, state: State) -> list[Event]:
        """Take the reading of a tick.

        Parameters
        ----------
        reading : BenchReading or None
            None without one: the circuits stay as they were.
        state : State
            Of the controller.

        Returns
        -------
        list of Event
            Of circuits that have opened or closed.
        """
        # Without a reading nothing is judged: rules on the link and on stale readings act then
        self.seen = reading is not None
        if reading is None:
            self.open_mask = 0
            self.judged_mask = 0
            return []
        self.open_mask = reading.interlocks_open & ((1 << len(self._names)) - 1)
        memory = self.memory
        changed = self.open_mask ^ memory.last_mask
        memory.last_mask = self.open_mask
        # A circuit that was open in standby is no fault of the way down: a person who works at the
        # bench has opened it, and may stop the run
        if state == State.STANDBY:
            memory.standby_mask = self.open_mask
        memory.standby_mask &= self.open_mask
        self.judged_mask = self.open_mask
        if state == State.LOWER:
            self.judged_mask &= ~memory.standby_mask
        return [self._make_event(place) for place in _iterate_set_bits(changed)]

    def _make_event(self, place: int) -> Event:
        if not self.open_mask >> place & 1:
            return InterlockClosed(self._names[place])
        return InterlockOpened(
            self._names[place], self._texts[place], self._levels[place].name.lower()
        )

    @property
    def any_configured(self) -> bool:
        """Whether there are interlocks."""
        return bool(self._names)

    @property
    def safe_level(self) -> SafeLevel:
        """The deepest level that the judged interlocks demand."""
        return max(
            (self._levels[place] for place in _iterate_set_bits(self.judged_mask)),
            default=SafeLevel.NONE,
        )

    def describe_open(self, mask: int) -> str:
        """Names and texts of the interlocks of a mask, for people; empty for none."""
        return "; ".join(
            f"interlock {self._names[place]} is open: {self._texts[place]}"
            for place in _iterate_set_bits(mask)
        )


def _iterate_set_bits(mask: int) -> Iterator[int]:
    """Yield the places of the set bits, lowest first."""
    for place in range(mask.bit_length()):
        if mask >> place & 1:
            yield place
