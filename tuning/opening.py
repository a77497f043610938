"""Opening a session: its options, its folder, and the hold on which it works, live or of the twin
in virtual time.
"""

import contextlib
import getpass
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.controller.commands import Command
from membrane_ctrl.hold.virtual_run import ShapeSource, TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.errors import DeviceError, InputError, writing
from membrane_ctrl.model.events import CommandTaken, Event
from membrane_ctrl.sessions.folder import (
    SessionFolder,
    create_session,
    newest_session,
    open_session,
)
from membrane_ctrl.sessions.live_hold import HoldError, HoldLink, News, Progress, live_hold
from membrane_ctrl.sessions.live_log import LiveLog
from membrane_ctrl.sim import plant, surroundings, virtual_bench
from tuning import choice
from tuning.identification.characterise import FULL, SHORT, Plan
from tuning.proposal.verify import STAGES
from tuning.rig import HoldRig


@dataclass(frozen=True, slots=True)
class TuneOptions:
    """Options of the command line."""

    config: Config
    twin: bool
    where: Where
    logs: Path
    session: Path | None
    name: str
    author: str
    reason: str
    limit_um: float
    observe_s: float
    verify_s: float
    take_over: bool
    yes: bool
    choose: str
    json: bool
    page: bool = False
    short: bool = False
    wait: bool = False

    @property
    def plan(self) -> Plan:
        """Of the experiments."""
        return SHORT if self.short else FULL

    @property
    def stages(self) -> tuple[tuple[float, float], ...]:
        """Stages of the verification that fit in the time available; none earlier: one gust is half
        of 30 s.
        """
        early = tuple(stage for stage in STAGES[:-1] if stage[0] < self.verify_s)
        return (*early, (self.verify_s, STAGES[-1][1]))


def author_name() -> str:
    """Login name."""
    with contextlib.suppress(OSError, KeyError):
        return getpass.getuser()
    return "unknown"


@contextlib.contextmanager
def opened(
    options: TuneOptions,
    fresh: bool = False,
    again: str = "resume it with `membrane-ctrl tune run --resume {}`",
    refusal: Callable[[Config], str] = lambda config: "",
) -> Iterator[tuple[SessionFolder, HoldRig, Progress]]:
    """Yield a session's folder and hold; restore the last good gains if it ends early, and say how
    to go on.
    """
    progress = Progress()
    with linked(options, f"tune {options.name}") as link:
        if refused := refusal(link.config):
            raise InputError(refused)
        folder = folder_of(options, link, fresh)
        rig = HoldRig(link, options.author, progress)
        rig.good = folder.head.before, folder.config.pump
        progress.log = LiveLog(folder.path, rig.loop.rate_hz, progress.say)
        rig.seen = progress.log.tick
        with progress.catching():
            try:
                rig.end_experiment()  # of a session that was killed
                with writing(folder.path, DeviceError):
                    yield folder, rig, progress
                progress.note("ended", "done")
            except BaseException as error:
                _go_back(rig, progress)
                progress.note("ended", str(error) or "interrupted")
                progress.say(again.format(folder.path))
                if isinstance(error, HoldError):
                    raise DeviceError(str(error)) from None
                raise


def _go_back(rig: HoldRig, progress: Progress) -> None:
    progress.interrupted = False
    try:
        rig.go_back()
    except HoldError as error:
        progress.say(
            f"could not restore the last good gains ({error}); gains on trial revert automatically"
        )
        return
    progress.say("holding the mirror with the last good gains")


def linked(options: TuneOptions, session: str = "") -> contextlib.AbstractContextManager[HoldLink]:
    """Connect to the hold; with the name of a `session`, claim its command."""
    if not options.twin:
        return live_hold(options.where, options.take_over, wait=options.wait, session=session)
    config = open_session(options.session).config if options.session is not None else options.config
    try:
        return contextlib.closing(TwinHold(config))
    except HoldError as error:
        raise DeviceError(str(error)) from None


