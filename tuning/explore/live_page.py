"""The page of a session: what it does now, what it has found, what is left, and the centre as it
moves.
"""

import html
import time
from pathlib import Path

from bokeh import document, layouts, models, plotting
from bokeh.models import widgets

from membrane_ctrl.sessions import folder, live_log

_POLL_MS = 1000
_SILENT_S = 90.0  # a fit takes a minute on a busy machine
_WIDTH = 1400
_COLOURS = {"displacement_um": "#1f77b4", "setpoint_um": "#888888", "flow_um_per_s": "#d95f02"}
_STYLE = (
    "<style>.steps{font:15px sans-serif;margin:0}.steps li{list-style:none;margin:2px 0;color:#999}"
    ".steps .done{color:#060}.steps .now{color:#000;font-weight:bold}"
    ".said{font:13px monospace;margin:0;white-space:pre-wrap}</style>"
)


class LivePage:
    """One viewer's page of a session, which reads the session's folder every second."""

    def __init__(self, opened: folder.SessionFolder) -> None:
        self._session = opened
        self._log = live_log.LiveReader(opened.path)
        self._points = models.ColumnDataSource({"minutes": [], **{name: [] for name in _COLOURS}})
        self._begun = models.ColumnDataSource({"at_s": [], "minutes": [], "step": []})
        self._now = widgets.Div(
            name="now", sizing_mode="stretch_width", styles={"font-size": "18px"}
        )
        self._steps = widgets.Div(name="steps", width=330)
        self._results = widgets.Div(name="found", sizing_mode="stretch_width")
        self._update_page()

    def attach(self, page: document.Document) -> None:
        """Put the page into a viewer's document."""
        page.title = f"tune {self._session.head.name}"
        head = self._session.head
        of = f"{self._session.path.name}: {head.author} on {head.source}, begun {head.created_utc}"
        title = widgets.Div(text=f"<b>{html.escape(of)}</b>", sizing_mode="stretch_width")
        found = layouts.row(self._steps, self._results, sizing_mode="stretch_width")
        page.add_root(
            layouts.column(title, self._now, found, *self._plots(), sizing_mode="stretch_width")
        )
        page.add_periodic_callback(self._update_page, _POLL_MS)

    def _plots(self) -> list[plotting.figure]:
        centre = plotting.figure(
            title="centre (blue) and setpoint (grey)",
            y_axis_label="µm",
            height=300,
            width=_WIDTH,
            tools="pan,box_zoom,wheel_zoom,reset,save",
        )
        flow = plotting.figure(
            title="flow",
            x_axis_label="minutes of hold",
            y_axis_label="µm/s",
            height=180,
            width=_WIDTH,
            x_range=centre.x_range,
            tools="",
        )
        for plot, names in (
            (centre, ("setpoint_um", "displacement_um")),
            (flow, ("flow_um_per_s",)),
        ):
            for name in names:
                plot.line(
                    "minutes", name, source=self._points, color=_COLOURS[name], line_width=1.3
                )
            plot.vspan(x="minutes", source=self._begun, line_color="#060", line_dash="dotted")
            plot.toolbar.update(logo=None)
        flow.text(
            "minutes",
            0,
            "step",
            source=self._begun,
            text_font_size="11px",
            text_color="#060",
            x_offset=4,
        )
        return [centre, flow]

    def _update_page(self) -> None:
        """Take what is new into the page."""
        points = self._log.read_new()
        if points["time_s"]:
            minutes = [at_s / 60 for at_s in points["time_s"]]
            self._points.stream({"minutes": minutes, **{name: points[name] for name in _COLOURS}})
        progress = self._log.progress
        begun = dict(progress.begun_s)  # of steps that begin together, the last
        if begun != dict(zip(self._begun.data["at_s"], self._begun.data["step"], strict=True)):
            minutes = [at_s / 60 for at_s in begun]
            self._begun.data = {
                "at_s": list(begun),
                "minutes": minutes,
                "step": list(begun.values()),
            }
        done = {step for step in folder.STEPS if self._session.is_done(step)}
        silent_s = time.time() - _changed_s(self._session.path / live_log.NAME)
        self._now.text = html.escape(status(progress, done, silent_s, self._session.path))
        self._steps.text = _STYLE + _step_list(progress, done)
        self._results.text = f"<pre class=said>{html.escape(chr(10).join(progress.said))}</pre>"


def status(progress: live_log.Progressed, done: set[str], silent_s: float, session: Path) -> str:
    """What the session does now, in a line; `silent_s` is how long its log has not grown."""
    again = f"resume it with: membrane-ctrl tune run --resume {session}"
    if done == set(folder.STEPS):
        return "Done. The result is below and in report.html."
    if not progress.step:
        return f"Nothing recorded yet; {again}"
    if progress.ended:
        why = "" if progress.ended == "done" else f" ({progress.ended})"
        return f"Ended after {progress.step}{why}; {again}"
    if progress.asks:
        return f"Waiting for an answer on its terminal: {progress.asks}"
    if silent_s > _SILENT_S:
        return f"Silent for {silent_s:.0f} s in {progress.step}: it was killed or hangs; {again}"
    if not progress.planned_s:
        return f"Now: {progress.step}"
    left_s = max(0.0, progress.planned_s - progress.done_s)
    return (
        f"Now: {progress.step}, {_clock(progress.done_s)} of about {_clock(progress.planned_s)}; "
        f"{_clock(left_s + progress.after_s)} of holding left in the session"
    )


def _step_list(progress: live_log.Progressed, done: set[str]) -> str:
    def item(step: str) -> str:
        now = step == progress.step and step not in done
        kind, sign = (
            ("now", "&#9654;") if now else ("done", "&#10003;") if step in done else ("", "&#9675;")
        )
        return f"<li class={kind or 'left'}>{sign} {step}</li>"

    return f"<ul class=steps>{''.join(item(step) for step in folder.STEPS)}</ul>"


def _changed_s(path: Path) -> float:
    """When a file was last written, as UTC in seconds; now if there is none."""
    try:
        return path.lstat().st_mtime
    except OSError:
        return time.time()


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
