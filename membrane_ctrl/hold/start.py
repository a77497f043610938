"""`hold`: everything around the ticks. Starts the processes, wires them, and stops them in the
right order.

At the start, configuration, port, devices and folder are checked before anything is created. At the
end, the safe state comes first, then the recording, then the rest.
"""

import asyncio
import contextlib
import gc
import importlib.util
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from firmware_iface.drivers.pump_board import NO_CLAIM
from firmware_iface.roles import ALL_FAULTS, Bench, BenchReading, LinkError
from firmware_iface.settings import GpioLineConfig
from membrane_ctrl.acquisition import driver_check
from membrane_ctrl.alarms.process import require_sendable
from membrane_ctrl.config.schema import Config, DevicesConfig
from membrane_ctrl.control_port import server, sockets
from membrane_ctrl.controller import commands, cross_check, interlocks, safe_levels, tick
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.geometry.file import geometry_in_force
from membrane_ctrl.hold import child_processes
from membrane_ctrl.hold.closing_words import Closing, report
from membrane_ctrl.hold.listeners import FaultLatch, SystemdNotify
from membrane_ctrl.hold.lock_keeper import LockKeeper, LockStorage
from membrane_ctrl.hold.supervisor import Supervisor, Wiring, newest_of
from membrane_ctrl.instruments.bench import (
    connect,
    device_names,
    locked,
    open_bench,
    require_places,
)
from membrane_ctrl.instruments.lock_store import LockStore, device_keys, require_unlocked
from membrane_ctrl.model import errors, events, run_events, telemetry, terminal
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.program import program_identity
from membrane_ctrl.processes import child, ring
from membrane_ctrl.run_files import latched_fault, run_folder
from membrane_ctrl.sim.bench import TwinProcess

_UNLOCKS = (
    "start with --standby, then `membrane-ctrl ctl unlock WORD`; or `membrane-ctrl locks remove "
    "WORD`"
)
_NICE, _ENDS_S = 10, 10.0  # of the tuning session


_STORES_NONE = partial(LockKeeper, None)


@dataclass(frozen=True, slots=True)
class HoldOptions:
    """Options of the command line."""

    config: Config
    source: str  # origin of the configuration, for messages
    twin: bool
    duration_s: float | None
    name: str
    logs_dir: Path | None
    clear_faults: bool
    json: bool
    standby: bool = False  # wait for `ctl hold`
    autotune: bool = False  # a short tuning session once the mirror is held
    # the twin answers as the instruments of the configuration, not as the pump board
    lab: bool = False


def hold_mirror(options: HoldOptions) -> int:
    """Hold the mirror until the duration is over, a signal arrives, or a safety trip ends the run.

    Returns the exit code. Raises InputError or DeviceError (one line) for failures before the first
    tick.
    """
    if options.config.devices is None and not options.twin:
        raise errors.InputError(
            f"{options.source}: devices: missing; name the pump board in [devices], or use --twin"
        )
    for warning in cross_check.require_sound(options.config, options.source):
        print(warning.line(options.source), file=sys.stderr)
    if options.config.devices is not None and (options.lab or not options.twin):
        _require_possible(options.config.devices, options.lab)
        if options.config.shape.enabled:
            driver_check.require_optics(options.config.devices)
    require_sendable(options.config.alarms)
    if options.config.web is not None and importlib.util.find_spec("nicegui") is None:
        raise errors.InputError("[web] needs NiceGUI: pip install 'membrane-ctrl[web]'")
    geometry = geometry_in_force(options.config)
    clock = RunClock.start()
    # SIGTERM before and after the ticks cleans up as well
    with terminal.ends_as_by_ctrl_c(), contextlib.ExitStack() as stack:
        logs_dir = options.logs_dir or Path(options.config.recording.logs_dir)
        # a second hold ends here, devices untouched
        listeners = sockets.listeners_for(options.config.port, logs_dir, stack)
        twin = (
            TwinProcess.started(options.config, clock, stack, options.lab) if options.twin else None
        )
        config = twin.config if twin else options.config
        assert config.devices is not None
        stack.enter_context(
            locked(device_names(config.devices))
        )  # one with other folders ends here
        lock_storage = _find_locks(config, options)  # before anything is cleared
        latched = _latched(config, logs_dir, options)
        resumes = None if latched is None else latched_fault.ResumeLog(logs_dir)
        terminal.progress(f"connecting to {config.devices.name}")
        board = asyncio.run(_identify(open_bench(config.devices), config, options, resumes))
        run_dir = run_folder.create_run_folder(logs_dir, options.name, clock.origin_utc, config)
        geometry.keep(run_dir)
        rings = child_processes.rings_for(config, twin.truth if twin else None, stack)
        ring.publish(
            run_dir, {"telemetry": rings.telemetry, "events": rings.events, "shapes": rings.shapes}
        )
        children = child_processes.ChildProcesses(
            config, clock, rings, run_dir, options.name, options.duration_s, listeners.path
        )
        terminal.progress(f"run folder {run_dir}; starting {', '.join(children.names)}")
        children.start(stack)
        if options.autotune:
            stack.callback(_autotune(listeners.path, run_dir))
        bench = open_bench(config.devices)  # a link belongs to the event loop that opened it
        port = partial(server.Port, config.port, listeners, run_dir.name)
        latch = partial(FaultLatch, latched, resumes, run_dir.name, clock.utc)
        keeper = partial(LockKeeper, lock_storage)
        closing = Closing()
        try:
            asyncio.run(
                _run(
                    bench,
                    config,
                    options,
                    clock,
                    rings,
                    children,
                    twin,
                    port,
                    latch,
                    board,
                    closing,
                    keeper,
                )
            )
            children.take_down()
        except KeyboardInterrupt:
            if closing.exit is None:
                raise
            # the run had ended before: its own end counts
    assert closing.exit is not None
    with contextlib.suppress(OSError):  # the terminal was closed, or the pipe's reader has gone
        report(run_dir, options.json, closing)
    return closing.exit


