"""The page of `tune explore`: sliders, curves and a table, served by Bokeh on localhost."""

import asyncio
import html
import json
import math
import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from bokeh import document, layouts, models, plotting
from bokeh.models import widgets
from bokeh.server.server import Server

from membrane_ctrl.model import errors
from membrane_ctrl.sessions import folder
from tuning import gains_file
from tuning.explore.curves import (
    DAMPINGS,
    DELAYS,
    STEP_UM,
    Curves,
    Sliders,
    Workpiece,
    curves,
    of_path,
    shown_s,
)
from tuning.explore.live_page import LivePage
from tuning.identification import closed_loop
from tuning.proposal import candidate, gain_search, tuning_rules
from tuning.steps.design import EDITED

_HOST = "127.0.0.1"
_COLOURS = {"present": "#888888", "proposed": "#1f77b4", "yours": "#d95f02"}
_SIZE: dict[str, Any] = {
    "height": 270,
    "width": 470,
    "toolbar_location": "above",
    "tools": "pan,box_zoom,wheel_zoom,reset,save",
}
_DECADES = models.CustomJSTickFormatter(code="return (10 ** tick).toPrecision(2) + ' s'")
_FILTER_S = (0.01, 2.0)
_HEAD = (
    "",
    "K 1/s",
    "Ti s",
    "Td s",
    "filter s",
    "std µm",
    "x least",
    "Ms",
    "gain margin",
    "phase margin °",
    "delay margin s",
    "load peak µm",
    "recovery s",
)
_STYLE = (
    "<style>table.gains{border-collapse:collapse;font:13px sans-serif}table.gains td,table.gains th"
    "{padding:2px 8px;text-align:right;border-bottom:1px solid #ccc}table.gains "
    "td:first-child{text-align:left}"
    "</style>"
)

Save = Callable[[closed_loop.Gains], str]


