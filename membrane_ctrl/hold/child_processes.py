"""The processes beside the control process, and the rings between them."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.tick_codec import MESSAGE_BYTES, SNAPSHOT_MESSAGE_BYTES
from membrane_ctrl.model import (
    acquisition_events,
    events,
    telemetry,
)
from membrane_ctrl.model.clock import RunClock
from membrane_ctrl.model.shape_estimate import ESTIMATE_BYTES_MAX
from membrane_ctrl.processes.child import Child
from membrane_ctrl.processes.event_pipe import make_pipe
from membrane_ctrl.processes.frame_address import FrameAddress
from membrane_ctrl.processes.managed_child import Make, ManagedChild
from membrane_ctrl.processes.ring import RingAddress, open_ring

_TELEMETRY_KEPT_S = 60.0  # a recorder busy for this long (a slow disk) loses nothing
_EVENTS_KEPT, EVENT_BYTES = 1024, 8192  # with all of the longest request
_SHAPES_KEPT = 64
_SNAPSHOTS_KEPT = 4
_RECORDER_CLOSES_S = 30.0
_CHILD_STOPS_S = 3.0
_ALARMS_LEAVE_S = 10.0  # the process allows itself 8 s for the last notices


@dataclass(frozen=True, slots=True)
class Rings:
    """The shared memory of a run (docs/explanation/architecture.md)."""

    telemetry: RingAddress
    events: RingAddress
    inputs: RingAddress
    snapshots: RingAddress
    shapes: RingAddress | None
    frames: FrameAddress | None
    truth: RingAddress | None


def make_rings(config: Config, truth: RingAddress | None, stack: ExitStack) -> Rings:
    """Make the rings of a run.

    Parameters
    ----------
    config : Config
        Their sizes follow from its rates.
    truth : RingAddress or None
        The ring of the twin's true states, if there is one.
    stack : ExitStack
        Frees their memory.
    """
    kept = round(_TELEMETRY_KEPT_S * config.loop.rate_hz)
    rows = stack.enter_context(open_ring(kept, telemetry.ROW_BYTES))
    events = stack.enter_context(open_ring(_EVENTS_KEPT, EVENT_BYTES))
    inputs = stack.enter_context(open_ring(kept, MESSAGE_BYTES))
    snapshots = stack.enter_context(open_ring(_SNAPSHOTS_KEPT, SNAPSHOT_MESSAGE_BYTES))
    camera = truth is not None or (config.devices is not None and config.devices.camera is not None)
    if not camera or not config.shape.enabled:
        return Rings(rows, events, inputs, snapshots, None, None, truth)
    shapes = stack.enter_context(open_ring(_SHAPES_KEPT, ESTIMATE_BYTES_MAX))
    return Rings(rows, events, inputs, snapshots, shapes, _make_frame_ring(config, stack), truth)


def _make_frame_ring(config: Config, stack: ExitStack) -> FrameAddress:
    from membrane_ctrl.processes.frames import FrameRing

    owner = FrameRing.for_optics(config.optics, config.recording.raw_before_fault_cycles)
    stack.callback(owner.close)
    return owner.address


class ChildProcesses:
    """Recorder, console, acquisition and alarms of one run. The hold continues without them
    and reports it.
    """

    def __init__(
        self,
        config: Config,
        clock: RunClock,
        rings: Rings,
        run_dir: Path,
        name: str,
        duration_s: float | None,
        socket: Path | None,
    ) -> None:
        from membrane_ctrl.console.key_reader import Keyboard
        from membrane_ctrl.console.process import ConsoleSpec
        from membrane_ctrl.recorder.process import RecorderSpec

        # What each child gets when it starts; a console that is replaced begins at the present.
        self._clock = clock
        self._summary = run_dir / "summary.json"
        self._keyboard = Keyboard.of_stdin()
        console = ConsoleSpec(
            clock,
            rings.telemetry,
            rings.events,
            rings.shapes,
            run_dir,
            config,
            duration_s,
            socket,
            self._keyboard,
        )
        recorder = RecorderSpec(
            run_dir,
            name,
            clock,
            config,
            rings.inputs,
            rings.events,
            rings.shapes,
            rings.frames,
            snapshots=rings.snapshots,
        )
        self._console = ManagedChild(
            _make_child_factory(
                "screen",
                "console",
                5,
                lambda n: replace(console, since_s=clock.now()) if n else console,
            )
        )
        self._recorder = ManagedChild(
            _make_child_factory("recorder", "recorder", 5, lambda n: replace(recorder, resumes=n))
        )
        self._acquisition = self._alarms = None
        # Only with a camera; only with addresses for alarms.
        if rings.shapes is not None and rings.frames is not None:
            from membrane_ctrl.acquisition.spec import AcquisitionSpec

            cycles = AcquisitionSpec(
                config, clock, rings.telemetry, rings.shapes, rings.truth, rings.frames, run_dir
            )
            self._acquisition = ManagedChild(
                _make_child_factory("acquisition", "acquisition", 10, lambda n: cycles)
            )
        if config.alarms.urls_file:
            from membrane_ctrl.alarms.process import AlarmsSpec

            alarms = AlarmsSpec(clock, rings.telemetry, rings.events, config.alarms, run_dir)
            self._alarms = ManagedChild(
                _make_child_factory("alarms", "alarms", 5, lambda n: alarms)
            )

    @property
    def _managed_children(self) -> list[ManagedChild]:
        found = (self._recorder, self._acquisition, self._alarms, self._console)
        return [each for each in found if each is not None]

    @property
    def process_names(self) -> list[str]:
        """Names of the processes."""
        return [managed.child.name for managed in self._managed_children]

    def start(self, stack: ExitStack) -> None:
        """Start all children; the stack stops those that `take_down` has not."""
        stack.callback(self._stop_children)
        for managed in self._managed_children:
            managed.start(self._clock.now())

    def _stop_children(self) -> None:
        for managed in self._managed_children:
            managed.child.stop(_CHILD_STOPS_S)

    def read_reports(self) -> list[events.Event]:
        """The children's reports and replacements since the last call; never waits."""
        return [
            event
            for managed in self._managed_children
            for event in managed.check_child(self._clock.now())
        ]

    def request_capture(self, turned_deg: float | None = None) -> events.Event | None:
        """Ask the acquisition to save and report a full set, of a mirror that was turned about its
        axis; returns an event if that is impossible.
        """
        if self._acquisition is None:
            return acquisition_events.Capture(failed="no shape measurement in this run")
        word = "capture" if turned_deg is None else f"capture {turned_deg!r}"
        if not self._acquisition.send(word):
            return acquisition_events.Capture(
                failed="the acquisition does not answer; it may be restarting"
            )
        return None

    def take_down(self) -> None:
        """Stop the acquisition, then wait for recorder and console,
        which end with the "end" event.
        """
        if self._acquisition is not None:
            self._acquisition.child.stop(_CHILD_STOPS_S)
        # The recorder ends by itself with the event `end`. One that hangs is killed; without a
        # summary, another one reads what the rings still have
        recorder = self._recorder.child
        if not recorder.join(_RECORDER_CLOSES_S):
            recorder.stop(0.0)  # recorder or disk hangs
        if recorder.exit_code != 0 and not self._summary.exists():  # a new one records the end
            self._recorder.replace_child(self._clock.now())
            self._recorder.child.join(_RECORDER_CLOSES_S)
        self._end_console()
        if self._alarms is not None:
            self._alarms.child.join(_ALARMS_LEAVE_S)

    def _end_console(self) -> None:
        """Give the terminal back, even if the console hangs."""
        from membrane_ctrl.console.process import restore_terminal

        console = self._console.child
        if not console.join(_CHILD_STOPS_S):
            console.stop(0.0)
        if console.exit_code != 0:
            restore_terminal(self._keyboard)


def _make_child_factory(name: str, package: str, nice: int, spec: Callable[[int], object]) -> Make:
    """Return a function that makes children of one kind.

    `spec` maps the number of earlier children to the next one's argument: a recorder that replaces
    another one must know that, a console begins at the present.
    """

    def make(count: int) -> tuple[Child, Connection]:
        ours, theirs = make_pipe()
        return Child(
            name, f"membrane_ctrl.{package}.process:{package}_main", (spec(count), theirs), nice
        ), ours

    return make
