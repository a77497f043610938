"""The circuits of the configured interlocks in virtual time: what opens them, and what cuts their
signals off.

A circuit at an input of the board is a bit of the board's sample, and a lost signal there is an
open circuit. A circuit behind a polled device answers as long as its signal is there; without it
the last answer grows old, by the same rule as on a real bench (`CircuitMemory`).
"""

from firmware_iface.interlocks import CircuitMemory
from firmware_iface.settings import BoardInputConfig, InterlockDriver, PolledInterlockConfig


class VirtualInterlocks:
    """All circuits are closed at first.

    Attributes
    ----------
    open_names, lost_names : set of str
        Names of the interlocks whose circuit is open, and of those whose signal is lost.
    """

    def __init__(self, configured: tuple[InterlockDriver, ...] = ()) -> None:
        self._configured = configured
        self._memories = {
            bit: CircuitMemory(1, interlock.age_max_s)
            for bit, interlock in enumerate(configured)
            if isinstance(interlock, PolledInterlockConfig)
        }
        self.open_names: set[str] = set()
        self.lost_names: set[str] = set()

    def advance(self, now_s: float) -> None:
        """Let every polled device answer whose signal is there."""
        for bit, memory in self._memories.items():
            name = self._configured[bit].name
            if name not in self.lost_names:
                memory.take([name not in self.open_names], now_s)

    def board_word(self, inputs: int) -> int:
        """The board's inputs with those of open circuits cleared."""
        for interlock in self._configured:
            if (
                isinstance(interlock, BoardInputConfig)
                and interlock.name in self.open_names | self.lost_names
            ):
                inputs &= ~(1 << interlock.input)
        return inputs

    def open_mask(self, board_word: int, now_s: float) -> int:
        """Return `BenchReading.interlocks_open`: a bit for each interlock, 1 if it is open.

        Parameters
        ----------
        board_word : int
            The board's inputs, 1 for a closed circuit, as `board_word` makes them.
        now_s : float
            Virtual time, from which the age of a polled device's last answer counts.
        """
        found = 0
        for bit, interlock in enumerate(self._configured):
            if isinstance(interlock, BoardInputConfig):
                is_open = not board_word >> interlock.input & 1
            else:
                (is_open,) = self._memories[bit].open_circuits(now_s)
            found |= is_open << bit
        return found
