"""Interlock circuits that are not inputs of the pump board, added to the readings of any bench.

An interlock is a normally closed circuit: an emergency stop, a door, an oxygen monitor, the
supply's pressure switch. Three rules:

- A source is read by a task of its own, so that the tick never waits for it.
- An answer counts from the moment of its request, and only for `age_max_s`. A source that is slow,
  hangs, answers with errors or was never reached has no younger answer: its circuits count as open.
- A source that cannot be opened does not keep the bench from opening: the pump must remain within
  reach. Its circuits are open, which is enough to prevent a hold.
"""

import asyncio
import contextlib
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from firmware_iface import roles
from firmware_iface.role_bench import answer


class CircuitMemory:
    """The newest answer on each circuit of a source, and when it was asked for.

    Parameters
    ----------
    circuits : int
        How many the source has.
    age_max_s : float
        An answer older than this no longer counts: its circuits are open.
    """

    def __init__(self, circuits: int, age_max_s: float) -> None:
        self._age_max_s = age_max_s
        self._closed = [False] * circuits
        self._asked_s = -math.inf

    def take(self, closed: Sequence[bool], asked_s: float) -> None:
        """Take the answer to a request.

        Parameters
        ----------
        closed : sequence of bool
            Whether each circuit is closed.
        asked_s : float
            When the request was sent: an answer is as old as its question.

        Raises
        ------
        LinkError
            Circuits are missing.
        """
        if len(closed) != len(self._closed):
            raise roles.LinkError(
                f"{len(closed)} circuits in the answer, expected {len(self._closed)}"
            )
        self._closed = [found is True for found in closed]
        self._asked_s = asked_s

    def open_circuits(self, now_s: float) -> list[bool]:
        """Whether each circuit is open, or its signal lost, at a time."""
        age_s = now_s - self._asked_s
        fresh = 0.0 <= age_s <= self._age_max_s
        return [not (fresh and closed) for closed in self._closed]


@dataclass(frozen=True, slots=True)
class PolledSource:
    """A source, and the bit of `BenchReading.interlocks_open` of each of its circuits.

    `period_s` is the interval of the requests, `age_max_s` the age from which an answer no longer
    counts, and `first_s` the longest wait for the first answer when the bench opens.
    """

    source: roles.InterlockSource
    bits: tuple[int, ...]
    period_s: float
    age_max_s: float
    first_s: float


