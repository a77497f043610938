"""`tune run` and the commands of single steps."""

from pathlib import Path
from types import ModuleType

from membrane_ctrl.model.errors import DeviceError, RejectedError, convert_write_errors
from membrane_ctrl.sessions.folder import STEPS, SessionFolder
from membrane_ctrl.sessions.progress import Progress
from tuning import connection, journal
from tuning.commands import choose
from tuning.commands.conclusion import conclude
from tuning.commands.map_pump import measure_pump
from tuning.commands.open_page import find_page, link_to_tab
from tuning.identification import pump_survey
from tuning.options import TuneOptions
from tuning.proposal.verification import SETTLE_LEAST_S, Stage, find_settling_time_s
from tuning.report import page
from tuning.rigs.hold_rig import HoldRig
from tuning.steps import apply, characterise, design, identify, map_pump, observe, preview, verify

_MODULES: dict[str, ModuleType] = {
    "characterise": characterise,
    "identify": identify,
    "observe": observe,
    "design": design,
    "preview": preview,
    "apply": apply,
    "verify": verify,
}
_NO_GAINS = (
    "the hold follows the estimate, whose loop has no gains to design: `membrane-ctrl tune "
    "save {} --config FILE` hands pump and noise levels to [estimator]"
)
_OF_GAINS = frozenset({"design", "preview", "apply", "verify"})
_MOVES = frozenset({"characterise", "observe", "apply", "verify"})


def run_session(options: TuneOptions) -> int:
    """Run all steps that are not done yet and return the exit code; raises like `run_step`."""
    choose.require_answer(options.yes, options.choose)
    with connection.open_on_hold(options) as (folder, rig, progress):
        if options.page:
            page_service = find_page(options.logs)
            progress.print_line(f"page: {link_to_tab(page_service.link)}")
            page_service.forget()
        try:
            _run_steps(
                [step for step in STEPS if not folder.is_done(step)], folder, rig, options, progress
            )
        except characterise.PumpUnknownError as error:
            if map_pump.has_pump_map(folder):
                raise
            progress.print_line(f"{error}; {_announce_pump_map(options)}")
            rest_s = sum(_plan_steps(options).values())
            folder = measure_pump(folder, rig, options.limit_um, progress, rest_s)
            _run_steps(list(STEPS), folder, rig, options, progress)
        # if the session was killed before it did
        _note_verified(folder, options.logs, options.reason)
        page.write_report(folder)
    return conclude(folder, options)


def run_step(step: str, options: TuneOptions) -> int:
    """Run one step of the named or newest session.

    Parameters
    ----------
    step : str
        One of `STEPS`; `characterise` starts a new session.
    options : TuneOptions
        Of the command: session, hold or twin, answers.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError, DeviceError, RejectedError
        The mirror is then held with the last good gains.
    """
    if step == "apply":
        choose.require_answer(options.yes, options.choose)
    if step not in _MOVES:
        folder = connection.find_session(options, None)
        with convert_write_errors(folder.path, DeviceError):
            _run_anywhere(step, folder, options)
            _report_step(step, folder, Progress())
    else:
        fresh = step == "characterise" and options.session is None
        with connection.open_on_hold(options, fresh) as (folder, rig, progress):
            _run_steps([step], folder, rig, options, progress)
    return conclude(folder, options)


def _run_steps(
    steps: list[str], folder: SessionFolder, rig: HoldRig, options: TuneOptions, progress: Progress
) -> None:
    """Run steps in their order, until one is refused or a person wants no new gains."""
    for number, step in enumerate(steps):
        # A loop on the estimate has no gains: the session ends with what it has measured.
        if step in _OF_GAINS and not folder.config.has_pi:
            no_gains = _NO_GAINS.format(folder.path)
            if steps == [step]:
                raise RejectedError(f"{step}: {no_gains}")
            progress.print_line(no_gains)
            return
        # Before the gains change a person chooses a candidate, unless an option does.
        candidate = ""
        if step == "apply":
            chosen = choose.choose_candidate(folder, options.yes, options.choose, progress)
            if chosen is None:
                progress.print_line(
                    f"nothing is applied; `membrane-ctrl tune apply --session {folder.path}` "
                    "applies a candidate later"
                )
                return
            candidate = chosen
        _announce_step(progress, options, folder, step, steps[number + 1 :])
        _run_on_hold(step, folder, rig, options, progress, candidate)
        _report_step(step, folder, progress)
        if step == "identify":
            identify.require_known_pump(folder)


