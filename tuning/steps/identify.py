"""Second step of a session: fit the plant to the experiments and judge the fit."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from membrane_ctrl.control.leak_estimate import TOO_TIGHT_UM_PER_S
from membrane_ctrl.model import errors
from membrane_ctrl.report_pages.blocks import PageBlock, PageSection, PageTable, PageText, TextMark
from membrane_ctrl.sessions import folder, session_json
from tuning.identification import experiments, fit_quality, plant_fit, plant_model
from tuning.identification.actuator_kind import ActuatorKind, recognise_actuator
from tuning.identification.record import Record
from tuning.report.pictures import embed_picture, is_outdated, save_figure
from tuning.sentences import TOO_TIGHT
from tuning.steps.characterise import PumpUnknownError, load_experiments

_PICTURE = "experiments.png"


@dataclass(frozen=True, slots=True)
class IdentifiedPlant:
    """`identified.json`."""

    identified: plant_fit.Identified
    quality: fit_quality.FitQuality
    data_sha256: str
    actuator: ActuatorKind


def run_identify(session: folder.SessionFolder) -> IdentifiedPlant:
    """Fit the model and judge it; a refused fit is kept too, for the report."""
    done = load_experiments(session)
    session.begin_step("identify")
    try:
        all_of_it = experiments.fit_experiments(done)
    except ValueError as error:
        raise errors.RejectedError(f"identify: {error}") from None
    actuator = recognise_actuator(done.record, all_of_it.identified)
    found = IdentifiedPlant(all_of_it.identified, all_of_it.quality, done.record.sha256(), actuator)
    session_json.write_session_file(session.file_path("identified.json"), found)
    return found


def load_identified(session: folder.SessionFolder) -> IdentifiedPlant:
    """The identified plant. Raises InputError also if it comes from other data."""
    found = session.read_result("identify", "identified.json", IdentifiedPlant)
    record = load_experiments(session).record
    steps = len(record) - 1
    if found.data_sha256 != record.sha256() or found.identified.residual_um.shape != (steps,):
        raise errors.InputError(
            f"{session.path}: identified.json comes from other experiments; run identify again"
        )
    return found


def require_known_pump(session: folder.SessionFolder) -> None:
    """Raises PumpUnknownError if the fit was refused because of the pump's curve."""
    if load_identified(session).quality.pump_unknown:
        raise PumpUnknownError("identify: the pump does not match its configured curve")


def describe_result(session: folder.SessionFolder) -> str:
    """The fitted plant in one line."""
    found = load_identified(session)
    model = found.identified.model
    sigma = found.identified.sigma
    plant = (
        f"k {model.gain:.3f} +- {sigma.gain:.3f}, delay {model.delay_s:.3f} +- {sigma.delay_s:.3f} "
        f"s (dead time {model.dead_time_s:.3f} +- {sigma.dead_time_s:.3f} s), leak "
        f"{model.leak_um_per_s:.2f} µm/s: {found.quality.verdict}"
    )
    # What limits the use of these data, each with its remedy.
    remarks = list(found.quality.reasons)
    if model.leak_um_per_s < TOO_TIGHT_UM_PER_S:
        remarks.append(TOO_TIGHT)
    remarks.append(found.actuator.describe())
    remarks.append(describe_losses(load_experiments(session).record, session.config.by_optics))
    return "; ".join([plant, *(remark for remark in remarks if remark)])


def describe_losses(record: Record, by_optics: bool) -> str:
    """How often and how long the sensor of the displacement had no reading.

    Parameters
    ----------
    record : Record
        Of the experiments.
    by_optics : bool
        Whether the sensor is the camera; otherwise it is the laser.

    Returns
    -------
    str
        Empty if it never lost its reading.
    """
    return describe_gaps(record.gaps_s, record.duration_s, by_optics)


