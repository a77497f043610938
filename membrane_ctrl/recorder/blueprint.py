"""How a run opens in the viewer: one tab per question."""

from dataclasses import dataclass
from enum import IntEnum

import rerun as rr
import rerun.blueprint as rrb

from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller import safety
from membrane_ctrl.model.states import Rung, ShapeState, State


def run_blueprint(config: Config) -> rrb.Blueprint:
    """The layout of a run; it has a shape tab only if the shape is measured."""
    tabs = [_overview(config), _loop(config), _environment(config), _timing(), _long_review()]
    if config.shape.enabled:
        tabs.insert(2, _shape(config))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="run_time"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def _whole_run() -> rrb.TimeAxis:
    """Show the whole run; the default, and plots linked to one axis, show half a minute around the cursor."""
    everything = rr.TimeRange(start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite())
    return rrb.TimeAxis(view_range=everything)


def _plot(name: str, *paths: str, span: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        origin="/",
        contents=[f"+ {path}" for path in paths],
        axis_x=_whole_run(),
        axis_y=None if span is None else rrb.ScalarAxis(range=span),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightBottom),
    )


def _error(config: Config) -> rrb.TimeSeriesView:
    """Plot the error over twice the band: the start, tens of um off, would make the hold invisible."""
    span = (-2 * config.limits.band_um, 2 * config.limits.band_um)
    return _plot("Error and band, um", "/loop/error", "/truth/error", "/loop/band", span=span)


def _lanes() -> rrb.StateTimelineView:
    contents = ["+ /state/controller", "+ /state/shape_loop", "+ /state/verdict", "+ /state/rung", "+ /state/fault"]
    return rrb.StateTimelineView(name="States", origin="/state", contents=contents, time_view=_whole_run())


def _text_log() -> rrb.TextLogView:
    return rrb.TextLogView(
        name="Events",
        origin="/events",
        columns=rrb.TextLogColumns(timeline_columns=["run_time"], text_log_columns=["loglevel", "body"]),
    )


def _overview(config: Config) -> rrb.Vertical:
    return rrb.Vertical(
        _error(config),
        _plot("Setpoint, reading and true centre, um", "/loop/position", "/truth/displacement"),
        rrb.Horizontal(_lanes(), _text_log(), column_shares=[3, 2]),
        rrb.Horizontal(_plot("Pump", "/pump/drive"), _plot("Flow and leak, um/s", "/loop/flow")),
        row_shares=[3, 2.5, 2.5, 2],
        name="Overview",
    )


def _loop(config: Config) -> rrb.Vertical:
    return rrb.Vertical(
        _error(config),
        _plot("P, I, D and feed-forward, um/s", "/loop/terms"),
        _plot("Flow wanted, flow and leak, um/s", "/loop/flow"),
        _plot("Pump and vent", "/pump/drive"),
        name="Loop",
    )


def _environment(config: Config) -> rrb.Vertical:
    return rrb.Vertical(
        _plot("Ambient pressure, Pa", "/ambient/pressure"),
        _plot("Gauge pressure, Pa", "/gas/pressure"),
        _plot("Temperatures, C", "/ambient/temperature", "/gas/temperature"),
        _error(config),
        name="Environment",
    )


