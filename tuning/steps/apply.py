"""Sixth step of a session: set a candidate, or the gains in `gains.toml`, on trial."""

from membrane_ctrl.config import schema
from membrane_ctrl.sessions import folder, session_json
from tuning.gains_file import adapt_to_hold, load_gains, require_sound, save_gains
from tuning.rigs.hold_rig import HoldRig
from tuning.sentences import describe_gains
from tuning.steps import design
from tuning.steps.preview import run_preview

# Time to check the applied gains and start the verification; then they revert automatically.
_APPLY_S = 900.0


def load_checked_gains(session: folder.SessionFolder) -> schema.LoopConfig:
    """The session's gains for its hold. Raises InputError if they must not be applied."""
    session.require_done("design")
    path = session.file_path("gains.toml")
    gains = load_gains(path)
    require_sound(gains, str(path), session.config.loop)
    return adapt_to_hold(gains.loop, session.head.before)


def select_candidate(session: folder.SessionFolder, name: str) -> None:
    """Put a candidate into `gains.toml`, and preview it if the preview was of other gains.

    Parameters
    ----------
    session : SessionFolder
        With a finished design.
    name : str
        Of the candidate.

    Raises
    ------
    InputError
        If it is unknown or must not be applied.
    """
    selected = design.find_candidate(session, name)
    assert selected.predicted is not None  # else refused
    _, present_choice = design.load_candidates(session)
    path = session.file_path("gains.toml")
    gains = load_gains(path)
    update = {
        "candidate": selected.name,
        "predicted_std_um": selected.predicted.std_um,
        "loop": selected.gains.applied_to(gains.loop),
    }
    save_gains(path, gains.model_copy(update=update))
    if selected.name != present_choice.name and session.is_done("preview"):
        run_preview(session)


def run_apply(
    session: folder.SessionFolder, rig: HoldRig, candidate: str = ""
) -> schema.LoopConfig:
    """Set gains on trial; without `verify` they revert automatically.

    Parameters
    ----------
    session : SessionFolder
        With a design.
    rig : HoldRig
        The hold that receives them.
    candidate : str
        Name of the candidate that a person has chosen; empty for the gains in `gains.toml`: the
        proposal, or what a person wrote there.

    Returns
    -------
    LoopConfig
        The gains on trial.

    Raises
    ------
    InputError
        If the candidate is unknown, or the gains must not be applied.
    """
    if candidate:
        select_candidate(session, candidate)
    rig.catch_up()  # the ticks until now are of no step: a person was choosing
    loop = load_checked_gains(session)
    session.begin_step("apply")
    rig.set_gains(loop, f"session {session.path.name}", _APPLY_S)
    session_json.write_session_file(
        session.file_path("applied.json"), {"trial_s": _APPLY_S, "loop": loop}
    )
    return loop


def describe_result(session: folder.SessionFolder) -> str:
    """The gains on trial in one line."""
    loop = load_gains(session.file_path("gains.toml")).loop
    name = design.compare_with_present(session).candidate
    return f"{name} is on trial: {describe_gains(loop)}"