def describe_gaps(gaps_s: Sequence[float], duration_s: float, by_optics: bool) -> str:
    """As `describe_losses`, for several records.

    Parameters
    ----------
    gaps_s : sequence of float
        Duration of each time without a reading.
    duration_s : float
        Of all experiments.
    by_optics : bool
        As of `describe_losses`.
    """
    if not gaps_s:
        return ""
    sensor = "camera" if by_optics else "laser"
    return (
        f"the {sensor} had no reading {len(gaps_s)} times in {duration_s:.0f} s of "
        f"experiments, {max(gaps_s):.2f} s at the longest: look for something in its way and a "
        "loose cable"
    )


def make_report_part(session: folder.SessionFolder) -> PageSection:
    """Experiments and fit, for the report; the experiments alone before they are fitted."""
    blocks: list[PageBlock] = [*embed_picture(session, _PICTURE)]
    if session.is_done("identify"):
        blocks += _describe_fit(session)
    return PageSection("Experiments and fit", blocks)


def _describe_fit(session: folder.SessionFolder) -> list[PageBlock]:
    """Return the verdict on the data, the fitted values and the tests of the residuals."""
    found = load_identified(session)
    fit = found.identified
    model, sigma = fit.model, fit.sigma
    # Whether the data may be used, and what they lack.
    mark = TextMark.BAD if found.quality.verdict == "refused" else TextMark.GOOD
    reasons = "; ".join(found.quality.reasons)
    lossy = describe_losses(load_experiments(session).record, session.config.by_optics)
    rows = [
        ("gain k", f"{model.gain:.3f}", f"{sigma.gain:.3f}"),
        ("dead time (s)", f"{model.dead_time_s:.3f}", f"{sigma.dead_time_s:.3f}"),
        ("lag (s)", f"{model.lag_s:.3f}", f"{sigma.lag_s:.3f}"),
        ("delay, both (s)", f"{model.delay_s:.3f}", f"{sigma.delay_s:.3f}"),
        ("leak (µm/s)", f"{model.leak_um_per_s:.2f}", f"{sigma.leak_um_per_s:.2f}"),
    ]
    # White residuals, independent of the flow: the model explains what the pump did.
    tests = (
        f"Residuals: whiteness p = {fit.whiteness_p:.3g}, independence of the flow p = "
        f"{fit.independence_p:.3g}, largest {fit.largest_residual:.1f} sigma. Data "
        f"{found.data_sha256[:16]}."
    )
    remarks = [
        PageText(f"{remark[0].upper()}{remark[1:]}.", TextMark.BAD)
        for remark in (found.actuator.describe(), lossy)
        if remark
    ]
    return [
        PageText(f"Data: {found.quality.verdict}. {reasons}", mark),
        *remarks,
        PageTable(("", "value", "1 sigma"), rows),
        PageText(tests),
    ]


def draw_picture(session: folder.SessionFolder) -> None:
    """Draw the experiments and, once fitted, the model's response, unless they are up to date."""
    if session.is_done("characterise") and is_outdated(
        session, _PICTURE, "characterise", "identify"
    ):
        fit = load_identified(session).identified if session.is_done("identify") else None
        _draw_experiments(session.file_path(_PICTURE), load_experiments(session).record, fit)


def _draw_experiments(path: Path, record: Record, found: plant_fit.Identified | None) -> None:
    """Draw flow and readings and, once fitted, the model's response
    to the flow with the residuals.
    """
    figure = Figure(figsize=(11, 7), layout="constrained")
    upper, middle, lower = figure.subplots(3, 1, sharex=True)
    time_s = np.arange(len(record)) * record.dt_s
    upper.step(time_s, record.flow_um_per_s, where="post", linewidth=0.8)
    upper.set(ylabel="flow (µm/s)")
    middle.plot(
        time_s, record.displacement_um, ".", markersize=1, color="tab:gray", label="reading"
    )
    if found is not None:
        middle.plot(
            time_s,
            plant_model.compute_pump_share_um(record, found.model),
            linewidth=1,
            label="response to the pump (model)",
        )
        lower.plot(time_s[1:], found.residual_um, linewidth=0.4)
    middle.set(ylabel="centre (µm)")
    middle.legend(loc="upper right")
    lower.set(ylabel="prediction error (µm)", xlabel="time (s)")
    save_figure(path, figure)
