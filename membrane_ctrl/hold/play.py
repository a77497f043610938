"""The command `play`: records a scenario as a run."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from pathlib import Path

from membrane_ctrl.config import schema
from membrane_ctrl.console import process, why
from membrane_ctrl.controller import tick_codec
from membrane_ctrl.hold import scenario_file, scenario_run, scenarios
from membrane_ctrl.hold.closing_words import print_closing_report
from membrane_ctrl.model import clock, program, run_events, telemetry, terminal
from membrane_ctrl.processes import child, ring
from membrane_ctrl.recorder import rerun_recording
from membrane_ctrl.recorder.process import prepare_rerun
from membrane_ctrl.run_files.run_folder import create_run_folder

_ROUND_S = 20.0  # of the run, between two rounds of the recorder
_LIVE_ROUND_S = 1.0  # in real time, so that others can follow
_MESSAGES_A_TICK = 4  # at most
_CONSOLE_STOPS_S = 3.0


def play_scenario(word: str, logs_dir: Path, name: str | None, real_time: bool) -> int:
    """Play a scenario and record it as a run.

    Parameters
    ----------
    word : str
        Its name or its file.
    logs_dir : path
        Folder of the runs.
    name : str or None
        Of the run folder; that of the scenario by default.
    real_time : bool
        Play it in real time, with the console.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError
        For an unknown or invalid scenario.
    DeviceError
        If the folder cannot be written.
    """
    path = scenarios.find_scenario(word)
    played = scenario_file.load_scenario(path, scenario_file.Scenario)
    name = name or path.stem
    # a stranger's file decides neither where runs are stored nor which are deleted
    config = played.config.model_copy(update={"recording": schema.RecordingConfig()})
    with contextlib.ExitStack() as stack:
        addresses = {
            n: stack.enter_context(ring.open_ring(*size)) for n, size in _ring_sizes(config).items()
        }
        writers = {
            n: stack.enter_context(contextlib.closing(ring.RingWriter(a)))
            for n, a in addresses.items()
        }
        run = scenario_run.ScenarioRun(played.model_copy(update={"config": config}), writers)
        run_dir = create_run_folder(logs_dir, name, run.virtual.clock.origin_utc, config)
        terminal.print_progress(
            f"playing {why.format_duration(played.duration_s)} of: {played.title}"
        )
        ticks: scenario_run.Ticks = run.ticks()
        if real_time:
            real = clock.RunClock.start()
            ticks = _pace_ticks(run, ticks, real)
            rows, events, shapes = (addresses[n] for n in ("telemetry", "events", "shapes"))
            _start_console(
                process.ConsoleSpec(real, rows, events, shapes, run_dir, config, played.duration_s),
                stack,
            )
        else:
            ticks = terminal.track_progress(
                ticks, "playing", round(played.duration_s * config.loop.rate_hz)
            )
        with _stopped_by_signals(run):
            _record_ticks(
                run, ticks, run_dir, name, addresses, _LIVE_ROUND_S if real_time else _ROUND_S
            )
    print_closing_report(run_dir, as_json=False, closing=run.closing)
    return run.virtual.exit_code


def _ring_sizes(config: schema.Config) -> dict[str, tuple[int, int]]:
    """Slots of the rings for two rounds, and bytes of each."""
    ticks = round(2 * _ROUND_S * config.loop.rate_hz)
    return {
        "telemetry": (ticks, telemetry.ROW_BYTES),
        "inputs": (_MESSAGES_A_TICK * ticks, tick_codec.MESSAGE_BYTES),
        "snapshots": (4, tick_codec.SNAPSHOT_MESSAGE_BYTES),
        "events": (4096, 4096),
        "shapes": (256, 1 << 16),
    }


def _record_ticks(
    run: scenario_run.ScenarioRun,
    ticks: scenario_run.Ticks,
    run_dir: Path,
    name: str,
    addresses: dict[str, ring.RingAddress],
    round_s: float,
) -> None:
    """Run all ticks and record them, in this process: virtual time waits for the disk."""
    prepare_rerun()
    from membrane_ctrl.recorder import recorder

    virtual, config = run.virtual, run.config
    recorded = ("inputs", "snapshots", "events", "shapes")
    with contextlib.ExitStack() as stack:
        readers = {
            n: stack.enter_context(contextlib.closing(ring.RingReader(addresses[n])))
            for n in recorded
        }
        recording = rerun_recording.Recording(run_dir, name, virtual.clock, config)
        files = recorder.Recorder(
            run_dir, virtual.clock, config, readers, recording, None, virtual.record_event
        )
        virtual.record_event(
            run_events.Started(
                "the twin in virtual time", "ordinary", "", program.program_identity()
            )
        )
        # The rings hold two rounds: a round is written before the next is full
        due_s = round_s
        for _ in ticks:
            if virtual.now_s >= due_s:
                due_s += round_s
                files.drain_rings()
                files.write_second()
        virtual.end_run()
        files.finish()


def _pace_ticks(
    run: scenario_run.ScenarioRun, ticks: scenario_run.Ticks, real: clock.RunClock
) -> scenario_run.Ticks:
    """The ticks, each at its time; late ones follow at once."""
    for each in ticks:
        time.sleep(max(0.0, run.virtual.now_s - real.now()))
        yield each


def _start_console(spec: process.ConsoleSpec, stack: contextlib.ExitStack) -> None:
    """Start a console, which ends with the "end" event; the stack waits for it."""
    screen = child.Child("screen", "membrane_ctrl.console.process:console_main", (spec,), nice=5)
    stack.callback(screen.stop, 0.0)
    stack.callback(screen.join, _CONSOLE_STOPS_S)
    screen.start()


@contextlib.contextmanager
def _stopped_by_signals(run: scenario_run.ScenarioRun) -> Iterator[None]:
    """Within this context, Ctrl-C, SIGTERM and a closed terminal end the run at its next tick."""
    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    for number, handler in before.items():
        if handler != signal.SIG_IGN:
            signal.signal(number, lambda found, frame: run.stop(signal.Signals(found).name))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
