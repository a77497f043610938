"""Runs the ticks of a hold: connects the controller to bench, listeners and processes."""

import asyncio
import contextlib
import gc
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from firmware_iface.drivers.pump_board import NO_CLAIM
from firmware_iface.roles import Bench, LinkError
from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port import server
from membrane_ctrl.controller import commands, tick
from membrane_ctrl.controller.command import Command
from membrane_ctrl.controller.controller import Controller
from membrane_ctrl.hold import child_processes
from membrane_ctrl.hold.closing_words import RunEnd
from membrane_ctrl.hold.fault_latch import FaultLatch
from membrane_ctrl.hold.hold_options import HoldOptions
from membrane_ctrl.hold.lock_keeper import LockKeeper
from membrane_ctrl.hold.start_checks import BoardAtStart
from membrane_ctrl.hold.supervisor import Supervisor, Wiring, newest_of
from membrane_ctrl.hold.systemd_notify import SystemdNotify
from membrane_ctrl.instruments.bench_connection import connect_bench
from membrane_ctrl.model import errors, events, run_events
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.program import program_identity
from membrane_ctrl.processes import machine_grants, priority, ring
from membrane_ctrl.sim.twin_process import TwinProcess


@dataclass(frozen=True, slots=True)
class HoldResources:
    """What the ticks of a hold work with, made before the first tick.

    Port, latch and lock keeper need the supervisor, so their makers are given.
    """

    bench: Bench
    config: Config
    options: HoldOptions
    clock: RunClock
    rings: child_processes.Rings
    children: child_processes.ChildProcesses
    twin: TwinProcess | None
    board: BoardAtStart
    figure_mode: run_events.FigureModeChosen | None  # None: the mode was stated
    make_port: Callable[[server.RunHooks], server.Port]
    make_latch: Callable[[Callable[[events.Event], None]], FaultLatch]
    make_keeper: Callable[[Callable[[events.Event], None], Callable[[Command], None]], LockKeeper]


async def run_ticks(parts: HoldResources, closing: RunEnd) -> None:
    """Run the ticks until one ends the run.

    Parameters
    ----------
    parts : HoldResources
        Everything that was opened for them.
    closing : RunEnd
        Gets the exit code and the fault in which the run ends.
    """
    from membrane_ctrl.metrology.figure.held_quantities import find_held_weights
    from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection

    # 1. Controller, supervisor, and those who follow the ticks
    bench, config, options = parts.bench, parts.config, parts.options
    clock, children = parts.clock, parts.children
    assert config.devices is not None
    with contextlib.ExitStack() as stack:
        wiring = _make_wiring(parts, stack)
        controller = Controller(
            config, zernike_projection(), held_weights=find_held_weights(config)
        )
        supervisor = Supervisor(controller, wiring, clock, config.loop.rate_hz)
        settings = (lambda: controller.loop_config, lambda: controller.pump_config)
        keeper = parts.make_keeper(
            lambda event: _record_and_notify(event, supervisor, wiring), supervisor.queue_command
        )
        hooks = server.RunHooks(
            supervisor.queue_command,
            supervisor.record_event,
            clock.now,
            *settings,
            keeper.find_outcome,
        )
        port = parts.make_port(hooks)
        latch = parts.make_latch(supervisor.record_event)
        systemd = SystemdNotify()
        wiring.tick_listeners = {
            "locks": keeper.handle_tick,  # before the port, which needs the outcome
            "control port": port.handle_tick,
            "latched-fault file": latch.handle_tick,
            "systemd": systemd.handle_tick,
            "capture": partial(_forward_captures, children, supervisor.record_event),
            "closing words": closing.handle_tick,
        }
        wiring.report_listeners = {
            "control port": port.note_report,
            "systemd": systemd.note_report,
        }
        # 2. The record begins, and the first tick gets its commands
        started = (
            config.devices.name,
            priority.raise_priority(),
            parts.board.cleared,
            program_identity(),
        )
        supervisor.record_event(run_events.Started(*started))
        if parts.figure_mode is not None:
            supervisor.record_event(parts.figure_mode)
        exit_code = errors.Exit.DEVICE_FAILED
        try:
            _send_first_commands(supervisor, options.standby, latch, parts.board, keeper.at_start)
            gc.collect()
            gc.freeze()  # the collector need not visit objects that live for the whole run
            supervisor.record_event(_lock_memory())
            # 3. Clients and signals, and then the bench: from its first write on, the board's
            #    watchdog requires ticks
            async with port.open():
                with _stop_on_signals(supervisor), latch, keeper, systemd:
                    if (await connect_bench(bench, config.devices)).map_version == 1:
                        supervisor.record_event(run_events.NoClaim(NO_CLAIM))
                    finished = await supervisor.run(options.duration_s)
                    closing.exit = exit_code = closing.judge_exit(finished, options.standby)
        except asyncio.CancelledError:  # a signal before the first tick
            if closing.exit is None:
                exit_code = errors.Exit.INTERRUPTED
            raise
        except LinkError as error:
            supervisor.record_event(run_events.Link(str(error), up=False))
            raise errors.DeviceError(str(error)) from None
        # 4. The event `end` is the last message: recorder and console end with it
        finally:
            await bench.close()
            ticks, missed_ticks = supervisor.ticks, supervisor.missed_ticks
            supervisor.record_event(
                run_events.Ended(exit_code.name.lower(), int(exit_code), ticks, missed_ticks)
            )


