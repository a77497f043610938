"""The tick: asyncio, absolute deadlines, one device exchange, one pure function, one write.

Nothing here may take longer than a tick: no image, no Rerun, no file; records go into shared-memory
rings, which never block. A missed deadline is skipped and counted, never made up in a burst.
"""

import asyncio
import json
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from firmware_iface.roles import (
    Bench,
    BenchCommand,
    BenchReading,
    LinkDownError,
    LinkError,
    LinkState,
    LinkWaitsError,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.commands import AT_END
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.controller.link_report import LinkReport
from membrane_ctrl.controller.snapshot import take_snapshot
from membrane_ctrl.controller.tick import TickInputs, TickOutputs
from membrane_ctrl.controller.tick_codec import pack_row, pack_snapshot, pack_tick
from membrane_ctrl.hold.link_watch import FailureCounter, WaitMeter
from membrane_ctrl.model import clock, errors, run_events, shape_estimate
from membrane_ctrl.model.events import Event, EventLine
from membrane_ctrl.processes.ring import RingReader, RingWriter

_CHILD_WATCH_S = 0.5  # checking on a child costs a system call
# On average a replay runs through half of this to reach its part
SNAPSHOT_EVERY_S = 300.0
# In a row: a single lost answer of a sensor is no fault of its link
_SENSOR_FAILURES = 3
# characters to keep if the event exceeds its slot; each takes up to 12 bytes in JSON
_TEXT_CUTS = (
    200,
    20,
)


@dataclass(slots=True)
class Wiring:
    """Everything the tick is connected to; a ring that is None has no reader."""

    bench: Bench
    telemetry: RingWriter | None = None
    events: RingWriter | None = None
    inputs: RingWriter | None = None  # inputs of the ticks, for a replay
    snapshots: RingWriter | None = None  # of the controller, where a replay may start
    # the newest since the last call
    shapes: Callable[[], shape_estimate.ShapeEstimate | None] | None = None
    # (displacement_um, laser_bias_um) of the twin
    truth: Callable[[], tuple[float, float]] | None = None
    reports: Callable[[], list[Event]] = list  # of the children since the last call
    # listeners to each tick's outputs and the children's reports; an exception in one is a fault
    tick_listeners: Mapping[str, Callable[[TickOutputs], None]] = field(default_factory=dict)
    report_listeners: Mapping[str, Callable[[Event], None]] = field(default_factory=dict)


class Supervisor:
    """Runs the ticks of one run, from the first one to the exit code."""

    def __init__(
        self, controller: Controller, wiring: Wiring, clock: clock.RunClock, rate_hz: float
    ) -> None:
        self._controller = controller
        self._wiring = wiring
        self._clock = clock
        self._period_s = 1.0 / rate_hz
        self._pending: list[Command] = []
        self._link_up = True
        self._waits = WaitMeter(clock.now)
        self._link_error = ""  # why the last reading or command got no valid answer
        self._link_failures = FailureCounter(self._report_link)
        self._sensor_failures: dict[str, FailureCounter] = {}
        self._inputs_error = self._shape_error = ""
        self._next_watch_s = 0.0
        self._next_snapshot_s = SNAPSHOT_EVERY_S
        self._vent_fraction = 0.0
        self._broken: dict[str, str] = {}  # parts of the program that raised, with the exception
        self.ticks = 0
        self.missed_ticks = 0

    def queue_command(self, command: Command) -> None:
        """Hand a command to the next tick."""
        self._pending.append(command)

    def record_event(self, event: Event) -> None:
        """Record an event, now."""
        if self._wiring.events is None:
            return
        now_s = self._clock.now()
        stamped = {"time_utc": self._clock.utc(now_s).isoformat(), "mono_s": round(now_s, 6)}
        self._wiring.events.put(
            _encode_event(stamped | event.to_dict(), self._wiring.events.slot_bytes)
        )

    async def run(self, duration_s: float | None) -> errors.Exit:
        """Tick until the run is over; the pump is then off, or unreachable."""
        deadline_s = last_s = self._clock.now()
        ends_s = math.inf if duration_s is None else deadline_s + duration_s
        self._waits.stalls.start()
        try:
            while True:
                # Deadlines are a grid: a late tick does not delay those after it, and passed ones
                # are counted.
                deadline_s += self._period_s
                await asyncio.sleep(max(0.0, deadline_s - self._clock.now()))
                now_s = round(self._clock.now(), 6)  # whole microseconds take half the bytes
                late_s = now_s - deadline_s
                skipped = max(0, int(late_s / self._period_s))
                self.missed_ticks += skipped
                deadline_s += skipped * self._period_s
                # The end of the duration is a command like any other.
                if now_s >= ends_s:
                    self.queue_command(Command("stop", AT_END))
                    ends_s = math.inf
                _, outputs = await self.tick(now_s, round(now_s - last_s, 6), late_s)
                last_s = now_s
                if outputs.finished is not None:
                    return outputs.finished
        finally:
            self._waits.stalls.stop()
            await self.leave()

    async def leave(self) -> None:
        """Write the pump off; leave an open vent open."""
        await self._write(BenchCommand(0.0, self._vent_fraction))

    async def tick(
        self, now_s: float, dt_s: float, late_s: float
    ) -> tuple[TickInputs, TickOutputs]:
        """Run one tick: read, decide, write, record.

        Parameters
        ----------
        now_s : float
            When it starts.
        dt_s : float
            Time since the last one.
        late_s : float
            Time since its deadline.
        """
        wiring = self._wiring
        self.ticks += 1
        # of the last tick, which this one's lateness is due to
        wait_ms = self._waits.take_wait_ms()
        # Read: one sample of all sensors; without an answer, the tick has no reading
        if not self._link_up:
            await self._reconnect()
        reading = await self._read() if self._link_up else None
        link = LinkReport(wait_ms, self._link_error, self._watch_sensors(now_s))
        if self._link_up:
            if not self._link_error:
                self._link_failures.note_success(now_s)
            self._link_error = ""
        # What else the tick may use: children, the twin's truth, commands since the last tick
        if now_s >= self._next_watch_s:
            self._next_watch_s = now_s + _CHILD_WATCH_S
            self._run_guarded("children", self._report_children)
        if wiring.truth:
            truth_um, bias_um = wiring.truth()
        else:
            truth_um, bias_um = math.nan, math.nan
        commands, self._pending = tuple(self._pending), []
        inputs = TickInputs(
            now_s=now_s,
            dt_s=dt_s,
            reading=reading,
            lateness_ms=round(1e3 * late_s, 3),
            missed_ticks=self.missed_ticks,
            link_up=self._link_up,
            estimate=self._newest_shape(),
            commands=commands,
            dead_tasks=(*wiring.bench.dead_guards(), *self._broken.values()),
            link=link,
            truth_displacement_um=truth_um,
            truth_laser_bias_um=bias_um,
        )
        # Decide
        outputs = self._controller.tick(inputs)
        # Write, before anything is recorded: the write feeds the board's watchdog
        self._vent_fraction = outputs.command.vent_fraction
        if outputs.clear_mask:
            await self._clear_board(outputs.clear_mask)
        await self._write(outputs.command)
        # Record, and inform those who follow the ticks; none of them can stop the tick
        self._record_tick(inputs, outputs)
        for event in outputs.events:
            self.record_event(event)
        for name, listener in wiring.tick_listeners.items():
            self._run_guarded(name, partial(listener, outputs))
        self._record_snapshot(now_s)
        return inputs, outputs

    def _record_snapshot(self, now_s: float) -> None:
        """Record now and then what the next tick starts from, so that a replay can start there.

        After the tick's write, so that the command does not wait for it.
        """
        if self._wiring.snapshots is None or now_s < self._next_snapshot_s:
            return
        self._next_snapshot_s = now_s + SNAPSHOT_EVERY_S
        try:
            self._wiring.snapshots.put(
                pack_snapshot(self.ticks + 1, take_snapshot(self._controller))
            )
        except ValueError as error:  # a value of a wrong type, or too long
            self.record_event(run_events.SnapshotNotRecorded(str(error)))

    def _record_tick(self, inputs: TickInputs, outputs: TickOutputs) -> None:
        """Record the row, and the inputs for a replay; a value of the wrong type loses the inputs,
        not the row.
        """
        if self._wiring.telemetry is None:
            return
        row = outputs.row.pack()
        self._wiring.telemetry.put(row)
        if self._wiring.inputs is None:
            return
        try:
            messages = pack_tick(self.ticks, inputs, outputs, row)
        except (struct.error, TypeError, ValueError) as error:
            if not self._inputs_error:
                self._inputs_error = str(error)
                self.record_event(run_events.InputsNotRecorded(self._inputs_error))
            messages = [pack_row(self.ticks, outputs.row)]
        for message in messages:
            self._wiring.inputs.put(message)

    async def _read(self) -> BenchReading | None:
        try:
            return await self._waits.measure(self._wiring.bench.read())
        except LinkError as error:
            self._link_failed(error)
            return None

    async def _reconnect(self) -> None:
        """Try the lost link again; the link itself paces the attempts."""
        try:
            await self._waits.measure(self._wiring.bench.open())
        except LinkWaitsError:
            return
        except LinkError as error:  # e.g. the device answers, but another program holds it
            self._link_failed(error)
            return
        self._link_up = True
        self._link_error = ""
        self._link_failures.note_connection()

    async def _clear_board(self, mask: int) -> None:
        try:
            await self._waits.measure(self._wiring.bench.clear_faults(mask))
        except LinkError as error:
            self._link_failed(error)

    async def _write(self, command: BenchCommand) -> None:
        """Make the write that ends a tick and feeds the board's watchdog."""
        if not self._link_up:
            return
        try:
            await self._waits.measure(self._wiring.bench.write(command))
        except LinkError as error:
            self._link_failed(error)

    def _link_failed(self, error: LinkError) -> None:
        if isinstance(error, LinkDownError):
            self._link_up = False
        self._link_error = str(error)
        self._link_failures.note_failure(self._link_error, self._clock.now())

    def _report_link(self, message: str, works: bool, count: int) -> None:
        self.record_event(run_events.Link(message, works, count if count > 1 else None))

    def _watch_sensors(self, now_s: float) -> LinkState:
        """How the single devices answered; reports those that do not."""
        state = self._wiring.bench.link_state()
        silent = dict(state.silent)
        for role in silent.keys() - self._sensor_failures.keys():
            report = partial(self._report_sensor, role)
            self._sensor_failures[role] = FailureCounter(report, _SENSOR_FAILURES)
        for role, failures in self._sensor_failures.items():
            if role in silent:
                failures.note_failure(silent[role], now_s)
            else:
                failures.note_success(now_s)
        return state

    def _report_sensor(self, role: str, message: str, works: bool, count: int) -> None:
        self.record_event(run_events.SensorLink(role, message, works, count if count > 1 else None))

    def _newest_shape(self) -> shape_estimate.ShapeEstimate | None:
        if self._wiring.shapes is None:
            return None
        try:
            return self._wiring.shapes()
        except ValueError as error:  # the shape loop continues without it
            if str(error) != self._shape_error:
                self._shape_error = str(error)
                self.record_event(run_events.ShapeUnreadable(str(error)))
            return None

    def _report_children(self) -> None:
        """Report what happened to the children; the hold continues without them."""
        for report in self._wiring.reports():
            self.record_event(report)
            for name, listener in self._wiring.report_listeners.items():
                self._run_guarded(name, partial(listener, report))

    def _run_guarded(self, name: str, act: Callable[[], None]) -> None:
        """Run a part of the program; if it raises, the next tick sees the fault `dead_task`."""
        try:
            act()
        except Exception as error:
            self._broken.setdefault(name, f"{name} ({type(error).__name__}: {error})")


def newest_of(reader: RingReader) -> Callable[[], shape_estimate.ShapeEstimate | None]:
    """Return a function that takes the newest estimate from the shape ring; it raises ValueError
    for a bad one.
    """

    def newest() -> shape_estimate.ShapeEstimate | None:
        messages = reader.drain()
        if not messages:
            return None
        return shape_estimate.unpack_estimate(messages[-1])

    return newest


def _encode_event(event: EventLine, most_bytes: int) -> bytes:
    """Encode an event for the ring; truncate its texts if it is too long."""
    line = json.dumps(event, allow_nan=False, default=str).encode()
    for most in _TEXT_CUTS:
        if len(line) <= most_bytes:
            break
        cut = {
            key: value[:most] if isinstance(value, str) else value for key, value in event.items()
        }
        line = json.dumps(cut, allow_nan=False, default=str).encode()
    return line
