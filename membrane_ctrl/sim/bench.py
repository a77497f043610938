"""The simulated bench as a process: the plant in real time behind the pump board's own protocol."""

import asyncio
import contextlib
import errno
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

from firmware_iface.emulators import pump_board
from membrane_ctrl.config.schema import DevicesConfig, PumpConfig, TwinConfig
from membrane_ctrl.model import clock, errors
from membrane_ctrl.processes import child, priority, ring
from membrane_ctrl.sim import bench_events, lab, plant

_PERIOD_S = 0.004  # below the sensors' 5 ms, so that each sample is on time
# some 10 ms of work: after a stall, clients are answered while the plant catches up
_STEPS_AT_ONCE = 4000


@dataclass(frozen=True, slots=True)
class BenchSpec:
    """What a bench process needs; picklable."""

    twin: TwinConfig
    pump: PumpConfig
    clock: clock.RunClock  # the run's clock, which stamps the truth
    port: int  # where to listen; 0: any free port
    only_there: bool = True  # False: at any free port if this one is taken
    host: str = "127.0.0.1"
    speed: float = 1.0  # plant seconds a second
    truth: ring.RingAddress | None = None  # where to publish `Truth.pack()` with every sample
    # how long the bench outlives the process that started it, so that the tripped watchdog can be
    # observed
    linger_s: float = 5.0
    events: tuple[bench_events.BenchEvent, ...] = ()  # events in plant time (0 at the start)
    lab: DevicesConfig | None = None  # serve these instruments instead of the pump board


@dataclass(frozen=True, slots=True)
class BenchReport:
    """The first report of a bench process: the devices it serves, or why it serves none."""

    port: int = 0
    error: str = ""
    lab: DevicesConfig | None = None

    @property
    def url(self) -> str:
        """Address of the pump board."""
        return f"tcp://127.0.0.1:{self.port}"


def serve_bench(spec: BenchSpec, ready: Connection) -> None:
    """Serve the bench in a spawned process, until `processes.STOP`, or for `linger_s` after the end
    of its parent.

    SIGINT is ignored: Ctrl-C goes to the whole terminal, and the bench must outlive the
    controller's safe stop.

    Parameters
    ----------
    spec : BenchSpec
        The bench.
    ready : Connection
        Receives one BenchReport; a bench that cannot be built or cannot listen reports that and
        ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if spec.speed <= 1.0:
        # it stands for devices with processors of their own; faster, it may use a whole core
        priority.raise_priority()
    asyncio.run(_serve_bench(spec, ready))


async def _serve_bench(spec: BenchSpec, ready: Connection) -> None:
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(child.STOP, stop.set)
    with _truth_writer(spec.truth) as writer:
        try:
            bench = LiveBench(spec, writer)
            served, started = await _listen_as_devices(bench, spec)
        except (ValueError, errors.InputError) as error:
            ready.send(BenchReport(error=str(error)))
            return
        except OSError as error:
            reason = os.strerror(error.errno) if error.errno else str(error)
            ready.send(
                BenchReport(
                    error=f"twin.port = {spec.port} on {spec.host}: {reason}; 0 takes any free port"
                )
            )
            return
        try:
            ready.send(
                BenchReport(
                    served.port if isinstance(served, pump_board.PumpBoardEmulator) else 0,
                    lab=started,
                )
            )
            await _keep_running(bench, spec, stop)
        finally:
            await served.stop()


async def _listen_as_devices(
    bench: "LiveBench", spec: BenchSpec
) -> tuple[pump_board.PumpBoardEmulator | lab.Lab, DevicesConfig | None]:
    """The emulated board or instruments, and the addresses of the latter. Raises OSError."""
    if spec.lab is not None:
        instruments = lab.Lab(bench, spec.lab)
        return instruments, await instruments.start()
    board = pump_board.PumpBoardEmulator(bench, spec.host, spec.port)
    try:
        await board.start()
    except OSError as error:
        if spec.only_there or error.errno != errno.EADDRINUSE:
            raise
        board = pump_board.PumpBoardEmulator(bench, spec.host, 0)
        await board.start()
    return board, None


async def _keep_running(bench: "LiveBench", spec: BenchSpec, stop: asyncio.Event) -> None:
    """Step the bench on absolute deadlines until stopped."""
    orphaned_s: float | None = None
    deadline_s = time.monotonic()
    while not stop.is_set():
        bench.catch_up()
        now_s = time.monotonic()
        if orphaned_s is None and not child.parent_lives():
            orphaned_s = now_s
        if orphaned_s is not None and now_s - orphaned_s > spec.linger_s:
            return
        deadline_s = max(
            deadline_s + _PERIOD_S, now_s
        )  # a missed deadline needs no extra round: catch_up covers it
        await asyncio.sleep(deadline_s - now_s)


@contextlib.contextmanager
def _truth_writer(address: ring.RingAddress | None) -> Iterator[ring.RingWriter | None]:
    if address is None:
        yield None
        return
    writer = ring.RingWriter(address)
    try:
        yield writer
    finally:
        writer.close()


class LiveBench:
    """The plant on the run's clock, sampled by its device every 5 ms of plant time.

    Parameters
    ----------
    spec : BenchSpec
        Plant, clock and speed.
    truth : RingWriter or None
        Receives the true state with each sample.
    """

    def __init__(self, spec: BenchSpec, truth: ring.RingWriter | None) -> None:
        self._plant = plant.Plant(spec.twin, spec.pump, spec.events)
        self._now = spec.clock.now
        self._start_s = spec.clock.now()
        self._speed = spec.speed
        self._truth = truth
        self._sample = self._take_sample()

    def sample(self) -> pump_board.BoardSample:
        """The device's newest sample."""
        return self._sample

    def actuate(self, pump_fraction: float, vent_fraction: float) -> None:
        """Drive pump and vent until the next command.

        Parameters
        ----------
        pump_fraction, vent_fraction : float
            Share of the full drive, and of the full opening, 0 to 1.
        """
        self._plant.actuate(pump_fraction, vent_fraction)

    def catch_up(self) -> None:
        """Advance the plant to the clock, after a long stall in several calls.

        Of several samples due, a client could see only the last; the counter counts all.
        """
        due_s = (self._now() - self._start_s) * self._speed - self._plant.time_s
        steps = min(int(due_s / plant.STEP_S), _STEPS_AT_ONCE)
        if steps > 0:
            self._plant.advance(steps * plant.STEP_S)
            self._sample = self._take_sample()

    def _take_sample(self) -> pump_board.BoardSample:
        mirror = self._plant
        if self._truth is not None:
            truth = mirror.truth()
            self._truth.put(
                replace(truth, time_s=self._start_s + truth.time_s / self._speed).pack()
            )
        sample = mirror.sample()
        return replace(sample, sample_counter=round(sample.device_time_s / plant.STEP_S) + 1)