def _require_possible(devices: DevicesConfig, lab: bool) -> None:
    """End with InputError for impossible settings, before anything is started.

    An emulated lab needs no package for GPIO: it stands for these lines by a Modbus module.
    """
    gpio = tuple(found for found in devices.interlocks if isinstance(found, GpioLineConfig))
    emulated = (
        tuple(found for found in devices.interlocks if found not in gpio)
        if lab
        else devices.interlocks
    )
    require_places(devices)
    open_bench(devices.model_copy(update={"interlocks": emulated}))


def _autotune(socket: Path | None, run_dir: Path) -> Callable[[], None]:
    """Start a tuning session, which waits for the hold, on trial; returns how to end it.

    It is another program, as if a person had started it: a hold needs no tuner, and outlives it.
    """
    words = [
        "--short",
        "--wait",
        "--choose",
        "same-load",
        "--name",
        "autotune",
        "--reason",
        "hold --autotune",
    ]
    where = ["--socket", str(socket), "--run", str(run_dir), "--logs", str(run_dir.parent)]
    session = child.Program(
        "autotune", ["tune", "run", *words, *where], run_dir / "autotune.log", _NICE
    )
    session.start()
    return partial(session.stop, _ENDS_S)


def _latched(
    config: Config, logs_dir: Path, options: HoldOptions
) -> latched_fault.LatchedFile | None:
    """The file of a latched fault, which outlives a run; the twin has one only if configured.

    Raises DeviceError if a fault is latched, unless it is to be cleared or the run starts in
    standby.
    """
    if options.twin and not config.states.latch_twin_faults:
        return None
    file = latched_fault.LatchedFile(logs_dir)
    fault = file.read()
    if fault is not None and options.clear_faults:
        try:
            file.clear()
        except OSError as error:
            reason = errors.os_reason(error)
            raise errors.DeviceError(
                f"{file.path}: cannot be cleared ({reason}); remove it by hand"
            ) from None
    elif fault is not None and not options.standby:
        raise errors.DeviceError(
            f"a fault is latched: {fault}; {fault.remedy}, then start with --clear-faults"
        )
    return file


def _find_locks(config: Config, options: HoldOptions) -> LockStorage | None:
    """Return where the run keeps its locks, with those that are set; the twin keeps them only if
    configured.

    Raises DeviceError if there are any, unless the run starts in standby, where a person can remove
    them.
    """
    if options.twin and not config.states.latch_twin_faults:
        return None
    assert config.devices is not None
    store = LockStore.of_machine()
    # the twin's own port may be another one at each start
    devices = (
        frozenset({f"twin port {options.config.twin.port}"})
        if options.twin
        else device_keys(config.devices)
    )
    if not options.standby:
        require_unlocked(store, devices, _UNLOCKS)
    return LockStorage(store, devices, tuple(store.find_locks(devices)))


