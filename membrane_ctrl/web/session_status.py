"""What a tuning session does now, in a line."""

from __future__ import annotations

import time
from collections.abc import Collection
from pathlib import Path

from membrane_ctrl.sessions import folder as folders
from membrane_ctrl.sessions.live_log import NAME, LiveReader, Progressed

_SILENT_S = 90.0  # a fit takes a minute on a busy machine


def describe_session(
    progress: Progressed, done: Collection[str], silent_s: float, session: Path
) -> str:
    """What a session does.

    Parameters
    ----------
    progress : Progressed
        By the session's log until now.
    done : collection of str
        Its steps that are done.
    silent_s : float
        How long its log has not grown.
    session : Path
        Folder of the session, for the command that resumes it.
    """
    again = f"resume it with: membrane-ctrl tune run --resume {session}"
    if set(done) == set(folders.STEPS):
        return "Done. The result is below and in report.html."
    if not progress.step:
        return f"Nothing recorded yet; {again}"
    if progress.ended:
        why = "" if progress.ended == "done" else f" ({progress.ended})"
        return f"Ended after {progress.step}{why}; {again}"
    if progress.asks:
        return f"Waiting for an answer: {progress.asks}"
    if silent_s > _SILENT_S:
        return f"Silent for {silent_s:.0f} s in {progress.step}: it was killed or hangs; {again}"
    if not progress.planned_s:
        return f"Now: {progress.step}"
    left_s = max(0.0, progress.planned_s - progress.done_s)
    return (
        f"Now: {progress.step}, {_clock(progress.done_s)} of about {_clock(progress.planned_s)}; "
        f"{_clock(left_s + progress.after_s)} of holding left in the session"
    )


def is_running(session: Path) -> bool:
    """Whether a program works on a session now, as far as its log shows."""
    reader = LiveReader(session)
    reader.read_new()
    progress = reader.progress
    return bool(progress.step) and not progress.ended and find_silent_s(session) < _SILENT_S


def find_silent_s(session: Path) -> float:
    """How long the log of a session has not grown; 0 if there is none."""
    try:
        return time.time() - (session / NAME).lstat().st_mtime
    except OSError:
        return 0.0


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
