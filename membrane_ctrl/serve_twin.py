"""`twin`: the simulated bench on its real protocol, for any client."""

from __future__ import annotations

import signal
import sys

from membrane_ctrl.clock import RunClock
from membrane_ctrl.config import Config
from membrane_ctrl.errors import DeviceError, Exit
from membrane_ctrl.processes import Child, pipe

_STOPS = {signal.SIGINT, signal.SIGTERM}


def serve_twin(config: Config, speed: float) -> int:
    """Serve until SIGINT or SIGTERM; says on stderr where it listens. Raises DeviceError, e.g. for a busy port."""
    from membrane_ctrl.twin.bench import BenchReport, BenchSpec

    ours, theirs = pipe()
    spec = BenchSpec(config.twin, config.pump, RunClock.start(), config.twin.port, speed=speed, linger_s=0.0)
    child = Child("twin", "membrane_ctrl.twin.bench:serve", (spec, theirs), nice=0)
    child.start()
    try:
        report = ours.recv() if ours.poll(60.0) else BenchReport(error="the twin did not start")
        if report.error:
            raise DeviceError(report.error)
        print(
            f"the twin listens on tcp://127.0.0.1:{report.port}, Modbus unit 1; stop it with Ctrl-C", file=sys.stderr
        )
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
        stopped = signal.sigwait(_STOPS)
    finally:
        child.stop(2.0)
    return Exit.INTERRUPTED if stopped == signal.SIGINT else Exit.DONE
