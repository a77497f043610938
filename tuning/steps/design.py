"""Fourth step of a session: compute the candidates and propose gains."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from membrane_ctrl.model import errors, files
from membrane_ctrl.report_pages.blocks import PageSection, PageTable, PageText
from membrane_ctrl.sessions import folder, session_json
from tuning.gains_file import (
    GainsFile,
    PlantSection,
    load_gains,
    save_gains,
)
from tuning.identification import closed_loop, plant_model
from tuning.journal import Traded
from tuning.proposal import candidate, candidate_table, design, gain_search, verification
from tuning.proposal.preview import Preview
from tuning.proposal.robustness import Robustness
from tuning.report.pictures import embed_picture, is_outdated, save_figure
from tuning.sentences import describe_gains
from tuning.steps.identify import load_identified
from tuning.steps.observe import load_disturbance, load_quiet_record

EDITED = "edited"  # name of gains in a file that was edited by hand
_PICTURE = "candidates.png"
# Largest values that its bars show
_RECOVERY_CUT_S = 60.0
_FLOW_CUT = 3.0  # µm/s


@dataclass(frozen=True, slots=True)
class Design:
    """`proposal.json`: a `design.Proposal` without its loop, which is in the gains file."""

    candidates: tuple[candidate.Candidate, ...]
    least_std_um: float
    preview: Preview
    robustness: Robustness


def run_design(session: folder.SessionFolder, reason: str = "tuning session") -> GainsFile:
    """Compute the candidates and propose gains.

    Parameters
    ----------
    session : SessionFolder
        With an identified plant and observed weather.
    reason : str
        Of the session, for the gains file.

    Returns
    -------
    GainsFile
        The proposal, as it was written.

    Raises
    ------
    RejectedError
        If the data do not support a proposal.
    """
    # The design.
    found = load_identified(session)
    disturbance = load_disturbance(session)
    session.begin_step("design")
    before = session.head.before
    try:
        made = design.propose_gains(
            found.identified, disturbance, before, session.config.pump, found.quality
        )
    except design.RefusedError as error:
        raise errors.RejectedError(f"design: {error}") from None
    assert made.chosen.predicted is not None  # a proposal keeps its margins
    if not math.isfinite(made.chosen.predicted.std_um + made.least_std_um):
        raise errors.RejectedError(
            "design: cannot predict a std from this noise and weather: observe again"
        )

    # Its files: the proposed gains with their origin, the table of candidates, all of it.
    gains = GainsFile(
        author=session.head.author,
        date_utc=session.head.created_utc,
        reason=reason,
        source=f"{session.head.source}; session {session.path.name}",
        data_sha256=found.data_sha256,
        predicted_std_um=made.chosen.predicted.std_um,
        least_std_um=made.least_std_um,
        plant=PlantSection.from_fit(found.identified),
        loop=made.loop,
    )
    files.write_text_atomic(
        files.resolve_user_path(session.file_path("candidates.md")),
        candidate_table.format_markdown(made.candidates) + "\n",
    )
    kept = Design(made.candidates, made.least_std_um, made.preview, made.robustness)
    session_json.write_session_file(session.file_path("proposal.json"), kept)
    save_gains(session.file_path("gains.toml"), gains)
    return gains


def load_design(session: folder.SessionFolder) -> Design:
    """The candidates."""
    return session.read_result("design", "proposal.json", Design)


def load_candidates(
    session: folder.SessionFolder,
) -> tuple[tuple[candidate.Candidate, ...], candidate.Candidate]:
    """The candidates, and the one in `gains.toml`, which is a further one if that was edited by
    hand.
    """
    rows = load_design(session).candidates
    loop = load_gains(session.file_path("gains.toml")).loop
    gains = closed_loop.Gains.from_config(loop)
    for row in rows:
        if row.gains == gains:
            return rows, row
    model = load_identified(session).identified.model
    edited = candidate.evaluate_candidate(
        EDITED, gains, model, load_disturbance(session), loop, gain_search.Demands()
    )
    return (*rows, edited), edited


def list_applicable(session: folder.SessionFolder) -> tuple[str, ...]:
    """Names of the candidates that may be applied, the proposed one first."""
    rows, now = load_candidates(session)
    ordered = sorted(rows, key=lambda row: row is not now)
    return tuple(
        row.name
        for row in ordered
        if row.name != candidate.PRESENT and not candidate.find_refusal(row)
    )


def find_candidate(session: folder.SessionFolder, name: str) -> candidate.Candidate:
    """Find a candidate that may be applied.

    Parameters
    ----------
    session : SessionFolder
        With a finished design.
    name : str
        `balanced` and `same-load` also where the least variance answers a step of the leak as well
        as they must.

    Raises
    ------
    InputError
        If it is unknown or must not be applied.
    """
    rows, _ = load_candidates(session)
    known = {row.name: row for row in rows if row.name != candidate.PRESENT}
    if name in (candidate.BALANCED, candidate.SAME_LOAD) and name not in known:
        # the least variance already answers a step of the leak as well as this one must
        name = candidate.LEAST_VARIANCE
    if name not in known:
        raise errors.InputError(
            f"{name}: not a candidate of {session.path.name}; known: {', '.join(known)}"
        )
    refusal = candidate.find_refusal(known[name])
    if refusal:
        raise errors.InputError(f"{name}: is not applied: {refusal}")
    return known[name]


def explain_no_benefit(session: folder.SessionFolder) -> str:
    """Why the designed proposal is not worth a trial; empty if it is, or if a person chose or
    edited the gains.
    """
    rows, now = load_candidates(session)
    present = next((row for row in rows if row.name == candidate.PRESENT), None)
    if now.name not in (candidate.BALANCED, candidate.LEAST_VARIANCE) or present is None:
        return ""
    if load_gains(session.file_path("gains.toml")).candidate:
        return ""
    return _compare_benefit(now, present)


def explain_no_benefit_of(session: folder.SessionFolder, name: str) -> str:
    """Why a named candidate is not worth a trial; empty if it is.

    Parameters
    ----------
    session : SessionFolder
        In which the step is done.
    name : str
        As in `candidates.md`, for example `balanced`.

    Raises
    ------
    InputError
        It is unknown or must not be applied.
    """
    chosen = find_candidate(session, name)
    rows, _ = load_candidates(session)
    present = next((row for row in rows if row.name == candidate.PRESENT), None)
    if present is None:
        return ""
    return _compare_benefit(chosen, present)


def _compare_benefit(chosen: candidate.Candidate, present: candidate.Candidate) -> str:
    growth = chosen.figures.std_um / present.figures.std_um
    lacks_margin = candidate.find_refusal(present) != ""
    if lacks_margin or not growth > verification.GROWTH_OF_BENEFIT:
        return ""
    return (
        f"the present gains are as good as {chosen.name}: its predicted std is {growth:.2f} of "
        "theirs, and a verification shows no smaller difference than "
        f"{1 - verification.GROWTH_OF_BENEFIT:.0%}"
    )


def compare_with_present(session: folder.SessionFolder) -> Traded:
    """What the gains in `gains.toml` give and cost."""
    rows, now = load_candidates(session)
    present = [row.figures for row in rows if row.name == candidate.PRESENT]
    if not present:
        raise errors.InputError(f"{session.path}: proposal.json is damaged; run design again")
    return Traded(now.name, present[0], now.figures)


def describe_result(session: folder.SessionFolder) -> str:
    """The gains in `gains.toml` in one line."""
    gains = load_gains(session.file_path("gains.toml"))
    ratio = gains.predicted_std_um / gains.least_std_um
    return (
        f"{describe_gains(gains.loop)}: {compare_with_present(session)}; {ratio:.2f} of the lower "
        "bound"
    )


def make_report_part(session: folder.SessionFolder) -> PageSection | None:
    """The candidates, for the report; None before the step is done."""
    if not session.is_done("design"):
        return None
    kept = load_design(session)
    gains = load_gains(session.file_path("gains.toml"))
    loop = gains.loop
    traded = compare_with_present(session)
    by = "chosen" if gains.candidate else "proposed"
    lines = session.read_candidates().splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    text = (
        f"{traded.candidate} is {by}: K {loop.kp_per_s:.3f} 1/s, Ti {loop.ti_s:.2f} s, filter "
        f"{loop.measurement_filter_s:.2f} s. Present and new gains: {traded}. Lower bound of the "
        f"std: {gains.least_std_um:.3f} µm. The proposal over plants drawn from the fit: Ms "
        f"{kept.robustness.ms_p95:.2f}, std {kept.robustness.std_p95_um:.3f} µm at 95 %, "
        f"{kept.robustness.stable_fraction:.0%} stable."
    )
    table = PageTable(cells[0], cells[2:])
    return PageSection("Candidates", [table, *embed_picture(session, _PICTURE), PageText(text)])


def draw_picture(session: folder.SessionFolder) -> None:
    """Draw the candidates side by side, unless the picture is up to date."""
    if session.is_done("design") and is_outdated(
        session, _PICTURE, "identify", "observe", "design"
    ):
        model = load_identified(session).identified.model
        dt_s = load_quiet_record(session).dt_s
        _draw_candidates(session.file_path(_PICTURE), load_design(session), model, dt_s)


def _draw_candidates(path: Path, kept: Design, model: plant_model.PlantModel, dt_s: float) -> None:
    """Draw all candidates: predicted standard deviation, Ms, load peak, recovery, pump activity,
    |S|.
    """
    # The figures of the stable ones.
    rows = [row for row in kept.candidates if row.predicted is not None]
    predictions = [row.predicted for row in kept.candidates if row.predicted is not None]
    names = [row.name for row in rows]
    stds_um = [predicted.std_um for predicted in predictions]
    flows_um_per_s = np.minimum([each.flow_std_um_per_s for each in predictions], _FLOW_CUT)
    sensitivities = [row.margins.ms for row in rows]
    peaks_um = [row.load_peak_um for row in rows]
    recoveries_s = np.minimum([row.load_recovery_s for row in rows], _RECOVERY_CUT_S)

    # Five figures as bars, with a limit where there is one.
    figure = Figure(figsize=(12, 8), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    places = np.arange(len(names))
    for axes, values, title, limit in (
        (panels[0], stds_um, "predicted std (µm)", kept.least_std_um),
        (panels[1], sensitivities, "Ms", 1.4),
        (panels[2], peaks_um, "load peak (µm)", math.nan),
        (panels[3], recoveries_s, f"recovery (s, cut at {_RECOVERY_CUT_S:.0f})", math.nan),
        (panels[4], flows_um_per_s, f"flow std (µm/s, cut at {_FLOW_CUT:.0f})", math.nan),
    ):
        axes.barh(places, values, color=["tab:green"] + ["tab:blue"] * (len(names) - 1))
        axes.set_yticks(places, names, fontsize=7)
        axes.invert_yaxis()
        axes.set_title(title, fontsize=9)
        if math.isfinite(limit):
            axes.axvline(limit, color="tab:red", linestyle="--")

    # The sensitivity over the frequency.
    last = panels[5]
    w = closed_loop.make_frequencies(dt_s)
    for row in rows:
        response = closed_loop.compute_loop_response(row.gains, model, w, dt_s)
        width = 2 if row is rows[0] else 0.8
        last.semilogx(w, np.abs(1 / (1 + response)), linewidth=width, label=row.name)
    last.set(xlim=(0.05, w[-1]), xlabel="rad/s", title="|S|")
    last.legend(loc="best", fontsize=6)
    save_figure(path, figure)
