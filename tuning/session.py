"""The steps of a session. Each is a function that reads and writes the session's folder.

Steps that move the mirror take a `HoldRig`; the others run anywhere, at any later time.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from membrane_ctrl.config import schema
from membrane_ctrl.control.experiments import experiment, operating_point
from membrane_ctrl.model import errors, files
from membrane_ctrl.sessions import folder, live_hold
from tuning.gains_file import (
    GainsFile,
    PlantSection,
    Traded,
    for_hold,
    load_gains,
    require_sound,
    save_gains,
)
from tuning.identification import characterise, identify, loop_model
from tuning.identification.disturbance import DisturbanceModel, observe
from tuning.proposal import candidates, design, prediction, verify
from tuning.rig import HoldRig

OBSERVE_S = 600.0
_HELD = "held.npz"  # the quiet hold of a short session, recorded before the experiments
_PREVIEW_SEEDS = 3
# Time to check the applied gains and start the verification; then they revert automatically.
_APPLY_S = 900.0
_SPARE_S = 120.0


@dataclass(frozen=True, slots=True)
class ExperimentsHead:
    """`experiments.json`: the contents of `characterise.Experiments` except its record."""

    around: operating_point.Around
    relays_s: float
    pulses_s: tuple[float, float]
    finished: experiment.Finished


@dataclass(frozen=True, slots=True)
class IdentifiedPlant:
    """`identified.json`."""

    identified: identify.Identified
    quality: characterise.FitQuality
    data_sha256: str


@dataclass(frozen=True, slots=True)
class Design:
    """`proposal.json`: a `design.Proposal` without its loop, which is in the gains file."""

    candidates: tuple[design.Candidate, ...]
    least_std_um: float
    preview: prediction.Preview
    robustness: design.Robustness


@dataclass(frozen=True, slots=True)
class Previewed:
    """`preview.json`: present and proposed gains on the fitted twin, one row per seed."""

    present: tuple[prediction.Preview, ...]
    proposed: tuple[prediction.Preview, ...]


@dataclass(frozen=True, slots=True)
class Verified:
    """`verified.json`."""

    kept: bool  # the new gains stay
    reason: str
    stages: tuple[verify.Stage, ...]
    before: schema.LoopConfig
    after: schema.LoopConfig


class PumpUnknownError(errors.RejectedError):
    """The experiments fail, or contradict themselves, in a way that
    the pump's curve may explain.
    """


def characterise_step(
    session: folder.SessionFolder,
    rig: HoldRig,
    limit_um: float = 10.0,
    plan: characterise.Plan = characterise.FULL,
) -> characterise.Experiments:
    """Run the experiments on the mirror. Raises RejectedError with a remedy if none completes.

    It is a PumpUnknownError if the pump's curve may be the cause.
    """
    session.begin("characterise")
    try:
        done = characterise.experiment(rig, limit_um, plan)
    except characterise.ExperimentError as error:
        kind = PumpUnknownError if error.pump_suspected else errors.RejectedError
        raise kind(f"characterise: {error}") from None
    except ValueError as error:
        raise PumpUnknownError(f"characterise: {error}") from None
    loop_model.save_record(session.file("experiments.npz"), done.record)
    if plan is characterise.SHORT and done.held is not None:
        loop_model.save_record(session.file(_HELD), done.held)
    head = ExperimentsHead(done.around, done.relays_s, done.pulses_s, done.finished)
    folder.write(session.file("experiments.json"), head)
    return done


def experiments_of(session: folder.SessionFolder) -> characterise.Experiments:
    """Results of the experiments."""
    head = session.result("characterise", "experiments.json", ExperimentsHead)
    record = loop_model.load_record(session.file("experiments.npz"))
    return characterise.Experiments(
        head.around, record, head.relays_s, head.pulses_s, head.finished
    )


def identify_step(session: folder.SessionFolder) -> IdentifiedPlant:
    """Fit the model and judge it; a refused fit is kept too, for the report."""
    done = experiments_of(session)
    session.begin("identify")
    try:
        all_of_it = characterise.fitted(done)
    except ValueError as error:
        raise errors.RejectedError(f"identify: {error}") from None
    found = IdentifiedPlant(all_of_it.identified, all_of_it.quality, done.record.sha256())
    folder.write(session.file("identified.json"), found)
    return found


def found_of(session: folder.SessionFolder) -> IdentifiedPlant:
    """The identified plant. Raises InputError also if it comes from other data."""
    found = session.result("identify", "identified.json", IdentifiedPlant)
    record = experiments_of(session).record
    steps = len(record) - 1
    if found.data_sha256 != record.sha256() or found.identified.residual_um.shape != (steps,):
        raise errors.InputError(
            f"{session.path}: identified.json comes from other experiments; run identify again"
        )
    return found


def observe_step(
    session: folder.SessionFolder, rig: HoldRig, duration_s: float = OBSERVE_S
) -> DisturbanceModel:
    """Observe a quiet hold, in a short session the one before its experiments: laser noise and
    weather.
    """
    model = found_of(session).identified.model
    session.begin("observe")
    held = session.file(_HELD)
    record = loop_model.load_record(held) if held.exists() else rig.hold(duration_s)
    try:
        disturbance = observe(record, model, rig.loop)
    except ValueError as error:
        raise errors.RejectedError(f"observe: {error}") from None
    loop_model.save_record(session.file("quiet.npz"), record)
    folder.write(session.file("disturbance.json"), disturbance)
    return disturbance


def disturbance_of(session: folder.SessionFolder) -> DisturbanceModel:
    """The observed disturbance."""
    return session.result("observe", "disturbance.json", DisturbanceModel)


# where the estimate weighs the weather sensors against what it expects of the weather
_WALK_RAD_PER_S = 1.0


def estimator_of(session: folder.SessionFolder) -> dict[str, float]:
    """What the session measured of `[estimator]`: the pump, and noise and unrest of the sensors
    that are there.
    """
    model, seen = found_of(session).identified.model, disturbance_of(session)
    levels = {"pump_delay_s": model.dead_time_s, "pump_lag_s": model.lag_s}
    if not session.config.by_optics:  # a figure states its own noise
        levels["laser_noise_um"] = seen.laser_um
    for name, unit, walk, weather in (
        ("barometer", "pa", "pressure", seen.barometer),
        ("thermometer", "k", "air", seen.air),
    ):
        if weather is not None:
            levels[f"{name}_noise_{unit}"] = weather.noise
            density = float(weather.psd(np.array([_WALK_RAD_PER_S]))[0])
            levels[f"{walk}_walk_{unit}_per_root_s"] = _WALK_RAD_PER_S * math.sqrt(density)
    rounded = {key: float(f"{value:.3g}") for key, value in levels.items()}
    return {key: value for key, value in rounded.items() if value > 0 and math.isfinite(value)}


def design_step(session: folder.SessionFolder, reason: str = "tuning session") -> GainsFile:
    """Compute the candidates and propose gains. Raises RejectedError if the data do not support a
    proposal.
    """
    found, disturbance = found_of(session), disturbance_of(session)
    session.begin("design")
    before = session.head.before
    try:
        made = design.propose(
            found.identified, disturbance, before, session.config.pump, found.quality
        )
    except design.RefusedError as error:
        raise errors.RejectedError(f"design: {error}") from None
    assert made.chosen.predicted is not None  # a proposal keeps its margins
    if not math.isfinite(made.chosen.predicted.std_um + made.least_std_um):
        raise errors.RejectedError(
            "design: cannot predict a std from this noise and weather: observe again"
        )
    gains = GainsFile(
        author=session.head.author,
        date_utc=session.head.created_utc,
        reason=reason,
        source=f"{session.head.source}; session {session.path.name}",
        data_sha256=found.data_sha256,
        predicted_std_um=made.chosen.predicted.std_um,
        least_std_um=made.least_std_um,
        plant=PlantSection.of(found.identified),
        loop=made.loop,
    )
    files.write_text_atomic(
        files.users(session.file("candidates.md")), design.table(made.candidates) + "\n"
    )
    kept = Design(made.candidates, made.least_std_um, made.preview, made.robustness)
    folder.write(session.file("proposal.json"), kept)
    save_gains(session.file("gains.toml"), gains)
    return gains


def design_of(session: folder.SessionFolder) -> Design:
    """The candidates."""
    return session.result("design", "proposal.json", Design)


EDITED = "edited"  # gains of a file edited by hand


def offered(session: folder.SessionFolder) -> tuple[tuple[design.Candidate, ...], design.Candidate]:
    """The candidates, and the one in `gains.toml`, which is a further one if that was edited by
    hand.
    """
    rows, loop = design_of(session).candidates, load_gains(session.file("gains.toml")).loop
    gains = loop_model.Gains.of(loop)
    for row in rows:
        if row.gains == gains:
            return rows, row
    model = found_of(session).identified.model
    edited = design.candidate(
        EDITED, gains, model, disturbance_of(session), loop, candidates.Demands()
    )
    return (*rows, edited), edited


def choices(session: folder.SessionFolder) -> tuple[str, ...]:
    """Names of the candidates that may be applied, the proposed one first."""
    rows, now = offered(session)
    ordered = sorted(rows, key=lambda row: row is not now)
    return tuple(
        row.name for row in ordered if row.name != design.PRESENT and not design.refusal(row)
    )


def choose(session: folder.SessionFolder, name: str) -> None:
    """Put a candidate into `gains.toml`. Raises InputError if it is
    unknown or must not be applied.
    """
    rows, now = offered(session)
    known = {row.name: row for row in rows if row.name != design.PRESENT}
    if name == design.SAME_LOAD and name not in known:
        name = design.NAMES[0]  # answers a step of the leak no worse
    if name not in known:
        raise errors.InputError(
            f"{name}: not a candidate of {session.path.name}; known: {', '.join(known)}"
        )
    if why := design.refusal(row := known[name]):
        raise errors.InputError(f"{name}: is not applied: {why}")
    assert row.predicted is not None  # else refused
    gains = load_gains(path := session.file("gains.toml"))
    chosen = {"candidate": name, "predicted_std_um": row.predicted.std_um}
    save_gains(path, gains.model_copy(update={**chosen, "loop": row.gains.applied_to(gains.loop)}))
    if row is not now and session.done("preview"):
        preview_step(session)


def traded(session: folder.SessionFolder) -> Traded:
    """What the gains in `gains.toml` give and cost."""
    rows, now = offered(session)
    present = [row.figures for row in rows if row.name == design.PRESENT]
    if not present:
        raise errors.InputError(f"{session.path}: proposal.json is damaged; run design again")
    return Traded(now.name, present[0], now.figures)


def preview_step(session: folder.SessionFolder) -> Previewed:
    """Simulate present and proposed gains on the fitted twin with its one-sided pump, for several
    weather seeds.
    """
    session.require("design")
    found, disturbance = found_of(session), disturbance_of(session)
    gains = load_gains(session.file("gains.toml"))
    session.begin("preview")
    pump, model = session.config.pump, found.identified.model
    present, proposed = (
        tuple(
            prediction.preview(loop, pump, model, disturbance, seed)
            for seed in range(1, _PREVIEW_SEEDS + 1)
        )
        for loop in (session.head.before, gains.loop)
    )
    done = Previewed(present, proposed)
    folder.write(session.file("preview.json"), done)
    return done


def preview_of(session: folder.SessionFolder) -> Previewed:
    """Result of the preview."""
    return session.result("preview", "preview.json", Previewed)


def checked_gains(session: folder.SessionFolder) -> schema.LoopConfig:
    """The session's gains for its hold. Raises InputError if they must not be applied."""
    session.require("design")
    path = session.file("gains.toml")
    gains = load_gains(path)
    require_sound(gains, str(path), session.config.loop)
    return for_hold(gains.loop, session.head.before)