def folder_of(options: TuneOptions, link: HoldLink | None, fresh: bool = False) -> SessionFolder:
    """Return the named session, else the newest, or a new one if there is a hold to start it on."""
    if link is None:
        return (
            newest_session(options.logs)
            if options.session is None
            else open_session(options.session)
        )
    if options.session is not None:
        return choice.for_hold(open_session(options.session), link)
    begun: SessionFolder | None = None
    if not fresh:
        with contextlib.suppress(InputError):
            begun = newest_session(options.logs)
    of = None if begun is None else (begun.head.source, begun.head.name)
    if begun is not None and of == (link.name, options.name) and not begun.done("verify"):
        return choice.for_hold(begun, link)
    return create_session(
        options.logs, options.name, options.author, link.name, link.config, link.config.loop
    )


_NEWS_S = 0.5
_HELD_WITHIN_S = 120.0


class TwinHold:
    """A `HoldLink`; time passes only while the caller waits for news.

    Parameters
    ----------
    config : Config
        As for a run.
    events : sequence of twin events
        Events applied to the bench.
    bench : VirtualBench, optional
        Another bench than the configured twin.
    figures : callable, optional
        Its figures of the mirror, if not the twin's truth.

    Attributes
    ----------
    bench : VirtualBench
        The bench, for tests to change.
    rows : list of TelemetryRow
        All rows so far, including the truth.
    """

    name = "twin"

    def __init__(
        self,
        config: Config,
        events: Sequence[surroundings.BenchEvent] = (),
        bench: virtual_bench.VirtualBench | None = None,
        figures: ShapeSource | None = None,
    ) -> None:
        self.config = config
        self.bench = bench or virtual_bench.VirtualBench(
            plant.Plant(config.twin, config.pump, events)
        )
        source = figures
        if source is None and config.shape.enabled:
            source = TruthShape(self.bench, config, config.twin.seed)
        self._shapes: list[shape_estimate.ShapeEstimate] = []

        def shape(now_s: float) -> shape_estimate.ShapeEstimate | None:
            estimate = source(now_s) if source is not None else None
            if estimate is not None:
                self._shapes.append(estimate)
            return estimate

        self._run = VirtualRun(config, self.bench, zernike_projection(), shape)
        self._pending: tuple[Command, ...] = (Command("hold", "tuning session"),)
        self._early = News((), (), ())
        self.rows: list[telemetry.TelemetryRow] = []
        while not self.rows or self.rows[-1].state != telemetry.State.HOLD:
            self._advance(1)
            if self._run.now_s > _HELD_WITHIN_S:
                raise HoldError(
                    f"the twin is not held within {_HELD_WITHIN_S:g} s: if it swings, halve "
                    "loop.kp_per_s and double "
                    "loop.ti_s; else see `membrane-ctrl check`"
                )

    def ask(self, command: Command) -> None:
        """Run the tick that executes the command. Raises HoldError if it is refused."""
        self._pending = (command,)
        answer = self._advance(1)
        self._early = _joined(self._early, answer)
        for event in answer.events:
            if isinstance(event, CommandTaken) and event.refused:
                raise HoldError(f"refused: {event.refused}")

    def news(self) -> News:
        """Return half a second of twin time."""
        early, self._early = self._early, News((), (), ())
        return _joined(early, self._advance(round(_NEWS_S * self.config.loop.rate_hz)))

    def close(self) -> None:
        """Stop the run."""
        self._pending = (Command("stop", "tuning session"),)
        while self._run.finished is None:
            self._advance(1)

    def _advance(self, ticks: int) -> News:
        rows: list[telemetry.TelemetryRow] = []
        events: list[Event] = []
        for _ in range(ticks):
            if self._run.finished is not None:
                break
            commands, self._pending = self._pending, ()
            tick = self._run.tick(commands)
            if tick is not None:
                rows.append(tick.row)
                events += tick.events
        if not rows and self._run.finished is not None:
            raise HoldError(f"the run has ended ({self._run.finished.name.lower()})")
        self.rows += rows
        shapes, self._shapes = tuple(self._shapes), []
        return News(tuple(rows), tuple(events), shapes)


def _joined(early: News, late: News) -> News:
    return News(early.rows + late.rows, early.events + late.events, early.shapes + late.shapes)
