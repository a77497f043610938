"""What gains would do, for all viewers: the sessions and runs that can be explored, and the curves
of each setting of the sliders.

All of it is computed on a pool. The numerics of tuning are imported there, at the first use: that
takes seconds, and most services never need them.
"""

from __future__ import annotations

import gzip
import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

from membrane_ctrl.model import errors
from membrane_ctrl.model.columns import MISSING
from membrane_ctrl.review import catalogue
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.work_pools import GAINS
from membrane_ctrl.sessions import folder as folders
from membrane_ctrl.web.gains_charts import YOURS, make_gains_charts
from membrane_ctrl.web.made_once import MadeOnce
from membrane_ctrl.web.session_status import is_running

if TYPE_CHECKING:
    from tuning.explore.curves import Curves
    from tuning.explore.workpiece import Workpiece

_SESSIONS = "tuning"  # folder of the sessions in that of the runs
_SOURCES_MOST = 20
_NAME = re.compile(r"(?:tuning/)?[A-Za-z0-9][A-Za-z0-9._-]{0,127}")
_LISTED_S = 15.0
_LIFE_S = 10.0  # a browser fetches what was computed at once
_WORKPIECES_MOST = 8
_LOOP_KEYS = ("kp_per_s", "ti_s", "td_s", "measurement_filter_s")
_GAIN_ROWS = ("K, 1/s", "Ti, s", "Td, s", "filter, s")
_FIGURE_ROWS = (
    "std, µm",
    "std / least possible",
    "Ms, largest sensitivity",
    "gain margin",
    "phase margin, °",
    "delay margin, s",
    "load peak, µm",
    "recovery, s",
)

# closed-loop time constant, damping, filter; s, 1, s
Setting = tuple[float, float, float]


def parse_setting(text: str) -> Setting | None:
    """A setting from a comma-separated text, None from an empty one; raises ValueError for
    others.
    """
    if not text:
        return None
    values = tuple(float(part) for part in text.split(","))
    if len(values) != 3 or not all(math.isfinite(value) and value > 0 for value in values):
        raise ValueError(f"{text}: three positive numbers")
    return values


@dataclass(frozen=True, slots=True)
class GainsSource:
    """A session or run that can be explored.

    Attributes
    ----------
    text : str
        Where plant and weather come from, in a sentence.
    settings : dict
        By the name of gains that the sliders may start from: their setting.
    time_constants_s, dampings, filters_s : (float, float)
        What the sliders reach.
    takes_gains : bool
        Whether gains can be saved into it.
    """

    text: str
    settings: dict[str, Setting]
    time_constants_s: tuple[float, float]
    dampings: tuple[float, float]
    filters_s: tuple[float, float]
    takes_gains: bool


@dataclass(frozen=True, slots=True)
class ExploredGains:
    """A set of gains and what it would do.

    Attributes
    ----------
    loop : dict
        The keys of `[loop]`.
    heads, rows : tuple
        Table of the figures: names of the gains, and a row for each figure.
    refusal : str
        Why the gains must not be tried or saved; empty if they may.
    charts : bytes
        Options of the charts, as JSON in gzip.
    """

    loop: dict[str, float]
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    refusal: str
    charts: bytes

    @property
    def command(self) -> str:
        """The command that tries them without the page."""
        return f"membrane-ctrl ctl gains --trial 5m '{json.dumps(self.loop)}'"


@dataclass(frozen=True, slots=True)
class ChosenGains:
    """What the sliders of a session or run are set to.

    Attributes
    ----------
    start : str
        Name of the gains from which they started.
    setting : Setting or None
        None: those gains themselves.
    author : str
        Who has moved them last.
    """

    start: str
    setting: Setting | None
    author: str