@dataclass(frozen=True, slots=True)
class BoardAtStart:
    """Faults that the board itself had latched before this run."""

    latched: str = ""  # still latched, as the run starts in standby
    cleared: str = ""  # cleared under the resume rule


async def _identify(
    bench: Bench,
    config: Config,
    options: HoldOptions,
    resumes: latched_fault.ResumeLog | None = None,
) -> BoardAtStart:
    """Identify the devices and check their fitness before making a run folder. Raises DeviceError
    or InputError.
    """
    devices = config.devices
    assert devices is not None
    try:
        identity = await connect(bench, devices)
        cross_check.require_sound(config, options.source, identity)
        if options.clear_faults:
            await bench.clear_faults(ALL_FAULTS)
        reading = await bench.read()
        if not options.standby:
            _require_closed(config, reading)
        faults = reading.latched_faults
        if not faults:
            return BoardAtStart()
        what = (
            f"{devices.name}: the board has latched faults {faults:#x} "
            "(docs/reference/registers.md)"
        )
        # the last controller was killed, and nothing else happened if no other fault is latched and
        # nobody vented
        vented = reading.vent_fraction > safe_levels.VENTED_FRACTION
        if (
            faults == safe_levels.WATCHDOG_MASK
            and not vented
            and _may_resume("watchdog_tripped", config, resumes)
        ):
            await bench.clear_faults(safe_levels.WATCHDOG_MASK)
            return BoardAtStart(
                cleared="its watchdog had stopped the pump; cleared under resume.faults"
            )
    except LinkError as error:
        raise errors.DeviceError(f"{devices.name}: {error}") from None
    finally:
        await bench.close()
    if not options.standby:
        raise errors.DeviceError(f"{what}; find the cause, then start with --clear-faults")
    return BoardAtStart(latched=what)


def _require_closed(config: Config, reading: BenchReading) -> None:
    """Refuse a start that would hold the mirror while an interlock is open. Raises DeviceError."""
    circuits = interlocks.Interlocks(config.interlocks)
    circuits.observe_reading(reading, telemetry.State.STANDBY)
    if circuits.open_mask:
        raise errors.DeviceError(
            f"{circuits.describe_open(circuits.open_mask)}; close it, or start with "
            "--standby and hold later"
        )


def _may_resume(name: str, config: Config, resumes: latched_fault.ResumeLog | None) -> bool:
    """Apply the resume rule at a start; a resume that cannot be counted is not allowed."""
    if name not in config.resume.faults:
        return False
    if resumes is None:
        return True  # the twin, which keeps no latch
    now = datetime.now(UTC)
    if len(resumes.ages_s(now)) >= config.resume.most_per_day:
        return False
    try:
        resumes.add(now)
    except OSError:
        return False
    return True


async def _run(
    bench: Bench,
    config: Config,
    options: HoldOptions,
    clock: RunClock,
    rings: child_processes.Rings,
    children: child_processes.ChildProcesses,
    twin: TwinProcess | None,
    port_for: Callable[[server.RunHooks], server.Port],
    latch_for: Callable[[Callable[[events.Event], None]], FaultLatch],
    board: BoardAtStart,
    closing: Closing,
    keeper_for: Callable[
        [Callable[[events.Event], None], Callable[[commands.Command], None]], LockKeeper
    ] = (_STORES_NONE),
) -> None:
    """Run the ticks; `closing` gets the exit code and the fault in which the run ends."""
    from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection

    assert config.devices is not None
    with contextlib.ExitStack() as stack:
        wiring = _wiring(bench, rings, children, twin, stack)
        controller = Controller(config, zernike_projection())
        supervisor = Supervisor(controller, wiring, clock, config.loop.rate_hz)
        settings = (lambda: controller.loop_config, lambda: controller.pump_config)
        keeper = keeper_for(lambda event: _tell_all(event, supervisor, wiring), supervisor.ask)
        hooks = server.RunHooks(
            supervisor.ask, supervisor.tell, clock.now, *settings, keeper.outcome
        )
        port = port_for(hooks)
        latch, systemd = latch_for(supervisor.tell), SystemdNotify()
        wiring.heard = {
            "locks": keeper.heard,  # before the port, which asks for the outcome
            "control port": port.heard,
            "latched-fault file": latch.heard,
            "systemd": systemd.heard,
            "capture": partial(_capture, children, supervisor.tell),
            "closing words": closing.heard,
        }
        wiring.told = {"control port": port.told, "systemd": systemd.told}
        started = config.devices.name, child.raise_priority(), board.cleared, program_identity()
        supervisor.tell(run_events.Started(*started))
        exit_code = errors.Exit.DEVICE_FAILED
        try:
            _ask_first(supervisor, options.standby, latch, board, keeper.at_start)
            gc.collect()
            gc.freeze()  # the collector need not visit objects that live for the whole run
            async with port.open():
                with _signals(supervisor), latch, keeper, systemd:
                    # last: the board's watchdog runs from here on
                    if (await connect(bench, config.devices)).map_version == 1:
                        supervisor.tell(run_events.NoClaim(NO_CLAIM))
                    closing.exit = exit_code = await supervisor.run(options.duration_s)
        except asyncio.CancelledError:  # a signal before the first tick
            exit_code = errors.Exit.INTERRUPTED if closing.exit is None else exit_code
            raise
        except LinkError as error:
            supervisor.tell(run_events.Link(str(error), up=False))
            raise errors.DeviceError(str(error)) from None
        finally:
            await bench.close()
            ticks, missed_ticks = supervisor.ticks, supervisor.missed_ticks
            supervisor.tell(
                run_events.Ended(exit_code.name.lower(), int(exit_code), ticks, missed_ticks)
            )


