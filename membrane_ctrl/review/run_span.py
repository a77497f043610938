"""When a run ended, and the error for a time outside it."""

from membrane_ctrl.model import errors
from membrane_ctrl.run_files.run import Run

_END_LEVEL_S = 60.0


def end_s(run: Run) -> float:
    """End of a run's data, in seconds from its start, rounded up to whole minutes;
    0 without data.
    """
    time_s = run.level(_END_LEVEL_S, names=("rows",))["time_s"]
    if not time_s.size:
        return 0.0
    return float(time_s[-1]) + _END_LEVEL_S


def make_outside_error(run: Run, wanted: str) -> errors.InputError:
    """Make the error for a time outside a run.

    Parameters
    ----------
    run : Run
        Its first and last minute are named.
    wanted : str
        The time as it was given, with its option, such as `--at 03:12`.
    """
    went = f"{run.utc(0):%Y-%m-%d %H:%M} to {run.utc(end_s(run)):%Y-%m-%d %H:%M} UTC"
    return errors.InputError(f"{wanted}: not in the run, which lasted from {went}")