class Page:
    """One viewer's page; each has separate sliders.

    `save` receives the gains that a person saves and returns what the page then shows; None: there
    is no session to save into.
    """

    def __init__(self, of: Workpiece, save: Save | None) -> None:
        self._of = of
        self._save = save
        self._dt_s = of.weather.rest.dt_s
        self._fixed = {"present": closed_loop.Gains.of(of.loop)}
        if of.proposed is not None:
            self._fixed["proposed"] = of.proposed
        self._duration_s = max(shown_s(gains, of.model) for gains in self._fixed.values())
        self._curves = {
            name: curves(name, gains, of, self._duration_s) for name, gains in self._fixed.items()
        }
        self._gains = list(self._fixed.values())[-1]
        self._moving = False
        self._make_sliders()
        self._over_time = {name: models.ColumnDataSource() for name in _COLOURS}
        self._over_frequency = {name: models.ColumnDataSource() for name in _COLOURS}
        self._table = widgets.Div(name="table", sizing_mode="stretch_width")
        self._message = widgets.Div(name="said", text="")
        for name, found in self._curves.items():
            self._fill(name, found)
        self._show(self._gains)

    def attach(self, page: document.Document) -> None:
        """Put the page into a viewer's document."""
        page.title = "tune explore"
        copy = widgets.Button(
            label="Copy the command", name="copy", button_type="default", width=170
        )
        copy.js_on_click(
            models.CustomJS(
                args={"said": self._command}, code="navigator.clipboard.writeText(said.text)"
            )
        )
        unable = self._save is None
        save = widgets.Button(
            label="Save as gains.toml",
            name="save",
            button_type="primary",
            width=170,
            disabled=unable,
        )
        save.on_click(self._saved)
        source = widgets.Div(
            text=f"<b>{html.escape(self._of.source)}</b>", sizing_mode="stretch_width"
        )
        buttons = layouts.row(copy, save, self._message)
        controls = layouts.column(
            self._start, self._speed, self._damping, self._filter, buttons, self._command
        )
        page.add_root(
            layouts.column(
                source,
                layouts.row(controls, self._table),
                *self._plots(),
                sizing_mode="stretch_width",
            )
        )

    def _make_sliders(self) -> None:
        of = self._of
        at = Sliders.near(self._gains, of.model, self._dt_s)
        delay_s = tuning_rules.compute_effective_delay_s(of.model, self._dt_s, 0.0)
        low, high = (math.log10(share * delay_s) for share in DELAYS)
        self._start = widgets.Select(
            title="start from",
            name="start",
            options=list[str | tuple[Any, str]](self._fixed),
            value=list(self._fixed)[-1],
        )
        self._speed = widgets.Slider(
            title="response: closed-loop time constant (fast to slow)",
            name="speed",
            start=low,
            end=high,
            step=0.01,
            value=math.log10(at.closed_loop_s),
            format=_DECADES,
            width=420,
        )
        self._damping = widgets.Slider(
            title="robustness: integral time per time constant (lively to calm; SIMC 4)",
            name="damping",
            start=DAMPINGS[0],
            end=DAMPINGS[1],
            step=0.1,
            value=at.damping,
            width=420,
        )
        self._filter = widgets.Slider(
            title="measurement filter",
            name="filter",
            start=math.log10(_FILTER_S[0]),
            end=math.log10(_FILTER_S[1]),
            step=0.01,
            value=_filter_place(at.filter_s),
            format=_DECADES,
            width=420,
        )
        self._command = widgets.Div(
            name="command", styles={"font-family": "monospace", "font-size": "12px"}
        )
        self._start.on_change("value", lambda attr, old, new: self._start_from(new))
        for slider in (self._speed, self._damping, self._filter):
            slider.on_change("value", lambda attr, old, new: self._moved())

    def _start_from(self, name: str) -> None:
        gains = self._fixed.get(name)
        if gains is None:  # a browser may send anything
            return
        at = Sliders.near(gains, self._of.model, self._dt_s)
        self._moving = True
        self._speed.value = math.log10(at.closed_loop_s)
        self._damping.value = at.damping
        self._filter.value = _filter_place(at.filter_s)
        self._moving = False
        self._show(gains)

    def _moved(self) -> None:
        if self._moving:
            return
        at = Sliders(10.0**self._speed.value, self._damping.value, 10.0**self._filter.value)
        self._show(at.gains(self._of.model, self._dt_s))

    def _show(self, gains: closed_loop.Gains) -> None:
        self._gains = gains
        found = curves("yours", gains, self._of, self._duration_s)
        self._fill("yours", found)
        rows = [*self._curves.values(), found]
        self._table.text = _STYLE + _table([_row(each) for each in rows])
        self._message.text = ""
        keys = {"kp_per_s": gains.kp_per_s, "ti_s": gains.ti_s, "td_s": gains.td_s}
        keys["measurement_filter_s"] = gains.filter_s
        words = json.dumps({key: float(f"{value:.4g}") for key, value in keys.items()})
        self._command.text = f"membrane-ctrl ctl gains --trial 5m '{words}'"

    def _fill(self, name: str, found: Curves) -> None:
        self._over_time[name].data = {
            "time_s": found.time_s,
            "step_um": found.step_um,
            "load_um": found.load_um,
        }
        response = found.open_loop
        near = np.abs(response) < 30.0  # the Nyquist plot shows the neighbourhood of -1
        hertz = found.w_rad_per_s / (2 * math.pi)
        self._over_frequency[name].data = {
            "hertz": hertz,
            "gain": np.abs(response),
            "phase_deg": np.degrees(np.unwrap(np.angle(response)))
            - 360.0 * (np.angle(response[0]) > 0),
            "sensitivity": np.abs(1 / (1 + response)),
            "re": np.where(near, response.real, np.nan),
            "im": np.where(near, response.imag, np.nan),
            "centre": 2 * 2 * math.pi * found.centre_um2_s / (2 * math.pi),  # one-sided, per hertz
        }

    def _saved(self) -> None:
        assert self._save is not None
        self._message.text = html.escape(self._save(self._gains))

    def _plots(self) -> list[models.Row]:
        times, over, demands = self._over_time, self._over_frequency, gain_search.Demands()
        seconds, hertz = ("time_s", "time (s)"), ("hertz", "frequency (Hz)")
        step = self._plot(
            f"setpoint step of {STEP_UM:g} µm", times, seconds, ("step_um", "centre (µm)")
        )
        title = f"leak grows by {demands.load_step_um_per_s:g} µm/s"
        load = self._plot(title, times, seconds, ("load_um", "centre (µm)"), x_range=step.x_range)
        log_x = {"x_axis_type": "log", "x_range": models.Range1d(start=1e-3, end=0.5 / self._dt_s)}
        log = {**log_x, "y_axis_type": "log"}
        title, high = "true centre in the recorded weather", models.Range1d(start=1e-3, end=1e4)
        centre = self._plot(title, over, hertz, ("centre", "µm²/Hz"), **log)
        gain = self._plot("open loop, gain", over, hertz, ("gain", "|L|"), **log, y_range=high)
        below = models.Range1d(start=-360, end=-60)
        phase = self._plot(
            "open loop, phase", over, hertz, ("phase_deg", "degrees"), **log_x, y_range=below
        )
        peak = models.Range1d(start=0.0, end=2.5)
        sensitivity = self._plot(
            "sensitivity; Ms is its peak",
            over,
            hertz,
            ("sensitivity", "|S|"),
            **log_x,
            y_range=peak,
        )
        near = {
            "x_range": models.Range1d(start=-3, end=1),
            "y_range": models.Range1d(start=-2, end=1),
            "match_aspect": True,
        }
        nyquist = self._plot("Nyquist", over, ("re", "Re L"), ("im", "Im L"), **near)
        nyquist.scatter([-1.0], [0.0], marker="x", size=12, line_width=2, line_color="#c00000")
        for plot, limit in ((gain, 1.0), (phase, -180.0), (sensitivity, demands.ms)):
            plot.hspan(y=[limit], line_dash="dashed", line_color="#999999")
        return [
            layouts.row(step, load, centre),
            layouts.row(gain, phase, sensitivity),
            layouts.row(nyquist),
        ]

    def _plot(
        self,
        title: str,
        sources: dict[str, models.ColumnDataSource],
        x: tuple[str, str],
        y: tuple[str, str],
        **more: Any,
    ) -> plotting.figure:
        plot = plotting.figure(title=title, x_axis_label=x[1], y_axis_label=y[1], **_SIZE, **more)
        for name, source in sources.items():
            if name in self._fixed or name == "yours":
                width = 2.5 if name == "yours" else 1.5
                plot.line(x[0], y[0], source=source, color=_COLOURS[name], line_width=width)
        plot.toolbar.update(logo=None)
        return plot


