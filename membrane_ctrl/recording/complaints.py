"""Trouble of the recorder: told once for as long as it is the same, and nothing of it ends the recorder."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from membrane_ctrl.recording.sink import RecordingError

Report = Callable[[dict[str, Any]], None]


class Complaints:
    """Runs what may fail, and reports what did.

    Parameters
    ----------
    report : callable
        Takes a small dict for the supervisor; never blocks, never raises.
    errors : int
        Of a recorder before this one.

    Attributes
    ----------
    errors : int
        Reports of kind "recorder_error".
    """

    def __init__(self, report: Report, errors: int = 0) -> None:
        self.report = report
        self.errors = errors
        self._trouble: dict[str, str] = {}

    def guarded(self, what: str, action: Callable[[], None]) -> None:
        """Do it; what goes wrong is reported, and the rest of the recorder goes on."""
        try:
            action()
        except (OSError, RecordingError) as error:
            self.complain(what, f"{what}: {error}")
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            self.complain(
                what, f"{what}: {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})"
            )
        else:
            self.recovered(what)

    def complain(self, what: str, message: str, kind: str = "recorder_error") -> None:
        """Report trouble once for as long as it is the same; the report says in `what` whose end to wait for."""
        if self._trouble.get(what) != message:
            self._trouble[what] = message
            self.errors += kind == "recorder_error"
            self.report({"kind": kind, "what": what, "message": message})

    def recovered(self, what: str) -> None:
        """Say that it works again, if it did not."""
        if self._trouble.pop(what, None) is not None:
            self.report({"kind": "recorder_recovered", "what": what, "message": f"{what} works again"})

    def forget(self, prefix: str, but: set[str]) -> None:
        """Say that trouble is over whose cause is there no longer: what begins with `prefix` and is not in `but`."""
        for what in [what for what in self._trouble if what.startswith(prefix) and what not in but]:
            self.recovered(what)
