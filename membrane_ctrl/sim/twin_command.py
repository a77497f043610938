"""The command `twin`: the simulated bench on its real protocol, for any client."""

import contextlib
import signal
from dataclasses import replace

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model import clock, errors, terminal
from membrane_ctrl.sim.twin_process import bench_spec, start_bench

_STOPS = {signal.SIGINT, signal.SIGTERM}


def serve_twin(config: Config, speed: float) -> int:
    """Serve the simulated bench until SIGINT or SIGTERM; print its address on stderr.

    Parameters
    ----------
    config : Config
        Tables `twin` and `pump`.
    speed : float
        Seconds of the plant for each second of the clock.

    Returns
    -------
    int
        `Exit.INTERRUPTED` after SIGINT, `Exit.DONE` after SIGTERM.

    Raises
    ------
    DeviceError
        The bench does not start, e.g. because the port is taken.
    """
    with contextlib.ExitStack() as stack:
        start_bench(
            replace(bench_spec(config, clock.RunClock.start()), speed=speed, linger_s=0.0), stack
        )
        terminal.print_progress("stop it with Ctrl-C")
        signal.pthread_sigmask(signal.SIG_BLOCK, _STOPS)
        stopped = signal.sigwait(_STOPS)
    if stopped == signal.SIGINT:
        return errors.Exit.INTERRUPTED
    return errors.Exit.DONE
