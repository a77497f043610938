"""The process that owns screen and camera and measures the shape.

Imports nothing heavy: its parent imports it for the specification, and the limits on threads must
be set before NumPy is loaded.
"""

import os
import signal
import traceback
from multiprocessing.connection import Connection

from membrane_ctrl.acquisition.remote import Remote
from membrane_ctrl.acquisition.spec import AcquisitionSpec
from membrane_ctrl.acquisition.threads import limit_threads

_NICENESS = 10  # behind the tick, the recorder and the screen


def acquisition_main(spec: AcquisitionSpec, control: Connection) -> None:
    """Measure the shape until stopped: target of a `spawn`ed process.

    Ends on "stop" over `control`, on `processes.STOP`, and when the parent has died. Reports go
    back over `control` as lines of events (`run_events.AcquisitionState`).

    Parameters
    ----------
    spec : AcquisitionSpec
        What to measure, and the rings.
    control : Connection
        Pipe to the control process.

    Raises
    ------
    SystemExit
        With 1 if it cannot work at all, after a report of the reason.
    """
    os.nice(max(0, _NICENESS - os.nice(0)))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    limit_threads()
    remote = Remote(control)
    try:
        from membrane_ctrl.acquisition.session import run_acquisition

        run_acquisition(spec, remote)
    except Exception as error:
        remote.report_state(
            "failed", f"{type(error).__name__}: {error}", traceback=traceback.format_exc()
        )
        raise SystemExit(1) from None
    remote.report_state("stopped")
