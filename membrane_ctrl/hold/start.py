"""`hold`: everything around the ticks. Starts the processes, wires them, and stops them in the
right order.

At the start, configuration, port, devices and folder are checked before anything is created. At the
end, the safe state comes first, then the recording, then the rest.
"""

import asyncio
import contextlib
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from membrane_ctrl.acquisition import driver_check
from membrane_ctrl.acquisition.figure_mode import choose_figure_mode
from membrane_ctrl.alarms.addresses import require_sendable
from membrane_ctrl.control_port import server, sockets
from membrane_ctrl.controller import cross_check
from membrane_ctrl.geometry.run_geometry import read_configured_geometry
from membrane_ctrl.hold import child_processes, page_service
from membrane_ctrl.hold.autotune import start_autotune
from membrane_ctrl.hold.closing_words import PageAtEnd, RunEnd, print_closing_report
from membrane_ctrl.hold.fault_latch import FaultLatch
from membrane_ctrl.hold.hold_options import HoldOptions
from membrane_ctrl.hold.lock_keeper import LockKeeper
from membrane_ctrl.hold.start_checks import (
    find_locks,
    identify_board,
    open_latched_fault,
    require_possible,
)
from membrane_ctrl.hold.tick_run import HoldResources, run_ticks
from membrane_ctrl.instruments.bench import make_bench
from membrane_ctrl.instruments.device_claim import claim_devices
from membrane_ctrl.instruments.device_names import list_device_names
from membrane_ctrl.model import errors, job_control, terminal
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.processes import published_rings
from membrane_ctrl.run_files import latched_fault, run_folder
from membrane_ctrl.sim.twin_process import TwinProcess


def hold_mirror(options: HoldOptions) -> int:
    """Hold the mirror until the duration is over, a signal arrives, or a safety trip ends the run.

    The command `hold`; it runs in the main thread, and the ticks in its event loop.

    Parameters
    ----------
    options : HoldOptions
        The options of the command, with the configuration as read.

    Returns
    -------
    int
        The exit code (`errors.Exit`).

    Raises
    ------
    InputError, DeviceError
        In one line, for failures before the first tick.
    """
    # 1. The configuration, before anything is created
    _check_configuration(options)
    config, figure_mode = choose_figure_mode(options.config)
    options = replace(options, config=config)
    geometry = read_configured_geometry(options.config)
    clock = RunClock.start()
    # SIGTERM before and after the ticks cleans up as well
    with job_control.ends_as_by_ctrl_c(), contextlib.ExitStack() as stack:
        logs_dir = options.logs_dir or Path(options.config.recording.logs_dir)
        # 2. What one hold alone may have: the port of its folder, then its devices.
        #    A second hold of the folder ends here, devices untouched
        listeners = sockets.listeners_for(options.config.port, logs_dir, stack)
        twin = (
            TwinProcess.start_twin(options.config, clock, stack, options.lab)
            if options.twin
            else None
        )
        config = twin.config if twin else options.config
        assert config.devices is not None
        observe = config.states.observe
        # A hold with other folders ends here; a board behind a network may be read beside one
        if not (observe and (config.devices.board or "").startswith("tcp://")):
            stack.enter_context(claim_devices(list_device_names(config.devices)))
        # 3. May this mirror be held? Locks first, before a latched fault is cleared; then the
        #    devices themselves
        lock_storage = find_locks(config, options)
        latched = open_latched_fault(config, logs_dir, options)
        resumes = None if latched is None else latched_fault.ResumeLog(logs_dir)
        terminal.print_progress(f"connecting to {config.devices.name}")
        found = make_bench(config.devices, observe)
        board = asyncio.run(identify_board(found, config, options, resumes))
        # 4. The run: its folder, rings in shared memory, and the processes that use both
        run_dir = run_folder.create_run_folder(logs_dir, options.name, clock.origin_utc, config)
        geometry.copy_to_run(run_dir)
        rings = child_processes.make_rings(config, twin.truth if twin else None, stack)
        published_rings.publish_rings(
            run_dir,
            {"telemetry": rings.telemetry, "events": rings.events, "shapes": rings.shapes},
            stack,
        )
        children = child_processes.ChildProcesses(
            config, clock, rings, run_dir, options.name, options.duration_s, listeners.path
        )
        terminal.print_progress(
            f"run folder {run_dir}; starting {', '.join(children.process_names)}"
        )
        children.start(stack)
        page = _start_service(options, logs_dir, stack)
        if options.autotune:
            stack.callback(start_autotune(listeners.path, run_dir))
        # 5. The ticks, on a new bench: the links of the first one belong to the event loop that
        #    has identified it
        bench = make_bench(config.devices, observe)
        parts = HoldResources(
            bench=bench,
            config=config,
            options=options,
            clock=clock,
            rings=rings,
            children=children,
            twin=twin,
            board=board,
            figure_mode=figure_mode,
            make_port=partial(server.Port, config.port, listeners, run_dir.name),
            make_latch=partial(FaultLatch, latched, resumes, run_dir.name, clock.utc),
            make_keeper=partial(LockKeeper, lock_storage),
        )
        # 6. The end: the ticks have brought the bench to its safe state; then the recording, and
        #    with the stack, last made first, all else
        closing = RunEnd()
        try:
            asyncio.run(run_ticks(parts, closing))
            children.take_down()
        except KeyboardInterrupt:
            if closing.exit is None:
                raise
            # the run had ended before: its own end counts
        page_at_end = _describe_page(page)
    assert closing.exit is not None
    with contextlib.suppress(OSError):  # the terminal was closed, or the pipe's reader has gone
        print_closing_report(run_dir, options.json, closing, page_at_end)
    return closing.exit


def _check_configuration(options: HoldOptions) -> None:
    """Print the warnings on the configuration. Raises InputError for one that cannot be held."""
    config = options.config
    if config.devices is None and not options.twin:
        raise errors.InputError(
            f"{options.source}: devices: missing; name the pump board in [devices], or use --twin"
        )
    for warning in cross_check.require_sound(config, options.source):
        print(warning.line(options.source), file=sys.stderr)
    if config.devices is not None and (options.lab or not options.twin):
        require_possible(config.devices, options.lab)
        if config.shape.enabled:
            driver_check.require_optics(config.devices)
    require_sendable(config.alarms)


def _start_service(
    options: HoldOptions, logs_dir: Path, stack: contextlib.ExitStack
) -> page_service.PageService | None:
    """Start the service if it is wanted and none is there; without a console on a terminal, which
    shows the page's link, prints it.
    """
    if not options.service or not options.config.port.enabled:
        return None
    ends_with_us = bool(os.environ.get("CI"))
    page = page_service.start_page_service(
        logs_dir, options.configuration, terminal.print_progress, ends_with_us
    )
    if page is not None:
        stack.callback(page.stop if ends_with_us else page.forget)
        if not terminal.can_draw():
            page.announce(terminal.print_progress)
    return page


def _describe_page(page: page_service.PageService | None) -> PageAtEnd:
    """The page after the hold: its link, or why its service has ended."""
    if page is None:
        return PageAtEnd()
    if problem := page.find_problem():
        return PageAtEnd(problem=f"its service has ended: {problem}")
    if not page.is_ready():
        return PageAtEnd(problem=f"its service is not ready yet; later: {page.link}")
    return PageAtEnd(page.link)