def _run_on_hold(
    step: str,
    folder: SessionFolder,
    rig: HoldRig,
    options: TuneOptions,
    progress: Progress,
    candidate: str,
) -> None:
    """Run one step of a session that has a hold; `candidate` is for `apply`."""

    def report_stage(stage: Stage) -> None:
        progress.print_line(
            f"  after {stage.time_s:.0f} s: std {stage.std_um:.3f} µm, {stage.growth:.2f} of the "
            "previous gains"
        )

    match step:
        case "characterise":
            characterise.run_characterise(folder, rig, options.limit_um, options.plan)
        case "observe":
            observe.run_observe(folder, rig, options.observe_s)
        case "apply":
            apply.run_apply(folder, rig, candidate)
        case "verify":
            verify.run_verify(folder, rig, report_stage, options.stages)
            _note_verified(folder, options.logs, options.reason, again=True)
        case _:
            _run_anywhere(step, folder, options)


def _run_anywhere(step: str, folder: SessionFolder, options: TuneOptions) -> None:
    """Run a step that needs no hold."""
    match step:
        case "identify":
            identify.run_identify(folder)
        case "design":
            design.run_design(folder, options.reason)
        case "preview":
            preview.run_preview(folder)


def _report_step(step: str, folder: SessionFolder, progress: Progress) -> None:
    """Update the report and print the step's result in one line."""
    page.write_report(folder)
    progress.print_line(f"{step}: {_MODULES[step].describe_result(folder)}")


def _note_verified(folder: SessionFolder, logs: Path, reason: str, again: bool = False) -> None:
    """Note the verification in the journal, unless it is there; `again` if it was repeated."""
    name = folder.path.name
    if not folder.is_done("verify"):
        return
    if not again and any(
        line.session == name and line.shape_s is None for line in journal.read_entries(logs)
    ):
        return
    done = verify.load_verified(folder)
    entry = journal.make_entry(
        "kept" if done.kept else "taken_back",
        name,
        folder.head.author,
        reason if done.kept else done.reason,
        done.before,
        done.after,
        design.compare_with_present(folder),
    )
    journal.append_entry(logs, entry)


def _announce_step(
    progress: Progress, options: TuneOptions, folder: SessionFolder, step: str, after: list[str]
) -> None:
    """Show the step and the time that it and the later ones are expected to take."""
    planned_s = _plan_steps(options)
    longest_s = 0.0
    if step == "verify":
        # slow gains settle for longer, and a close comparison continues for as long again
        settling_s = find_settling_time_s(apply.load_checked_gains(folder))
        planned_s["verify"] = settling_s + options.verify_s
        longest_s = settling_s + 2.0 * options.verify_s
    progress.begin_step(
        step,
        planned_s.get(step, 0.0),
        sum(planned_s.get(later, 0.0) for later in after),
        longest_s,
    )


def _plan_steps(options: TuneOptions) -> dict[str, float]:
    """Expected durations of the steps that need the hold's time, in s."""
    return {
        "characterise": options.plan.typical_s,
        "observe": 0.0 if options.short else options.observe_s,
        "verify": SETTLE_LEAST_S + options.verify_s,
    }


def _announce_pump_map(options: TuneOptions) -> str:
    """What the session does about an unknown pump, and how long it takes from here on."""
    rest_s = sum(_plan_steps(options).values())
    shortest_min, longest_min = (
        round((map_s + rest_s) / 60.0) for map_s in (pump_survey.TYPICAL_S, pump_survey.LONGEST_S)
    )
    return (
        "the pump's curve is measured first, then the session starts again on it: "
        f"{shortest_min} to {longest_min} min from here"
    )
