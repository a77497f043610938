"""How long a run is, and what to say of a moment outside it."""

from __future__ import annotations

from membrane_ctrl.errors import InputError
from membrane_ctrl.review.run import Run

_LEVEL_S = 60.0


def end_s(run: Run) -> float:
    """End of what a run has, in seconds from its start, rounded up to whole minutes; 0 if it has nothing."""
    time_s = run.level(_LEVEL_S, names=("rows",))["time_s"]
    return float(time_s[-1]) + _LEVEL_S if time_s.size else 0.0


def not_in(run: Run, asked: str) -> InputError:
    """That what was asked for lies outside a run."""
    went = f"{run.utc(0):%Y-%m-%d %H:%M} to {run.utc(end_s(run)):%Y-%m-%d %H:%M} UTC"
    return InputError(f"{asked}: not in the run, which went from {went}")
