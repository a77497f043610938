"""A session as a Rerun recording: experiment, fit, residual, candidates, before and after."""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from membrane_ctrl.model.arrays import AnyArray
from membrane_ctrl.model.files import move_file, resolve_user_path
from membrane_ctrl.sessions.folder import SessionFolder
from tuning.identification import plant_model, record_file
from tuning.identification.record import Record
from tuning.steps import characterise, design, identify

_TIMELINE = "session_time"


def write_recording(folder: SessionFolder) -> None:
    """Write `session.rrd` with the steps done so far."""
    stream = rr.RecordingStream("membrane_ctrl_tune", recording_id=folder.path.name)
    path = resolve_user_path(folder.file_path("session.rrd"))
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    stream.save(part, default_blueprint=_make_blueprint())
    if folder.is_done("characterise"):
        _log_experiments(stream, folder)
    if folder.is_done("observe"):
        _log_record(stream, "before", record_file.load_record(folder.file_path("quiet.npz")))
    if folder.is_done("design"):
        markdown = folder.read_candidates()
        stream.log(
            "candidates/table", rr.TextDocument(markdown, media_type="text/markdown"), static=True
        )
        rows = [row for row in design.load_design(folder).candidates if row.predicted is not None]
        stds = [row.predicted.std_um for row in rows if row.predicted is not None]
        stream.log("candidates/std_um", rr.BarChart(stds), static=True)
        stream.log("candidates/ms", rr.BarChart([row.margins.ms for row in rows]), static=True)
    if folder.file_path("verify.npz").exists():
        _log_record(stream, "after", record_file.load_record(folder.file_path("verify.npz")))
    stream.flush()
    stream.disconnect()
    move_file(part, path)


def _log_experiments(stream: rr.RecordingStream, folder: SessionFolder) -> None:
    record = characterise.load_experiments(folder).record
    _log_record(stream, "experiment", record)
    if not folder.is_done("identify"):
        return
    found = identify.load_identified(folder).identified
    time_s = np.arange(len(record)) * record.dt_s
    _log_series(
        stream, "fit/pump_share_um", time_s, plant_model.compute_pump_share_um(record, found.model)
    )
    _log_series(stream, "residual/prediction_error_um", time_s[1:], found.residual_um)


def _log_record(stream: rr.RecordingStream, name: str, record: Record) -> None:
    time_s = np.arange(len(record)) * record.dt_s
    _log_series(stream, f"{name}/flow_um_per_s", time_s, record.flow_um_per_s)
    _log_series(stream, f"{name}/displacement_um", time_s, record.displacement_um)
    if record.has_barometer:
        _log_series(stream, f"{name}/ambient_pressure_pa", time_s, record.ambient_pressure_pa)


def _log_series(stream: rr.RecordingStream, path: str, time_s: AnyArray, values: AnyArray) -> None:
    good = np.isfinite(values)
    index = rr.TimeColumn(_TIMELINE, duration=time_s[good])
    stream.send_columns(path, indexes=[index], columns=rr.Scalars.columns(scalars=values[good]))


def _make_blueprint() -> rrb.Blueprint:
    def plot(name: str, *paths: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(name=name, origin="/", contents=[f"+ /{path}" for path in paths])

    experiment = rrb.Vertical(
        plot("Flow, µm/s", "experiment/flow_um_per_s"),
        plot(
            "Centre and its response to the pump, µm",
            "experiment/displacement_um",
            "fit/pump_share_um",
        ),
        plot("Residual, µm", "residual/prediction_error_um"),
        name="Experiment and fit",
    )
    candidates = rrb.Vertical(
        rrb.TextDocumentView(name="Candidates", origin="/candidates/table"),
        rrb.Horizontal(
            rrb.BarChartView(name="Predicted std, µm", origin="/candidates/std_um"),
            rrb.BarChartView(name="Ms", origin="/candidates/ms"),
        ),
        name="Candidates",
    )
    compared = rrb.Vertical(
        plot("Centre before, µm", "before/displacement_um"),
        plot("Centre after, µm", "after/displacement_um"),
        plot("Flow before and after, µm/s", "before/flow_um_per_s", "after/flow_um_per_s"),
        name="Before and after",
    )
    panel = rrb.TimePanel(state="collapsed", timeline=_TIMELINE)
    return rrb.Blueprint(rrb.Tabs(experiment, candidates, compared), panel, auto_views=False)
