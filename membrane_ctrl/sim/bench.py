"""The simulated bench as a process: the plant in real time behind the pump board's own protocol."""

import asyncio
import contextlib
import errno
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection

from firmware_iface import settings
from firmware_iface.emulators import pump_board
from membrane_ctrl.config.schema import Config, DevicesConfig, PumpConfig, TwinConfig
from membrane_ctrl.model import clock, errors, terminal
from membrane_ctrl.processes import child, ring
from membrane_ctrl.sim import lab, plant, surroundings

_PERIOD_S = 0.004  # below the sensors' 5 ms, so that each sample is on time
# some 10 ms of work: after a stall, clients are answered while the plant catches up
_STEPS_AT_ONCE = 4000


@dataclass(frozen=True, slots=True)
class BenchSpec:
    """What a bench process needs to know; picklable."""

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
    events: tuple[surroundings.BenchEvent, ...] = ()  # events in plant time (0 at the start)
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


def serve(spec: BenchSpec, ready: Connection) -> None:
    """Serve the bench in a spawned process until `processes.STOP`, or until `linger_s` after the
    parent's end.

    `ready` gets one BenchReport; a bench that cannot be built or cannot listen reports that and
    ends. SIGINT is
    ignored: Ctrl-C goes to the whole terminal, and the bench must outlive the controller's safe
    stop.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if spec.speed <= 1.0:
        # it stands for devices with processors of their own; faster, it may use a whole core
        child.raise_priority()
    asyncio.run(_serve(spec, ready))


async def _serve(spec: BenchSpec, ready: Connection) -> None:
    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(child.STOP, stop.set)
    with _truth_writer(spec.truth) as writer:
        try:
            bench = LiveBench(spec, writer)
            served, started = await _listening(bench, spec)
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


async def _listening(
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
    """The plant on the run's clock, sampled by its device every 5 ms of plant time; publishes the
    truth with each.
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
        """Drive pump and vent."""
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


# The twin as a process beside the hold: its start, its port, and its truth for the record.

_TRUTHS_KEPT = 64
_READY_S = 60.0  # importing on a busy machine; a fresh one compiles first


def _started(spec: BenchSpec, stack: contextlib.ExitStack) -> BenchReport:
    """Start the bench process, which the stack ends, and wait until it listens; print where. Raises
    DeviceError.
    """
    terminal.progress(f"starting the twin: waiting until it listens, at most {_READY_S:g} s")
    ours, theirs = child.pipe()
    process = child.Child("twin", "membrane_ctrl.sim.bench:serve", (spec, theirs), nice=0)
    stack.callback(process.stop, 2.0)
    process.start()
    report: BenchReport = (
        ours.recv() if ours.poll(_READY_S) else BenchReport(error="the twin did not start")
    )
    if report.error:
        raise errors.DeviceError(report.error)
    if spec.lab is None:
        moved = f" (port {spec.port} is taken)" if spec.port not in (0, report.port) else ""
        terminal.progress(f"the twin listens on {report.url}{moved}, Modbus unit 1")
    return report


def _spec(config: Config, clock: clock.RunClock) -> BenchSpec:
    """The bench of a configuration; the default port may be another twin's, a configured one is
    meant.
    """
    twin = config.twin
    return BenchSpec(
        twin, config.pump, clock, twin.port, only_there="port" in twin.model_fields_set
    )


@dataclass(frozen=True, slots=True)
class TwinProcess:
    """A running simulated bench."""

    config: Config  # the run's configuration with the twin's own address as its device
    truth: ring.RingAddress  # where the twin publishes its mirror's true state

    @classmethod
    def started(
        cls, config: Config, clock: clock.RunClock, stack: contextlib.ExitStack, lab: bool = False
    ) -> "TwinProcess":
        """Start the twin and wait until it listens; the stack ends it. Raises DeviceError, e.g. for
        a busy port.

        With `lab` it answers as the configured instruments, else as the pump board.
        """
        if len(config.interlocks) > settings.BOARD_INPUTS and not lab:
            raise errors.InputError(
                f"devices.interlocks: {len(config.interlocks)} of them; the twin's pump board has "
                f"{settings.BOARD_INPUTS} inputs: use --devices, or fewer"
            )
        truth = stack.enter_context(ring.ring(_TRUTHS_KEPT, plant.TRUTH_BYTES))
        spec = replace(_spec(config, clock), truth=truth, lab=config.devices if lab else None)
        report = _started(spec, stack)
        watchdog = (
            {}
            if config.devices is None
            else config.devices.model_dump(include={"timeout_s", "watchdog_s"})
        )
        devices = report.lab or DevicesConfig(
            board=report.url, interlocks=_at_board_inputs(config.interlocks), **watchdog
        )
        return cls(config.model_copy(update={"devices": devices}), truth)

    def truth_reader(self) -> Callable[[], tuple[float, float]]:
        """A function that returns the newest true displacement and laser bias, in µm."""
        reader = ring.RingReader(self.truth)

        def newest() -> tuple[float, float]:
            message = reader.latest()
            if message is None:
                return float("nan"), float("nan")
            truth = plant.Truth.unpack(message)
            return truth.displacement_um, truth.laser_bias_um

        return newest


def _at_board_inputs(
    interlocks: tuple[settings.InterlockDriver, ...],
) -> tuple[settings.InterlockDriver, ...]:
    """The interlocks with the inputs of the twin's board in place of their sources, in order."""
    return tuple(
        settings.BoardInputConfig(
            driver="board_input",
            name=interlock.name,
            text=interlock.text,
            safe_level=interlock.safe_level,
            input=index,
        )
        for index, interlock in enumerate(interlocks)
    )


# `twin`: the simulated bench on its real protocol, for any client.

_STOPS = {signal.SIGINT, signal.SIGTERM}


def serve_twin(config: Config, speed: float) -> int:
    """Serve until SIGINT or SIGTERM; print the address on stderr. Raises DeviceError, e.g. for a
    busy port.
    """
    with contextlib.ExitStack() as stack:
        _started(replace(_spec(config, clock.RunClock.start()), speed=speed, linger_s=0.0), stack)
        terminal.progress("stop it with Ctrl-C")
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
        stopped = signal.sigwait(_STOPS)
    return errors.Exit.INTERRUPTED if stopped == signal.SIGINT else errors.Exit.DONE