def _filter_place(filter_s: float) -> float:
    """Where the filter's slider stands."""
    return math.log10(min(max(filter_s, _FILTER_S[0]), _FILTER_S[1]))


def _row(found: Curves) -> list[str]:
    """Cells of a set of gains."""
    of, gains, margins = found.figures, found.figures.gains, found.figures.margins
    cells = [
        of.name,
        f"{gains.kp_per_s:.3f}",
        f"{gains.ti_s:.2f}",
        f"{gains.td_s:.2f}",
        f"{gains.filter_s:.2f}",
    ]
    if of.predicted is None:
        return [*cells, "unstable", *[""] * (len(_HEAD) - len(cells) - 1)]
    figures = (
        of.predicted.std_um,
        of.ratio,
        margins.ms,
        margins.gain_margin,
        margins.phase_margin_deg,
    )
    more = (margins.delay_margin_s, of.load_peak_um, of.load_recovery_s)
    return cells + [f"{value:.3g}" for value in (*figures, *more)]


def _table(rows: list[list[str]]) -> str:
    head = "".join(f"<th>{cell}</th>" for cell in _HEAD)
    lines = (
        f'<tr style="color:{_COLOURS[cells[0]]}">'
        + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells)
        + "</tr>"
        for cells in rows
    )
    return f"<table class=gains><tr>{head}</tr>{''.join(lines)}</table>"