class GainsViews:
    """The explored gains of the holds of a page.

    Parameters
    ----------
    feeds : mapping of HoldFeed
        By the name of the hold on the page; their folders of runs are read.
    """

    def __init__(self, feeds: Mapping[str, HoldFeed]) -> None:
        self._feeds = feeds
        self._sources = MadeOnce(self._list, GAINS, life_s=_LISTED_S)
        self._explored = MadeOnce(self._explore, GAINS, life_s=_LIFE_S)
        self._chosen: dict[tuple[str, str], ChosenGains] = {}

    def find_chosen(self, hold: str, name: str) -> ChosenGains | None:
        """What the sliders of a session or run are set to, for all viewers.

        Parameters
        ----------
        hold : str
            Name of the hold on the page.
        name : str
            `tuning/SESSION` or the name of a run folder, as `list_sources` returns it.

        Returns
        -------
        ChosenGains or None
            None: no viewer has moved them since the service began.
        """
        return self._chosen.get((hold, name))

    def choose(self, hold: str, name: str, chosen: ChosenGains) -> None:
        """Set the sliders of a session or run, for all viewers.

        Parameters
        ----------
        hold : str
            Name of the hold on the page.
        name : str
            Of a source that `open_source` has read: others would be kept for nothing.
        chosen : ChosenGains
            Replaces the setting of the viewer who moved them before.
        """
        self._chosen[hold, name] = chosen

    async def list_sources(self, hold: str) -> list[str]:
        """Names of the sessions and runs that may be explored, the newest session first. Raises
        PoolFullError.
        """
        return await self._sources.get(hold)

    async def open_source(self, hold: str, name: str) -> GainsSource:
        """Read a session or run, on the pool of the gains.

        Parameters
        ----------
        hold : str
            Name of the hold on the page.
        name : str
            As `list_sources` returns it.

        Raises
        ------
        InputError
            It cannot be explored, or is not in the hold's folder.
        PoolFullError
            Too many viewers explore at once.
        """
        return await GAINS.run(self._open, hold, name)

    async def explore(
        self, hold: str, name: str, start: str, setting: Setting | None
    ) -> ExploredGains:
        """What gains would do, beside the present ones and those of `start`.

        Parameters
        ----------
        hold, name : str
            Name of the hold on the page, and of a session or run as `list_sources` returns it.
        start : str
            Of `GainsSource.settings`.
        setting : Setting or None
            Of the sliders; None: the gains of `start` themselves.

        Raises
        ------
        InputError
            Unknown names, or a setting beyond the sliders.
        PoolFullError
            Too many viewers explore at once.
        """
        return await self._explored.get(hold, name, start, setting)

    async def save(self, hold: str, name: str, loop: Mapping[str, float], author: str) -> str:
        """Save gains into a session as its chosen ones; returns what to do next, as a sentence.

        Parameters
        ----------
        hold : str
            Name of the hold on the page.
        name : str
            `tuning/SESSION`; a run takes no gains.
        loop : mapping
            Keys of `[loop]` with their values, as `ExploredGains.loop`.
        author : str
            Name of the user, for the session's log.

        Raises
        ------
        InputError
            The session runs, takes no gains, or these keep too little margin.
        DeviceError
            The session's folder cannot be written.
        PoolFullError
            Too many viewers explore at once.
        """
        return await GAINS.run(self._save, hold, name, dict(loop), author)

    def _list(self, hold: str) -> list[str]:
        """The newest sessions that have identified and observed, then the newest runs that are long
        enough.
        """
        from tuning.explore.workpiece import SHORTEST_S

        logs = self._find_logs(hold)
        sessions = sorted((logs / _SESSIONS).glob("*/session.json"), reverse=True)[:_SOURCES_MOST]
        found = []
        for head in sessions:
            with suppress(errors.CommandError, OSError):
                opened = folders.open_session(head.parent)
                if opened.is_done("identify") and opened.is_done("observe"):
                    found.append(f"{_SESSIONS}/{opened.path.name}")
        runs = [
            entry
            for entry in (catalogue.list_entries(logs) if logs.is_dir() else [])
            if entry.duration_s > SHORTEST_S
        ]
        runs.sort(key=lambda entry: entry.started_utc, reverse=True)
        return found + [entry.name for entry in runs[:_SOURCES_MOST]]

    def _open(self, hold: str, name: str) -> GainsSource:
        """Read the plant and weather of a session or run, and where its sliders stand for each
        named gain.
        """
        from tuning.explore.sliders import (
            DAMPINGS,
            FILTERS_S,
            Sliders,
            find_time_constants_s,
        )

        of = self._load(hold, name).of
        dt_s = of.weather.rest.dt_s
        settings = {}
        for each, gains in of.named_gains.items():
            at = Sliders.place_near(gains, of.model, dt_s).within_reach(of.model, dt_s)
            settings[each] = (at.closed_loop_s, at.damping, at.filter_s)
        return GainsSource(
            of.source,
            settings,
            find_time_constants_s(of.model, dt_s),
            DAMPINGS,
            FILTERS_S,
            of.session is not None and of.proposed is not None,
        )

    def _explore(self, hold: str, name: str, start: str, setting: Setting | None) -> ExploredGains:
        """Compute the curves of the sliders' gains, beside the present ones and those of
        `start`.
        """
        from tuning.explore.crossings import find_crossings
        from tuning.explore.curves import STEP_UM, compute_curves, find_duration_s
        from tuning.explore.sliders import Sliders
        from tuning.proposal.candidate import PRESENT, find_refusal
        from tuning.proposal.gain_search import Demands

        # The gains that were asked for, as the sliders can give them.
        loaded = self._load(hold, name)
        of = loaded.of
        named = of.named_gains
        if start not in named:
            raise errors.InputError(f"{start}: not among {', '.join(named)}")
        dt_s = of.weather.rest.dt_s
        if setting is None:
            gains = named[start]
        else:
            gains = Sliders(*setting).within_reach(of.model, dt_s).make_gains(of.model, dt_s)
        gains = gains.round_to_four_digits()
        # Curves of the present gains, of those that the sliders began at, and of theirs.
        shown = {each: named[each] for each in dict.fromkeys((PRESENT, start))}
        duration_s = max(find_duration_s(each, of.model) for each in shown.values())
        found = {each: loaded.compute_named(each, duration_s) for each in shown}
        found[YOURS] = compute_curves(YOURS, gains, of, duration_s)
        yours = found[YOURS]
        demands = Demands()
        charts = make_gains_charts(
            found,
            find_crossings(yours.w_rad_per_s, yours.open_loop),
            STEP_UM,
            demands.load_step_um_per_s,
            demands.ms,
            dt_s,
        )
        values = (gains.kp_per_s, gains.ti_s, gains.td_s, gains.filter_s)
        return ExploredGains(
            dict(zip(_LOOP_KEYS, values, strict=True)),
            tuple(found),
            _make_rows(list(found.values())),
            find_refusal(yours.figures),
            gzip.compress(json.dumps(charts).encode(), 1),
        )

    def _save(self, hold: str, name: str, loop: dict[str, float], author: str) -> str:
        from tuning.explore.saving import save_gains
        from tuning.identification.closed_loop import Gains

        of = self._load(hold, name).of
        if of.session is not None and is_running(of.session.path):
            raise errors.InputError("not saved: the session runs; wait for its end")
        return save_gains(of, Gains(*(loop[key] for key in _LOOP_KEYS)), author)

    def _find_logs(self, hold: str) -> Path:
        logs = self._feeds[hold].logs
        if logs is None:
            raise errors.InputError("the runs of this hold are on another machine")
        return logs

    def _load(self, hold: str, name: str) -> _Loaded:
        logs = self._find_logs(hold)
        if _NAME.fullmatch(name) is None:
            raise errors.InputError(f"{name[:80]!r}: not the name of a session or run")
        path = logs / name
        return _load_workpiece(path, logs, _find_stamp(path))


