"""A session as a Rerun recording with its own blueprint: experiment, fit, residual, candidates, before and after."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from membrane_ctrl.model.arrays import AnyArray
from membrane_ctrl.sessions.folder import SessionFolder
from tuning import session
from tuning.identification import loop_model, records

Values = AnyArray

_TIMELINE = "session_time"


def write_recording(folder: SessionFolder) -> None:
    """Write `session.rrd` of what is done so far."""
    stream = rr.RecordingStream("membrane_ctrl_tune", recording_id=folder.path.name)
    path = folder.file("session.rrd")
    path.unlink(missing_ok=True)
    stream.save(path, default_blueprint=_blueprint())
    if folder.done("characterise"):
        _experiments(stream, folder)
    if folder.done("observe"):
        _record(stream, "before", records.load_record(folder.file("quiet.npz")))
    if folder.done("design"):
        markdown = folder.candidates()
        stream.log("candidates/table", rr.TextDocument(markdown, media_type="text/markdown"), static=True)
        rows = [row for row in session.design_of(folder).candidates if row.predicted is not None]
        stds = [row.predicted.std_um for row in rows if row.predicted is not None]
        stream.log("candidates/std_um", rr.BarChart(stds), static=True)
        stream.log("candidates/ms", rr.BarChart([row.margins.ms for row in rows]), static=True)
    if folder.file("verify.npz").exists():
        _record(stream, "after", records.load_record(folder.file("verify.npz")))
    stream.flush()
    stream.disconnect()


def _experiments(stream: rr.RecordingStream, folder: SessionFolder) -> None:
    record = session.experiments_of(folder).record
    _record(stream, "experiment", record)
    if not folder.done("identify"):
        return
    found = session.found_of(folder).identified
    model = found.model
    time_s = np.arange(len(record)) * record.dt_s
    way = model.gain * loop_model.driven_um(record.flow_um_per_s, model.dead_time_s, model.lag_s, record.dt_s)
    way = way - model.leak_um_per_s * time_s
    way += float(np.mean(record.filled_displacement_um() - way))
    _series(stream, "fit/pump_share_um", time_s, way)
    _series(stream, "residual/prediction_error_um", time_s[1:], found.residual_um)


def _record(stream: rr.RecordingStream, name: str, record: records.Record) -> None:
    time_s = np.arange(len(record)) * record.dt_s
    _series(stream, f"{name}/flow_um_per_s", time_s, record.flow_um_per_s)
    _series(stream, f"{name}/displacement_um", time_s, record.displacement_um)
    if record.has_barometer:
        _series(stream, f"{name}/ambient_pressure_pa", time_s, record.ambient_pressure_pa)


def _series(stream: rr.RecordingStream, path: str, time_s: Values, values: Values) -> None:
    good = np.isfinite(values)
    index = rr.TimeColumn(_TIMELINE, duration=time_s[good])
    stream.send_columns(path, indexes=[index], columns=rr.Scalars.columns(scalars=values[good]))


def _blueprint() -> rrb.Blueprint:
    def plot(name: str, *paths: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(name=name, origin="/", contents=[f"+ /{path}" for path in paths])

    experiment = rrb.Vertical(
        plot("Flow, um/s", "experiment/flow_um_per_s"),
        plot("Centre and the pump's share of it, um", "experiment/displacement_um", "fit/pump_share_um"),
        plot("Residual, um", "residual/prediction_error_um"),
        name="Experiment and fit",
    )
    candidates = rrb.Vertical(
        rrb.TextDocumentView(name="Candidates", origin="/candidates/table"),
        rrb.Horizontal(
            rrb.BarChartView(name="Predicted std, um", origin="/candidates/std_um"),
            rrb.BarChartView(name="Ms", origin="/candidates/ms"),
        ),
        name="Candidates",
    )
    compared = rrb.Vertical(
        plot("Centre before, um", "before/displacement_um"),
        plot("Centre after, um", "after/displacement_um"),
        plot("Flow before and after, um/s", "before/flow_um_per_s", "after/flow_um_per_s"),
        name="Before and after",
    )
    panel = rrb.TimePanel(state="collapsed", timeline=_TIMELINE)
    return rrb.Blueprint(rrb.Tabs(experiment, candidates, compared), panel, auto_views=False)
