"""Errors of the recorder: each is reported once until it changes, and none ends the recorder."""

import traceback
from collections.abc import Callable
from pathlib import Path

from membrane_ctrl.model.events import Event
from membrane_ctrl.model.recorder_events import DiskLow, RecorderError, RecorderRecovered
from membrane_ctrl.recorder.rerun_recording import RecordingError

Report = Callable[[Event], None]


class RecorderErrors:
    """Runs calls that may fail and reports failures; `errors` counts all `RecorderError`s, also
    predecessors'.
    """

    def __init__(self, report: Report, errors: int = 0) -> None:
        self.report = report
        self.errors = errors
        self._trouble: dict[str, str] = {}

    def run_guarded(self, what: str, action: Callable[[], None]) -> None:
        """Run a call; report its failure and let the recorder continue.

        Parameters
        ----------
        what : str
            Identifies it in reports.
        action : callable
            Any exception of it is reported once, and again when it has ended.
        """
        try:
            action()
        except (OSError, RecordingError) as error:
            self.report_error(what, f"{what}: {error}")
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            self.report_error(
                what,
                f"{what}: {type(error).__name__}: {error} "
                f"({Path(place.filename).name}:{place.lineno})",
            )
        else:
            self.report_recovered(what)

    def report_error(
        self, what: str, message: str, as_: type[RecorderError | DiskLow] = RecorderError
    ) -> None:
        """Report an error once, until it changes.

        Parameters
        ----------
        what : str
            Identifies it for `report_recovered`.
        message : str
            For people.
        as_ : type of event
            `RecorderError` or `DiskLow`.
        """
        if self._trouble.get(what) != message:
            self._trouble[what] = message
            self.errors += as_ is RecorderError
            self.report(as_(what, message))

    def report_recovered(self, what: str) -> None:
        """Report that `what` works again, if it had failed."""
        if self._trouble.pop(what, None) is not None:
            self.report(RecorderRecovered(what, f"{what} works again"))

    def clear_errors(self, prefix: str, but: set[str]) -> None:
        """Report some errors as over: their cause has gone.

        Parameters
        ----------
        prefix : str
            How they begin.
        but : set of str
            Those that stay.
        """
        for what in [what for what in self._trouble if what.startswith(prefix) and what not in but]:
            self.report_recovered(what)