def make_saver(of: Workpiece, author: str) -> Save | None:
    """What the page's button does: put the gains into the session's design, or return why not. None
    without a design.
    """
    opened = of.session
    if opened is None or of.proposed is None:
        return None

    def save(gains: closed_loop.Gains) -> str:
        path = opened.file_path("gains.toml")
        try:
            loop = gains.applied_to(gains_file.load_gains(path).loop)
            found = candidate.evaluate_candidate(
                EDITED, gains, of.model, of.weather, loop, gain_search.Demands()
            )
            std_um = found.predicted.std_um if found.predicted is not None else math.nan
            edits = {
                "author": author,
                "candidate": EDITED,
                "predicted_std_um": std_um,
                "loop": loop,
            }
            made = gains_file.load_gains(path).model_copy(update=edits)
            gains_file.require_sound(made, "these gains", opened.config.loop)
            opened.begin_step("preview")  # what followed was of other gains
            gains_file.save_gains(path, made)
        except (ValueError, errors.InputError) as error:
            return f"Not saved: {str(error).splitlines()[0]}"
        except OSError as error:
            return f"Not saved: {path}: {errors.os_reason(error)}"
        return f"Saved {path}. Next: membrane-ctrl tune apply --session {opened.path}"

    return save


def explore(path: Path, logs: Path, port: int, author: str) -> int:
    """Serve the page of a session or run on localhost; print its address, and end on Ctrl-C or
    SIGTERM.

    Raises InputError for a folder that is neither, DeviceError if the port is taken.
    """
    server = _server(path, logs, port, author)
    print(f"exploring on http://localhost:{server.port}/ until Ctrl-C", flush=True)
    server.run_until_shutdown()
    return 0


def serve_beside(opened: folder.SessionFolder, logs: Path, author: str) -> str:
    """Serve the page of a session from a thread of the program that runs it; returns its address.

    Raises DeviceError if there is no port.
    """
    begun: queue.Queue[Server | Exception] = queue.Queue()

    def serve() -> None:
        async def forever() -> None:
            begun.put(_server(opened.path, logs, 0, author))
            await asyncio.Event().wait()

        try:
            asyncio.run(forever())
        except Exception as error:
            begun.put(error)

    threading.Thread(target=serve, daemon=True, name="page").start()
    server = begun.get()
    if isinstance(server, Exception):
        raise server
    return f"http://localhost:{server.port}/"


def _server(path: Path, logs: Path, port: int, author: str) -> Server:
    """A server, started: at `/` gains to explore, or the session until there are any; at `/session`
    the session.
    """
    opened = folder.open_session(path) if (path / "session.json").exists() else None
    of = of_path(path, logs) if opened is None else None

    def live(page: document.Document) -> None:
        assert opened is not None
        LivePage(opened).attach(page)

    def gains(page: document.Document) -> None:
        try:
            found = of or of_path(path, logs)
        except errors.InputError:  # a session that has not observed its weather yet
            live(page)
            return
        Page(found, make_saver(found, author)).attach(page)

    apps = {"/": gains} if opened is None else {"/": gains, "/session": live}
    # Bokeh refuses web sockets of any origin but localhost and this port: no other site moves the
    # sliders
    try:
        server = Server(apps, address=_HOST, port=port)
    except OSError as error:
        raise errors.DeviceError(
            f"port {port}: {errors.os_reason(error)}; choose another with --port"
        ) from None
    server.start()
    return server
