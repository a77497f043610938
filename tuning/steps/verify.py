"""Last step of a session: judge the gains on trial; keep them or restore the previous ones."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import welch

from membrane_ctrl.config import schema
from membrane_ctrl.report_pages.blocks import PageSection, PageTable, PageText, TextMark
from membrane_ctrl.sessions import folder, live_hold, session_json
from tuning.gains_file import load_gains
from tuning.identification import closed_loop, plant_model, record_file
from tuning.identification.record import Record, Series
from tuning.proposal import verification
from tuning.proposal.candidate import SAME_LOAD
from tuning.report.pictures import (
    SPECTRUM_SEGMENT_S,
    embed_picture,
    is_outdated,
    save_figure,
)
from tuning.rigs.hold_rig import HoldRig
from tuning.steps.apply import load_checked_gains
from tuning.steps.design import load_candidates
from tuning.steps.identify import load_identified
from tuning.steps.observe import load_disturbance, load_quiet_record

_SPARE_S = 120.0
_PICTURE = "verify.png"


@dataclass(frozen=True, slots=True)
class Verified:
    """`verified.json`."""

    kept: bool  # the new gains stay
    reason: str
    stages: tuple[verification.Stage, ...]
    before: schema.LoopConfig
    after: schema.LoopConfig


def run_verify(
    session: folder.SessionFolder,
    rig: HoldRig,
    report_stage: Callable[[verification.Stage], None] = lambda stage: None,
    stages: tuple[tuple[float, float], ...] = verification.STAGES,
) -> Verified:
    """Hold with the new gains and judge them in stages; keep them, or restore the old ones at once.

    Parameters
    ----------
    session : SessionFolder
        With gains that were applied.
    rig : HoldRig
        The hold.
    report_stage : callable
        Gets each stage.
    stages : tuple of (float, float)
        Duration from the beginning in s, and largest growth of the standard deviation there.

    Raises
    ------
    HoldError
        If the hold ended, and with it the gains on trial.
    """
    session.require_done("apply")
    trial = _load_trial(session, rig.pump)
    session.begin_step("verify")

    # The gains on trial for longer than the stages last, should this session end early.
    settling_s = verification.find_settling_time_s(trial.after)
    trial_s = settling_s + 2 * stages[-1][0] + _SPARE_S
    rig.set_gains(trial.after, f"session {session.path.name}: verification", trial_s)
    watched = _WatchedHold()
    try:
        rig.hold(settling_s)
        reason = _judge_in_stages(rig, trial, stages, watched, report_stage)
    except live_hold.HoldError as error:
        reason = str(error)

    # Kept or restored.
    if reason:
        try:
            rig.set_gains(trial.before, f"verification failed: {reason}"[:250])
        except live_hold.HoldError:  # the hold has ended; with it the gains on trial
            raise live_hold.HoldError(reason) from None
    else:
        rig.keep_gains()
    done = Verified(not reason, reason, tuple(watched.stages), trial.before, trial.after)
    if watched.record is not None:
        record_file.save_record(session.file_path("verify.npz"), watched.record)
    session_json.write_session_file(session.file_path("verified.json"), done)
    return done


def _load_trial(
    session: folder.SessionFolder, pump: schema.PumpConfig
) -> verification.VerificationTrial:
    """The gains on trial and those before, on the session's plant and weather.

    Raises InputError if the gains must not be applied.
    """
    after = load_checked_gains(session)
    named = load_gains(session.file_path("gains.toml")).candidate
    # `same-load` has no price that a person could have accepted
    accepted = named == load_candidates(session)[1].name != SAME_LOAD
    return verification.VerificationTrial(
        model=load_identified(session).identified.model,
        weather=load_disturbance(session),
        before=session.head.before,
        after=after,
        accepted=accepted,
        pump=pump,
    )


@dataclass(slots=True)
class _WatchedHold:
    """The hold with the gains on trial so far.

    Attributes
    ----------
    record : Record or None
        All samples so far; None before the first stage.
    setpoint_um : (n,) array
        Setpoint at each of its samples.
    stages : list of Stage
        Judged so far.
    """

    record: Record | None = None
    setpoint_um: Series = field(default_factory=lambda: np.empty(0))
    stages: list[verification.Stage] = field(default_factory=list)

    def add_record(self, more: Record, setpoint_um: Series) -> Record:
        """Add what was held since; returns all of it."""
        self.record = more if self.record is None else self.record.followed_by(more)
        self.setpoint_um = np.concatenate((self.setpoint_um, setpoint_um))
        return self.record


def _judge_in_stages(
    rig: HoldRig,
    trial: verification.VerificationTrial,
    stages: tuple[tuple[float, float], ...],
    watched: _WatchedHold,
    report_stage: Callable[[verification.Stage], None],
) -> str:
    """Hold and judge stage by stage, as long again if the last one is close.

    `watched` gets the record and the stages, also if the hold ends meanwhile. Returns why the gains
    must not stay; empty if they may.
    """
    last_s, last_growth = stages[-1]
    held_s = 0.0
    reason = ""
    for until_s, growth_max in (*stages, (2 * last_s, last_growth)):
        more, about_um = rig.hold_about(until_s - held_s)
        held_s = until_s
        record = watched.add_record(more, about_um)
        stage = verification.judge_stage(record, watched.setpoint_um, trial, growth_max)
        watched.stages.append(stage)
        report_stage(stage)
        reason = stage.reason
        if until_s == last_s and _needs_longer(stage, trial.accepted):
            continue  # as likely the weather as the gains: as long again decides
        if until_s >= last_s and not reason:
            reason = verification.explain_no_benefit(stage, trial)
        if reason or until_s == last_s:
            break
    return reason


def _needs_longer(stage: verification.Stage, accepted: bool) -> bool:
    """Whether the last stage is too close to decide; a benefit is not asked of accepted gains."""
    return stage.is_close and not (accepted and not stage.reason)


def load_verified(session: folder.SessionFolder) -> Verified:
    """Result of the verification."""
    return session.read_result("verify", "verified.json", Verified)


def describe_result(session: folder.SessionFolder) -> str:
    """The verdict in one line."""
    done = load_verified(session)
    if not done.kept:
        return f"the previous gains are back: {done.reason}"
    return (
        "kept until the hold ends; `membrane-ctrl tune save --config FILE` saves them for the "
        "next one"
    )


def make_report_part(session: folder.SessionFolder) -> PageSection | None:
    """The verification, for the report; None before the step is done."""
    if not session.is_done("verify"):
        return None
    done = load_verified(session)
    verdict = "kept" if done.kept else f"reverted: {done.reason}"
    mark = TextMark.GOOD if done.kept else TextMark.BAD
    rows = [
        (
            f"{stage.time_s:.0f} s",
            f"{stage.std_um:.3f}",
            f"{stage.before_um:.3f}",
            _format_growth(stage),
            f"{stage.ms:.2f}" if math.isfinite(stage.ms) else "record too short",
            stage.reason,
        )
        for stage in done.stages
    ]
    heads = ("after", "std µm", "previous µm", "ratio", "observed sensitivity", "")
    return PageSection(
        "Verification",
        [PageText(verdict, mark), PageTable(heads, rows), *embed_picture(session, _PICTURE)],
    )


def _format_growth(stage: verification.Stage) -> str:
    """The ratio of the standard deviations, with its error once that is known."""
    if math.isinf(stage.growth_sigma):
        return f"{stage.growth:.2f}"
    return f"{stage.growth:.2f} +- {stage.growth_sigma:.2f}"


def draw_picture(session: folder.SessionFolder) -> None:
    """Draw the spectra before and after, and each stage, unless the picture is up to date."""
    if session.is_done("verify") and is_outdated(
        session, _PICTURE, "identify", "observe", "verify"
    ):
        path = session.file_path("verify.npz")
        after = record_file.load_record(path) if path.exists() else None
        before = load_quiet_record(session)
        model = load_identified(session).identified.model
        _draw_verification(
            session.file_path(_PICTURE), before, after, model, load_verified(session)
        )


def _draw_verification(
    path: Path, before: Record, after: Record | None, model: plant_model.PlantModel, done: Verified
) -> None:
    """Draw the readings' spectra before and after, and the ratio of
    standard deviations per stage.
    """
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    dt_s = before.dt_s
    for record, loop, name in ((before, done.before, "before"), (after, done.after, "after")):
        if record is None:
            continue
        readings = record.filled_displacement_um()
        f, power = welch(
            readings - readings.mean(),
            1 / dt_s,
            nperseg=min(readings.size, round(SPECTRUM_SEGMENT_S / dt_s)),
        )
        response = closed_loop.compute_loop_response(
            closed_loop.Gains.from_config(loop), model, closed_loop.make_frequencies(dt_s), dt_s
        )
        ms = float(np.max(np.abs(1 / (1 + response))))
        left.loglog(f[1:], power[1:], linewidth=0.8, label=f"{name}, Ms {ms:.2f}")
    left.set(xlabel="frequency (Hz)", ylabel="readings (µm^2/Hz)")
    left.legend(loc="best")
    times = [stage.time_s for stage in done.stages]
    right.plot(
        times,
        [stage.growth for stage in done.stages],
        "o-",
        label="std relative to the previous gains",
    )
    right.plot(times, [stage.growth_max for stage in done.stages], "r--", label="limit")
    right.set(xlabel="time (s)", title="kept" if done.kept else f"reverted: {done.reason}"[:90])
    right.title.set_fontsize(8)
    right.legend(loc="best")
    save_figure(path, figure)
