"""Puts gains that a person chose by hand into the design of a session."""

from __future__ import annotations

import math

from membrane_ctrl.model import errors
from tuning import gains_file
from tuning.explore.workpiece import Workpiece
from tuning.identification.closed_loop import Gains
from tuning.proposal import candidate, gain_search
from tuning.steps.design import EDITED


def save_gains(of: Workpiece, gains: Gains, author: str) -> str:
    """Save gains into the session's `gains.toml`, for `tune apply`.

    Parameters
    ----------
    of : Workpiece
        Its session's file is replaced.
    gains : Gains
        As set on the page.
    author : str
        For the file.

    Returns
    -------
    str
        What to do next, in a line.

    Raises
    ------
    InputError
        There is no session with a design; gains without margin, or outside the range.
    DeviceError
        The folder cannot be written.
    """
    opened = of.session
    if opened is None or of.proposed is None:
        raise errors.InputError("not saved: only a session that has a design takes gains")
    path = opened.file_path("gains.toml")
    before = gains_file.load_gains(path)
    try:
        loop = gains.applied_to(before.loop)
    except ValueError as error:
        raise errors.InputError(f"not saved: {str(error).splitlines()[0]}") from None
    # Edited gains are judged as any candidate.
    found = candidate.evaluate_candidate(
        EDITED, gains, of.model, of.weather, loop, gain_search.Demands()
    )
    if refusal := candidate.find_refusal(found):
        raise errors.InputError(f"not saved: {refusal}")
    std_um = found.predicted.std_um if found.predicted is not None else math.nan
    edits = {"author": author, "candidate": EDITED, "predicted_std_um": std_um, "loop": loop}
    made = before.model_copy(update=edits)
    gains_file.require_sound(made, "these gains", opened.config.loop)
    with errors.convert_write_errors(path, errors.DeviceError):
        opened.begin_step("preview")  # what followed was of other gains
        gains_file.save_gains(path, made)
    return f"Saved. Next: membrane-ctrl tune apply --session {opened.path}"
