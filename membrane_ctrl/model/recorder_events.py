"""Events of the recorder: what it cannot record, the disk, its summary."""

from typing import Any

from membrane_ctrl.model.event_base import Event, LogLevel
from membrane_ctrl.model.notices import Topic


class RecorderError(
    Event,
    kind="recorder_error",
    sentence="Not recorded: {message}. Do: check the disk and the folder of the run",
    level=LogLevel.ERROR,
    opens=(Topic.RECORDING,),
    subject="what",
):
    """`what` cannot be recorded."""

    what: str
    message: str


class DiskLow(
    Event,
    kind="disk_low",
    sentence="Disk almost full: {message}",
    level=LogLevel.WARNING,
    opens=(Topic.RECORDING,),
    subject="what",
):
    """The disk is almost full."""

    what: str
    message: str


class RecorderRecovered(
    Event, kind="recorder_recovered", closes=(Topic.RECORDING,), subject="what"
):
    """`what` works again."""

    what: str
    message: str


class RunDeleted(Event, kind="run_deleted"):
    """An old run was deleted to make room."""

    run: str
    message: str


class RecorderDone(Event, kind="recorder_done", sentence="Recorder done"):
    """The recorder's summary; comes after the last line of the file."""

    dropped: Any
    segments: Any
    tables: Any
    errors: Any
    rows_lost: Any
    table_rows_lost: Any
    events_lost: Any
    input_ticks_lost: Any
    restarts: Any
    folder_replaced_s: Any
    partial: Any