def _shape(config: Config) -> rrb.Vertical:
    maps = [
        rrb.Spatial2DView(name=name, origin=f"/shape/map/{kind}")
        for kind, name in (
            ("height", "Height"),
            ("difference", "Difference to the first of hold"),
            ("uncertainty", "Uncertainty, 1 sigma"),
        )
    ]
    band = config.limits.band_um
    pictures = [rrb.TextDocumentView(name="Colours", origin="/shape/legend")]
    rows = [
        rrb.Horizontal(*maps, *pictures, column_shares=[1, 1, 1, 1]),
        rrb.Horizontal(
            _plot(
                "Sag change by the camera and by the laser, um",
                "/shape/sag_change",
                "/shape/trim",
                span=(-band, band),
            ),
            _plot("Low orders, change since hold began, um", "/shape/change", span=(-band / 4, band / 4)),
            rrb.BarChartView(name="Change of Z2..Z36, um", origin="/shape/change_bars"),
        ),
        rrb.Horizontal(
            _plot("Slope residual, urad", "/shape/residual"),
            _plot("Fringe quality", "/shape/quality"),
            _plot("Last frame to result, ms", "/shape/latency"),
        ),
    ]
    if config.recording.thumbnails:
        names = [f"{axis}_sin_{k}" for axis in "xy" for k in (0, 1)]
        rows.append(rrb.Horizontal(*(rrb.Spatial2DView(name=name, origin=f"/frames/{name}") for name in names)))
    return rrb.Vertical(*rows, row_shares=[4, 3, 2, 3][: len(rows)], name="Shape")


def _timing() -> rrb.Vertical:
    return rrb.Vertical(
        _plot("Lateness of the tick, ms", "/tick/lateness"),
        _plot("Time between ticks, s", "/tick/dt"),
        _plot("Ticks missed so far", "/tick/missed"),
        _plot("Last frame to result, ms", "/shape/latency"),
        name="Timing",
    )


def _long_review() -> rrb.Vertical:
    return rrb.Vertical(
        _plot("Error: minimum, mean and maximum of each second, um", "/overview/error", "/loop/band"),
        _plot("Trim, um", "/shape/trim"),
        _lanes(),
        _text_log(),
        name="Long review",
    )


# State lanes: the words of a lane, their colours, and the meaning of a row's codes.


@dataclass(frozen=True, slots=True)
class Lane:
    """One row of the state timeline.

    Attributes
    ----------
    path : str
        Rerun entity.
    field : str
        Telemetry field that holds the code; empty if the lane does not come from telemetry.
    words : dict
        Code to word.
    colours : dict
        Word to 0xRRGGBBAA; a word without one gets the viewer's choice.
    """

    path: str
    field: str
    words: dict[int, str]
    colours: dict[str, int]

    def word(self, code: int) -> str:
        """The word for a code; an unknown code is shown as a number."""
        return self.words.get(code, f"code {code}")


_CALM, _BUSY, _GOOD, _WARN, _BAD = 0x5A5A5AFF, 0x56B4E9FF, 0x009E73FF, 0xE69F00FF, 0xD55E00FF


def _words(codes: type[IntEnum]) -> dict[int, str]:
    return {int(code): code.name.lower() for code in codes}


_FAULTS = {0: "none"} | {rule.code: rule.name for rule in safety.TABLE}

STATE = Lane(
    "/state/controller",
    "state",
    _words(State),
    {
        "standby": _CALM, "check": _BUSY, "inflate": _BUSY, "settle": _WARN, "hold": _GOOD,
        "manual": 0xCC79A7FF, "tune": 0xF0E442FF, "lower": _WARN, "fault": _BAD,
    },
)  # fmt: skip
SHAPE = Lane(
    "/state/shape_loop",
    "shape_state",
    _words(ShapeState),
    {"off": _CALM, "waiting": _BUSY, "tracking": _GOOD, "suspended": _WARN},
)
RUNG = Lane(
    "/state/rung",
    "rung",
    _words(Rung),
    {"none": _CALM, "hold_flow": _WARN, "ramp_down": _WARN, "pump_off": _BAD, "vent": _BAD},
)
FAULT = Lane("/state/fault", "fault", _FAULTS, dict.fromkeys(_FAULTS.values(), _BAD) | {"none": _CALM})
VERDICT = Lane("/state/verdict", "", {}, {"ok": _GOOD, "degraded": _WARN, "rejected": _BAD})

TELEMETRY_LANES: tuple[Lane, ...] = (STATE, SHAPE, RUNG, FAULT)
LANES: tuple[Lane, ...] = (*TELEMETRY_LANES, VERDICT)