class CircuitPoller:
    """Reads one source periodically, and opens it again after a loss.

    Parameters
    ----------
    polled : PolledSource
        The source, with its period and age limit.
    clock : callable
        Monotonic time, s.
    """

    def __init__(self, polled: PolledSource, clock: roles.Clock = time.monotonic) -> None:
        self.polled = polled
        self._clock = clock
        self._memory = CircuitMemory(len(polled.bits), polled.age_max_s)
        self._opened = False
        self._task: asyncio.Task[None] | None = None
        self.problem = "not read yet"  # why there is no newer answer; empty if there is one

    async def start(self) -> None:
        """Wait for the first answer, not longer than `first_s`, and continue in the background;
        again: no effect.
        """
        if self._task is not None and not self._task.done():
            return
        first = asyncio.Event()
        self._task = asyncio.create_task(
            self._keep_reading(first), name=f"interlocks of {self.name}"
        )
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(first.wait(), self.polled.first_s)

    @property
    def name(self) -> str:
        """The source, for messages."""
        return self.polled.source.describe().get("port", "interlock source")

    @property
    def ended(self) -> bool:
        """Whether the task has ended although it was not stopped."""
        return self._task is not None and self._task.done()

    def open_mask(self) -> int:
        """Bits of the circuits that are open now, or whose signal is lost."""
        open_circuits = self._memory.open_circuits(self._clock())
        return sum(
            1 << bit
            for bit, is_open in zip(self.polled.bits, open_circuits, strict=True)
            if is_open
        )

    async def stop(self) -> None:
        """Stop reading and close the source. Never raises."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        # one driver's mistake must not leave the next device open
        with contextlib.suppress(Exception):
            await self.polled.source.close()
        self._opened = False

    async def _keep_reading(self, first: asyncio.Event) -> None:
        while True:
            begin_s = self._clock()
            await self._read_once()
            first.set()
            took_s = self._clock() - begin_s
            await asyncio.sleep(max(0.0, self.polled.period_s - took_s))

    async def _read_once(self) -> None:
        """One request; a failure leaves the last answer to grow old."""
        # The age of an answer counts from its request, not from its arrival: a slow source must not
        # make an old state look new.
        source = self.polled.source
        try:
            if not self._opened:
                await answer("interlock", source.open())
                self._opened = True
            asked_s = self._clock()
            self._memory.take(await answer("interlock", source.closed_circuits()), asked_s)
        except roles.LinkWaitsError as error:
            # the failure after which it waits states more
            self.problem = self.problem or str(error)
        except roles.LinkError as error:
            self.problem = str(error)
            if isinstance(error, roles.LinkDownError | roles.DeviceRefusedError):
                self._opened = False
        else:
            self.problem = ""


def open_board_inputs(reading: roles.BenchReading, board_inputs: Mapping[int, int]) -> int:
    """Return the interlocks at the board's inputs whose circuits are open, one bit each.

    Parameters
    ----------
    reading : BenchReading
        With the state of all inputs.
    board_inputs : mapping of int
        Input of the board by the interlock's bit, as in `InterlockBench`.
    """
    return sum(
        1 << bit for bit, place in board_inputs.items() if not reading.interlock_inputs >> place & 1
    )


class InterlockBench:
    """A bench whose readings also carry its interlocks; everything else is the inner bench's.

    Parameters
    ----------
    bench : Bench
        The inner bench, whose readings have the board's inputs.
    board_inputs : mapping of int to int
        By bit of `BenchReading.interlocks_open`, the board's input that its circuit is wired to.
    sources : iterable of PolledSource
        Everything else that reads circuits.
    clock : callable
        Monotonic time, s.
    """

    def __init__(
        self,
        bench: roles.Bench,
        board_inputs: Mapping[int, int],
        sources: Iterable[PolledSource],
        clock: roles.Clock = time.monotonic,
    ) -> None:
        self._bench = bench
        self._board_inputs = dict(board_inputs)
        self._pollers = tuple(CircuitPoller(polled, clock) for polled in sources)

    async def open(self) -> roles.BenchIdentity:
        """Start reading the sources, then open the bench: its watchdog runs from then on. Raises as
        the bench's.
        """
        await asyncio.gather(*(poller.start() for poller in self._pollers))
        return await self._bench.open()

    async def read(self) -> roles.BenchReading:
        """The bench's reading with the bits of open circuits added. Raises as the bench's."""
        reading = await self._bench.read()
        interlocks_open = open_board_inputs(reading, self._board_inputs)
        for poller in self._pollers:
            interlocks_open |= poller.open_mask()
        return replace(reading, interlocks_open=interlocks_open)

    async def write(self, command: roles.BenchCommand) -> None:
        """Write pump and vent, and feed the watchdog. Raises as the bench's."""
        await self._bench.write(command)

    async def clear_faults(self, mask: int) -> None:
        """Clear these latched bits of the devices. Raises as the bench's."""
        await self._bench.clear_faults(mask)

    def dead_guards(self) -> tuple[str, ...]:
        """The bench's guards that no longer run, and readers of interlocks that have ended."""
        ended = tuple(
            f"interlock reader of {poller.name}" for poller in self._pollers if poller.ended
        )
        return (*self._bench.dead_guards(), *ended)

    def link_state(self) -> roles.LinkState:
        """The bench's; interlocks never delay a reading."""
        return self._bench.link_state()

    async def close(self) -> None:
        """Close the bench first, then the sources. Never raises."""
        await self._bench.close()
        for poller in self._pollers:
            await poller.stop()