def _lock_memory() -> run_events.MachineUsed:
    """Lock the memory of this process, if that is allowed without a limit."""
    found, locked = machine_grants.find_grants(), machine_grants.lock_memory()
    return run_events.MachineUsed(
        scheduling=found.scheduling,
        memory="locked" if locked else f"not locked ({found.memory_words})",
        memory_locked=locked,
        processors=found.processor_words,
        clock_source=found.clock_source or "unknown",
    )


def _record_and_notify(event: events.Event, supervisor: Supervisor, wiring: Wiring) -> None:
    """Record an event, and pass it on as a child's report."""
    supervisor.record_event(event)
    for listener in wiring.report_listeners.values():
        listener(event)


def _make_wiring(parts: HoldResources, stack: contextlib.ExitStack) -> Wiring:
    """What the tick reads and writes, without listeners; the rings are closed with the stack."""
    rings = parts.rings
    rows, events, inputs, snapshots = (
        stack.enter_context(contextlib.closing(ring.RingWriter(address)))
        for address in (rings.telemetry, rings.events, rings.inputs, rings.snapshots)
    )
    shapes = None
    if rings.shapes:
        shapes = stack.enter_context(contextlib.closing(ring.RingReader(rings.shapes)))
    truth = parts.twin.truth_reader() if parts.twin else None
    newest_shape = newest_of(shapes) if shapes else None
    reports = parts.children.read_reports
    return Wiring(parts.bench, rows, events, inputs, snapshots, newest_shape, truth, reports)


def _send_first_commands(
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
        supervisor.queue_command(Command("latch", commands.AT_START, text=lock.text, lock=lock))
    if not standby:
        supervisor.queue_command(Command("hold", commands.AT_START))
    elif latched := "; ".join(part for part in (latch.latched_line, board.latched) if part):
        supervisor.queue_command(Command("latched", commands.AT_START, text=latched))
    for age_s in latch.resumes_s:
        supervisor.queue_command(Command("resumed", commands.AT_START, value=age_s))


def _forward_captures(
    children: child_processes.ChildProcesses,
    report: Callable[[events.Event], None],
    outputs: tick.TickOutputs,
) -> None:
    """Pass accepted requests for a capture set to the acquisition."""
    for event in outputs.events:
        match event:
            case events.CommandTaken(command="capture", refused=None, value=turned_deg):
                failed = children.request_capture(turned_deg)
                if failed is not None:
                    report(failed)


@contextlib.contextmanager
def _stop_on_signals(supervisor: Supervisor) -> Iterator[None]:
    """Turn SIGINT, SIGTERM and a closed terminal into a clean stop, which begins with the safe
    state; no Ctrl-Z.
    """
    loop = asyncio.get_running_loop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # `nohup`: continue without the terminal
        numbers.append(signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in [*numbers, signal.SIGTSTP]}
    for number in numbers:
        loop.add_signal_handler(number, supervisor.queue_command, Command("stop", number.name))
    # Ctrl-Z: without ticks the board's watchdog stops the pump
    signal.signal(signal.SIGTSTP, signal.SIG_IGN)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
        for number, handler in before.items():
            signal.signal(number, handler)  # asyncio leaves the default: an end without clean-up
