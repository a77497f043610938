"""What is the same for all viewers of a hold, made once: charts, maps, alarms, the tuning session.

Browsers fetch charts and maps when they are ready, so that none pile up for a slow one.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.run_files.run_config import read_config
from membrane_ctrl.service.feed import SIGNALS, SPANS_S, HoldFeed, history, marks
from membrane_ctrl.service.work_pools import (
    FIGURES,
    LIVE_CHARTS,
    LONG_CHARTS,
    RUN_LISTS,
    SESSIONS,
)
from membrane_ctrl.web import alarm_history, figure_map
from membrane_ctrl.web.gains_views import GainsViews
from membrane_ctrl.web.history_chart import SIGNALS_MOST, ChartLine, make_history_chart
from membrane_ctrl.web.made_once import MadeOnce
from membrane_ctrl.web.tuning_panel import SessionWatch

LOOK_S = 1.0
# how often a browser fetches a chart; longer spans once a minute
CHART_EVERY_S = {60.0: 1.0, 600.0: 2.0, 3600.0: 5.0}
HEIGHT, FIRST_FIGURE = "nothing: the height", "the first figure"
_LONG_CHART_LIFE_S = 30.0
_MAP_LIFE_S = 60.0
_ALARMS_LIFE_S = 10.0
_REFERENCES_MOST = 8


def parse_signals(text: str) -> tuple[str, ...]:
    """Names of signals from a comma-separated text; raises ValueError for others, or too many."""
    names = tuple(text.split(","))
    if not 0 < len(names) <= SIGNALS_MOST or not set(names) <= set(SIGNALS):
        raise ValueError(f"{text}: one to {SIGNALS_MOST} of {', '.join(SIGNALS)}")
    return names


def parse_removed(text: str) -> tuple[str, ...]:
    """Names of terms from a comma-separated text, sorted; raises ValueError for others."""
    names = tuple(sorted(set(text.split(",")) - {""}))
    if not set(names) <= set(figure_map.REMOVABLE):
        raise ValueError(f"{text}: some of {', '.join(figure_map.REMOVABLE)}")
    return names


class SharedViews:
    """The views of the holds of a page."""

    def __init__(self, feeds: Mapping[str, HoldFeed]) -> None:
        self._feeds = feeds
        self._live_charts = MadeOnce(self._make_chart, LIVE_CHARTS, life_s=LOOK_S)
        self._long_charts = MadeOnce(self._make_chart, LONG_CHARTS, life_s=_LONG_CHART_LIFE_S)
        self._maps = MadeOnce(self._make_map, FIGURES, life_s=_MAP_LIFE_S)
        self._alarms = MadeOnce(self._list_alarms, RUN_LISTS, life_s=_ALARMS_LIFE_S)
        self._references: dict[str, dict[str, ShapeEstimate]] = {name: {} for name in feeds}
        watches = {
            name: SessionWatch(feed.logs) for name, feed in feeds.items() if feed.logs is not None
        }
        self.gains = GainsViews(feeds)
        self._watches = watches
        self.sessions = MadeOnce(lambda hold: watches[hold].look(), SESSIONS, life_s=LOOK_S)

    async def chart(self, hold: str, signals: tuple[str, ...], span: str, utc: bool) -> bytes:
        """Options of the history chart, as JSON in gzip.

        Parameters
        ----------
        hold : str
            Name of the hold on the page.
        signals : tuple of str
            Columns, one panel each; as `parse_signals` returns them.
        span : str
            Key of `SPANS_S`. A short span is made again every second, a longer one twice a minute.
        utc : bool
            Labels in UTC; else in the time zone of the service.

        Raises
        ------
        PoolFullError
            Too many charts are wanted at once; the browser asks again.
        """
        charts = self._live_charts if SPANS_S[span] in CHART_EVERY_S else self._long_charts
        return await charts.get(hold, signals, span, utc)

    async def map(
        self, hold: str, removed: tuple[str, ...], reference: str, time_s: float
    ) -> figure_map.FigureMap:
        """The map of the newest figure.

        Parameters
        ----------
        hold : str
            Name of the hold on the page.
        removed : tuple of str
            Terms left out of the map, sorted; as `parse_removed` returns them.
        reference : str
            One of `list_references`. The height is shown against one that is no longer kept.
        time_s : float
            Time of the newest figure, by the hold's clock. It only marks the map in the store:
            viewers with the same figure share one map.

        Raises
        ------
        PoolFullError
            Too many maps are wanted at once.
        """
        return await self._maps.get(hold, removed, reference, time_s)

    async def alarms(self, hold: str) -> list[alarm_history.PastAlarm]:
        """The faults and notices of the last runs, newest first. Raises PoolFullError."""
        return await self._alarms.get(hold)

    def session_chart(self, hold: str) -> bytes:
        """Options of the chart of the newest tuning session, as JSON in gzip."""
        return gzip.compress(json.dumps({"session": self._watches[hold].make_chart()}).encode(), 1)

    def list_references(self, hold: str) -> list[str]:
        """What a figure may be compared with."""
        return [FIRST_FIGURE, HEIGHT, *self._references[hold]]

    def add_reference(self, hold: str) -> str:
        """Keep the newest figure as a reference for all viewers; returns its name, empty without a
        usable figure.
        """
        figure = self._feeds[hold].seen.figure
        if figure is None or figure.verdict == "rejected":
            return ""
        kept = self._references[hold]
        name = f"the figure of {datetime.now(UTC):%H:%M:%S} UTC"
        kept[name] = figure
        while len(kept) > _REFERENCES_MOST:
            del kept[next(iter(kept))]
        return name

    def config(self, hold: str) -> Config | None:
        """The configuration of the run, if its folder is on this machine."""
        folder = self._feeds[hold].folder
        return None if folder is None else _read_config(folder)

    def _make_chart(self, hold: str, signals: tuple[str, ...], span: str, utc: bool) -> bytes:
        # The signals, the marks of people, and the faults, as lines over all panels
        feed, span_s = self._feeds[hold], SPANS_S[span]
        found = [(signal, history(feed, feed.logs, signal, span_s)) for signal in signals]
        moments = [ChartLine(utc_s, text) for utc_s, text in marks(feed, feed.logs, span_s)]
        begin_s = datetime.now(UTC).timestamp() - span_s
        moments += [
            ChartLine(alarm.began_s, alarm.name.replace("_", " "), is_alarm=True)
            for alarm in self._list_alarms(hold)
            if alarm.is_fault and alarm.began_s > begin_s
        ]
        moments.sort(key=lambda each: each.utc_s)
        options = make_history_chart(found, utc, moments)
        return gzip.compress(json.dumps(options).encode(), 1)

    def _make_map(
        self, hold: str, removed: tuple[str, ...], reference: str, _time_s: float
    ) -> figure_map.FigureMap:
        seen = self._feeds[hold].seen
        assert seen.figure is not None
        against = self._references[hold].get(reference)
        if reference == FIRST_FIGURE and seen.reference is not seen.figure:
            against = seen.reference
        return figure_map.make_figure_map(seen.figure, against, removed, self.config(hold))

    def _list_alarms(self, hold: str) -> list[alarm_history.PastAlarm]:
        logs = self._feeds[hold].logs
        return [] if logs is None else alarm_history.list_alarms(logs)


@lru_cache(maxsize=64)
def _read_config(folder: Path) -> Config | None:
    """A run's configuration, which does not change; None if it cannot be read."""
    try:
        return read_config(folder, [])
    except OSError:
        return None