def _find_stamp(path: Path) -> tuple[int, ...]:
    """When the results of a session, or the end of a run, were written."""
    found = []
    for name in ("disturbance.json", "identified.json", "gains.toml", "summary.json"):
        with suppress(OSError):
            found.append((path / name).stat().st_mtime_ns)
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Loaded:
    """A workpiece, and the curves of its named gains, which do not depend on the sliders."""

    of: Workpiece
    curves: dict[tuple[str, float], Curves] = field(default_factory=dict)

    def compute_named(self, name: str, duration_s: float) -> Curves:
        """Curves of gains that have a name."""
        from tuning.explore.curves import compute_curves

        key = (name, duration_s)
        if key not in self.curves:
            gains = self.of.named_gains[name]
            self.curves[key] = compute_curves(name, gains, self.of, duration_s)
        return self.curves[key]


@lru_cache(maxsize=_WORKPIECES_MOST)
def _load_workpiece(path: Path, logs: Path, _stamp: tuple[int, ...]) -> _Loaded:
    from tuning.explore.workpiece import load_workpiece

    return _Loaded(load_workpiece(path, logs))


def _make_rows(found: Sequence[Curves]) -> tuple[tuple[str, ...], ...]:
    """The table: a row for each gain and figure, a cell for each set of gains."""
    columns = [_format_column(each) for each in found]
    return tuple(
        (title, *cells)
        for title, *cells in zip((*_GAIN_ROWS, *_FIGURE_ROWS), *columns, strict=True)
    )


def _format_column(curves: Curves) -> list[str]:
    """The cells of one set of gains: the gains, then predicted error, margins and response to a
    load.
    """
    of, gains, margins = curves.figures, curves.figures.gains, curves.figures.margins
    cells = [f"{gains.kp_per_s:.3f}"]
    cells += [f"{value:.2f}" for value in (gains.ti_s, gains.td_s, gains.filter_s)]
    if of.predicted is None:
        return [*cells, "unstable", *[MISSING] * (len(_FIGURE_ROWS) - 1)]
    figures = (
        of.predicted.std_um,
        of.ratio,
        margins.ms,
        margins.gain_margin,
        margins.phase_margin_deg,
        margins.delay_margin_s,
        of.load_peak_um,
        of.load_recovery_s,
    )
    return cells + [f"{value:.3g}" for value in figures]