def _tell_all(event: events.Event, supervisor: Supervisor, wiring: Wiring) -> None:
    """Record an event, and pass it on as a child's report."""
    supervisor.tell(event)
    for told in wiring.told.values():
        told(event)


def _wiring(
    bench: Bench,
    rings: child_processes.Rings,
    children: child_processes.ChildProcesses,
    twin: TwinProcess | None,
    stack: contextlib.ExitStack,
) -> Wiring:
    """What the tick reads and writes, without listeners; the rings are closed with the stack."""
    rows, events, inputs, snapshots = (
        stack.enter_context(contextlib.closing(ring.RingWriter(address)))
        for address in (rings.telemetry, rings.events, rings.inputs, rings.snapshots)
    )
    shapes = (
        stack.enter_context(contextlib.closing(ring.RingReader(rings.shapes)))
        if rings.shapes
        else None
    )
    truth = twin.truth_reader() if twin else None
    newest_shape = newest_of(shapes) if shapes else None
    return Wiring(bench, rows, events, inputs, snapshots, newest_shape, truth, children.reports)


def _ask_first(
    supervisor: Supervisor,
    standby: bool,
    latch: FaultLatch,
    board: BoardAtStart,
    locks: Sequence[Lock] = (),
) -> None:
    """The first tick's commands: hold, unless the run starts in standby; locks, faults, resumes of
    earlier runs.
    """
    for lock in locks:
        supervisor.ask(commands.Command("latch", commands.AT_START, text=lock.text, lock=lock))
    if not standby:
        supervisor.ask(commands.Command("hold", commands.AT_START))
    elif latched := "; ".join(part for part in (latch.latched, board.latched) if part):
        supervisor.ask(commands.Command("latched", commands.AT_START, text=latched))
    for age_s in latch.resumes_s:
        supervisor.ask(commands.Command("resumed", commands.AT_START, value=age_s))


def _capture(
    children: child_processes.ChildProcesses,
    tell: Callable[[events.Event], None],
    outputs: tick.TickOutputs,
) -> None:
    """Pass accepted requests for a capture set to the acquisition."""
    for event in outputs.events:
        match event:
            case events.CommandTaken(command="capture", refused=None) if (
                failed := children.capture()
            ) is not None:
                tell(failed)


@contextlib.contextmanager
def _signals(supervisor: Supervisor) -> Iterator[None]:
    """Turn SIGINT, SIGTERM and a closed terminal into a clean stop, which begins with the safe
    state; no Ctrl-Z.
    """
    loop = asyncio.get_running_loop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # `nohup`: continue without the terminal
        numbers.append(signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in [*numbers, signal.SIGTSTP]}
    for number in numbers:
        loop.add_signal_handler(number, supervisor.ask, commands.Command("stop", number.name))
    signal.signal(
        signal.SIGTSTP, signal.SIG_IGN
    )  # Ctrl-Z: without ticks the board's watchdog stops the pump
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
        for number, handler in before.items():
            signal.signal(number, handler)  # asyncio leaves the default: an end without clean-up