def apply_step(session: folder.SessionFolder, rig: HoldRig) -> schema.LoopConfig:
    """Set the gains on trial; without `verify` they revert automatically."""
    loop = checked_gains(session)
    session.begin("apply")
    rig.set_gains(loop, f"session {session.path.name}", _APPLY_S)
    folder.write(session.file("applied.json"), {"trial_s": _APPLY_S, "loop": loop})
    return loop


def verify_step(
    session: folder.SessionFolder,
    rig: HoldRig,
    told: Callable[[verify.Stage], None] = lambda stage: None,
    stages: tuple[tuple[float, float], ...] = verify.STAGES,
) -> Verified:
    """Hold with the new gains and judge them in stages; keep them,
    or restore the old ones at once.
    """
    session.require("apply")
    after, before = checked_gains(session), session.head.before
    accepted = load_gains(session.file("gains.toml")).candidate == offered(session)[1].name
    session.begin("verify")
    model, weather = found_of(session).identified.model, disturbance_of(session)
    trial = verify.VerificationTrial(model, weather, before, after, accepted, rig.pump)
    trial_s = verify.settle_s(after) + 2 * stages[-1][0] + _SPARE_S
    rig.set_gains(after, f"session {session.path.name}: verification", trial_s)
    looks: list[verify.Stage] = []
    record: loop_model.Record | None = None
    setpoint_um, reason = np.empty(0), ""
    try:
        rig.hold(verify.settle_s(after))
        for until_s, growth_max in (*stages, (2 * stages[-1][0], stages[-1][1])):
            more, about_um = rig.hold_about(until_s - setpoint_um.size * rig.dt_s)
            record = more if record is None else record.followed_by(more)
            setpoint_um = np.concatenate((setpoint_um, about_um))
            looks.append(verify.look(record, setpoint_um, trial, growth_max))
            told(looks[-1])
            reason = looks[-1].reason
            if until_s == stages[-1][0] and looks[-1].close:
                continue  # as likely the weather as the gains: as long again decides
            if reason or until_s == stages[-1][0]:
                break
    except live_hold.HoldError as error:
        reason = str(error)
    if reason:
        try:
            rig.set_gains(before, f"verification failed: {reason}"[:250])
        except live_hold.HoldError:  # the hold has gone, and takes them back by itself
            raise live_hold.HoldError(reason) from None
    else:
        rig.keep()
    done = Verified(not reason, reason, tuple(looks), before, after)
    if record is not None:
        loop_model.save_record(session.file("verify.npz"), record)
    folder.write(session.file("verified.json"), done)
    return done


def verified_of(session: folder.SessionFolder) -> Verified:
    """Result of the verification."""
    return session.result("verify", "verified.json", Verified)
