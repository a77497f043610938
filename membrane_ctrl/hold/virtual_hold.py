"""A hold on the twin in virtual time that begins in standby, as a session uses a hold."""

from collections.abc import Callable

from firmware_iface.optical_roles import Pixels
from membrane_ctrl.acquisition.virtual_camera import VirtualCamera
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import ShapeSource, TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model import events, shape_estimate, telemetry
from membrane_ctrl.sessions.live_hold import HoldError, News
from membrane_ctrl.sim import virtual_bench

_NEWS_S = 5.0  # of virtual time a call
_ENDS_S = 60.0


class VirtualHold:
    """A `HoldLink`; time passes only while the caller waits for news.

    Parameters
    ----------
    config : Config
        Of the simulated hold.
    bench : VirtualBench
        Plant and board; the caller may disturb them.
    name : str
        Of the run.
    alter_picture : callable, optional
        Figures come from rendered frames, altered by it; without it, from the twin's truth.
    """

    def __init__(
        self,
        config: Config,
        bench: virtual_bench.VirtualBench,
        name: str,
        alter_picture: Callable[[Pixels], Pixels] | None = None,
    ) -> None:
        self.config = config
        self.name = name
        self._rate_hz = config.loop.rate_hz
        source: ShapeSource | None = None
        if config.shape.enabled and alter_picture is not None:
            source = VirtualCamera(config, bench.plant, alter_picture)
        elif config.shape.enabled:
            source = TruthShape(bench, config, config.twin.seed)
        self._source = source
        self._shapes: list[shape_estimate.ShapeEstimate] = []
        self._run = VirtualRun(
            config, bench, zernike_projection(), None if source is None else self._take_shape
        )
        self._early = News((), (), ())

    def send_command(self, command: Command) -> None:
        """Run the tick that executes the command. Raises HoldError if it is refused."""
        news = self._advance(1, (command,))
        self._early = _join_news(self._early, news)
        for event in news.events:
            if isinstance(event, events.CommandTaken) and event.refused:
                raise HoldError(f"refused: {event.refused}")

    def read_news(self) -> News:
        """Return the news of some seconds of virtual time."""
        early, self._early = self._early, News((), (), ())
        return _join_news(early, self._advance(round(_NEWS_S * self._rate_hz)))

    def close(self) -> None:
        """Stop the run."""
        commands: tuple[Command, ...] = (Command("stop", "commission"),)
        for _ in range(round(_ENDS_S * self._rate_hz)):
            if self._run.finished is not None:
                return
            self._run.run_tick(commands)
            commands = ()

    def _take_shape(self, now_s: float) -> shape_estimate.ShapeEstimate | None:
        assert self._source is not None
        estimate = self._source(now_s)
        if estimate is not None:
            self._shapes.append(estimate)
        return estimate

    def _advance(self, ticks: int, commands: tuple[Command, ...] = ()) -> News:
        """Run some ticks, the first one with the commands; returns all that they made. Raises
        HoldError.
        """
        rows: list[telemetry.TelemetryRow] = []
        found: list[events.Event] = []
        for _ in range(ticks):
            if self._run.finished is not None:
                break
            tick = self._run.run_tick(commands)
            commands = ()
            if tick is not None:
                rows.append(tick.row)
                found += tick.events
        if not rows and self._run.finished is not None:
            raise HoldError(f"the run has ended ({self._run.finished.name.lower()})")
        shapes, self._shapes = tuple(self._shapes), []
        return News(tuple(rows), tuple(found), shapes)


def _join_news(early: News, late: News) -> News:
    return News(early.rows + late.rows, early.events + late.events, early.shapes + late.shapes)
