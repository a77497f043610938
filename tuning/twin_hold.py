"""A hold of the twin in virtual time, with the same controller, safety table and states."""

from collections.abc import Sequence

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import ShapeSource, TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model import shape_estimate, telemetry
from membrane_ctrl.model.events import CommandTaken, Event
from membrane_ctrl.sessions.live_hold import HoldError, News
from membrane_ctrl.sim import bench_events, plant, virtual_bench

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
        events: Sequence[bench_events.BenchEvent] = (),
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
                    "loop.kp_per_s and double loop.ti_s; else see `membrane-ctrl check`"
                )
        # The start may have limited the gains, and replaced an assumed curve of the pump
        in_use = {"loop": self._run.loop_config, "pump": self._run.pump_config}
        self.config = config.model_copy(update=in_use)

    def send_command(self, command: Command) -> None:
        """Run the tick that executes the command. Raises HoldError if it is refused."""
        self._pending = (command,)
        answer = self._advance(1)
        self._early = _join_news(self._early, answer)
        for event in answer.events:
            if isinstance(event, CommandTaken) and event.refused:
                raise HoldError(f"refused: {event.refused}")

    def read_news(self) -> News:
        """Return half a second of twin time."""
        early, self._early = self._early, News((), (), ())
        return _join_news(early, self._advance(round(_NEWS_S * self.config.loop.rate_hz)))

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
            tick = self._run.run_tick(commands)
            if tick is not None:
                rows.append(tick.row)
                events += tick.events
        if not rows and self._run.finished is not None:
            raise HoldError(f"the run has ended ({self._run.finished.name.lower()})")
        self.rows += rows
        shapes, self._shapes = tuple(self._shapes), []
        return News(tuple(rows), tuple(events), shapes)


def _join_news(early: News, late: News) -> News:
    return News(early.rows + late.rows, early.events + late.events, early.shapes + late.shapes)
