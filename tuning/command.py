"""`tune`: sessions on a running hold or on the twin, step by step or all at once."""

import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from statistics import fmean

from membrane_ctrl.config.schema import Config, LoopConfig
from membrane_ctrl.control.leak_estimate import TOO_TIGHT_UM_PER_S
from membrane_ctrl.model.errors import DeviceError, Exit, InputError, RejectedError, writing
from membrane_ctrl.sessions import folder as plain
from membrane_ctrl.sessions.folder import STEPS, SessionFolder
from membrane_ctrl.sessions.live_hold import HoldError, Progress
from tuning import choice, gains_file, opening, pump_trial, report, session
from tuning.identification.pump_survey import TYPICAL_S as PUMP_TYPICAL_S
from tuning.opening import TuneOptions
from tuning.proposal.verify import SETTLE_LEAST_S, Stage
from tuning.rig import HoldRig

_TOO_TIGHT = (
    "the mirror is too tight to be held within its band: open the bleed (loop.bleed_fraction)"
)
NEEDS_BOKEH = "{} needs Bokeh: pip install 'membrane-ctrl[web]'"
_NO_GAINS = (
    "the hold follows the estimate, whose loop has no gains to design: `membrane-ctrl tune "
    "save {} --config FILE` "
    "hands pump and noise levels to [estimator]"
)
_OF_GAINS = frozenset({"design", "preview", "apply", "verify"})
_MOVES = frozenset({"characterise", "observe", "apply", "verify"})


def run_session(options: TuneOptions) -> int:
    """Run all steps that are not done yet and return the exit code; raises like `one_step`."""
    choice.require_an_answer(options.yes, options.choose)
    with opening.opened(options) as (folder, rig, progress):
        if options.page:
            progress.say(f"live page: {_served(folder, options)}session")
        try:
            _do_all(
                [step for step in STEPS if not folder.done(step)], folder, rig, options, progress
            )
        except session.PumpUnknownError as error:
            if pump_trial.mapped(folder):
                raise
            progress.say(str(error))
            folder = _map_pump(folder, rig, options.limit_um, progress)
            _do_all(list(STEPS), folder, rig, options, progress)
        _note_verified(
            folder, options.logs, options.reason
        )  # if the session was killed before it did
        report.write_report(folder)
    return _concluded(folder, options)


def _served(folder: SessionFolder, options: TuneOptions) -> str:
    """The address of the session's page, which lasts as long as this program."""
    try:
        from tuning.explore.page import serve_beside
    except ModuleNotFoundError:
        raise InputError(NEEDS_BOKEH.format("tune run --page")) from None
    return serve_beside(folder, options.logs, options.author)


def one_step(step: str, options: TuneOptions) -> int:
    """Run one step of the named or newest session; `characterise` starts a new one.

    Raises InputError, DeviceError or RejectedError, and then holds the mirror with the last good
    gains.
    """
    if step == "apply":
        choice.require_an_answer(options.yes, options.choose)
    if step not in _MOVES:
        folder = opening.folder_of(options, None)
        with writing(folder.path, DeviceError):
            _do(step, folder, None, options, Progress())
    else:
        fresh = step == "characterise" and options.session is None
        with opening.opened(options, fresh) as (folder, rig, progress):
            _do_all([step], folder, rig, options, progress)
    return _concluded(folder, options)


def _do_all(
    todo: list[str], folder: SessionFolder, rig: HoldRig, options: TuneOptions, progress: Progress
) -> None:
    for number, step in enumerate(todo):
        if step in _OF_GAINS and folder.config.estimator.process_value != "laser":
            told = _NO_GAINS.format(folder.path)
            if todo == [step]:
                raise RejectedError(f"{step}: {told}")
            progress.say(told)
            return
        if step == "apply" and not choice.chosen(
            folder, rig, options.yes, options.choose, progress
        ):
            progress.say(
                f"nothing is applied; `membrane-ctrl tune apply --session {folder.path}` "
                "applies a candidate later"
            )
            return
        _begin(progress, options, step, todo[number + 1 :])
        _do(step, folder, rig, options, progress)


def map_pump(options: TuneOptions) -> int:
    """Measure the pump's curve and apply it; the session begins anew on it."""
    with opening.opened(options) as (folder, rig, progress):
        folder = _map_pump(folder, rig, options.limit_um, progress)
    return _concluded(folder, options)


def _map_pump(
    folder: SessionFolder, rig: HoldRig, limit_um: float, progress: Progress
) -> SessionFolder:
    progress.begin("pump", PUMP_TYPICAL_S, 0.0)
    mapped, folder = pump_trial.map_pump(folder, rig, limit_um)
    found, pump = mapped.found, mapped.found.pump
    progress.say(
        f"pump: {len(pump.curve_fraction)} points from {pump.curve_um_per_s[0]:.2f} µm/s at "
        f"{pump.curve_fraction[0]:.3f} to {pump.flow_full_um_per_s:.2f} µm/s at "
        f"{pump.curve_fraction[-1]:.3f}, "
        f"known to {max(found.sigma_um_per_s[1:]):.2f} "
        f"µm/s{'' if found.known else ' (the time is over)'}; "
        f"starts at {pump.start_fraction:.3f}, stalls at {pump.stall_fraction:.3f}"
        f"{', with hysteresis' if pump.curve_falling_um_per_s else ''}; answers after "
        f"{found.delay_s:.2f} s "
        f"with a lag of {found.lag_s:.2f} s; leak {found.leak_um_per_s:.2f} µm/s"
    )
    progress.say(
        f"pump: steps of the flow on this curve give k {mapped.gain:.2f} +- "
        f"{mapped.gain_sigma:.2f}; curve and gains "
        f"({_gains_words(rig.loop)}) stay until the hold ends; `membrane-ctrl tune save "
        f"{folder.path} --config FILE` "
        "saves them for the next one"
    )
    if found.leak_um_per_s < TOO_TIGHT_UM_PER_S:
        progress.say(_TOO_TIGHT)
    return folder


def outer(options: TuneOptions) -> int:
    """Measure sag sensitivity, noise and drift of the figure; try the shape loop's time constant
    that follows.
    """
    from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
    from tuning.identification import shape_loop

    assumed = zernike_projection()
    again = "run `membrane-ctrl tune outer` again"
    with opening.opened(options, again=again, refusal=_without_laser) as (folder, rig, progress):
        before_s = folder.config.shape.time_constant_s
        progress.begin("shape loop", shape_loop.TYPICAL_S + options.observe_s, options.verify_s)
        rig.hold(options.observe_s)
        steady = [shape for shape in rig.shapes if shape.verdict != "rejected"]
        levels = shape_loop.step_experiment(rig)
        try:
            found = shape_loop.evaluate(levels, steady, assumed)
        except ValueError as error:
            raise RejectedError(f"shape loop: {error}") from None
        plain.write(folder.file("outer.json"), found)
        progress.say(
            f"optical sag per µm of the laser {found.scale:.3f}, noise {found.sigma_um:.2f} "
            "µm per cycle of "
            f"{found.cycle_s:.1f} s, drift {'' if found.drift_seen else 'below '}"
            f"{found.drift_um_per_sqrt_h:.2f} µm/sqrt(h): shape.time_constant_s = "
            f"{found.time_constant_s:.0f}"
        )
        if not _to_be_tried(
            shape_loop.unfit(found), found.time_constant_s, before_s, options, progress
        ):
            return _concluded(folder, options)
        progress.begin("trial of the time constant", options.verify_s, 0.0)
        earlier = [*steady, *(shape for level in levels for shape in level)]
        times_s = (before_s, found.time_constant_s)
        done = shape_loop.trial(rig, times_s, earlier, assumed, options.verify_s)
        what: gains_file.What = "taken_back" if done.reason else "kept"
        told_of = (
            folder.path.name,
            options.author,
            done.reason or options.reason,
            rig.loop,
            rig.loop,
            None,
            times_s,
        )
        gains_file.note(options.logs, gains_file.entry(what, *told_of))
        plain.write(folder.file("outer_verified.json"), done)
        progress.say(
            f"taken back: {done.reason}"
            if done.reason
            else f"kept until the hold ends: the next shape is predicted to {done.error_um:.2f} "
            "µm (before "
            f"{done.error_before_um:.2f} µm); `membrane-ctrl tune save --config FILE` saves "
            "it for the next one"
        )
    code = _concluded(folder, options)
    return Exit.REJECTED if done.reason else code


def _without_laser(config: Config) -> str:
    if not config.by_optics:
        return ""
    return (
        "the shape loop has nothing to follow: the figure itself is held (estimator.process_value)"
    )


def _to_be_tried(
    unfit: str, after_s: float, before_s: float, options: TuneOptions, progress: Progress
) -> bool:
    """Whether a time constant goes on trial: if it makes a difference, and a person or `--yes`
    wants it.
    """
    if unfit:
        raise RejectedError(f"shape loop: {unfit}")
    if abs(after_s / before_s - 1) < 0.1:
        progress.say(f"the present time constant, {before_s:.0f} s, fits")
        return False
    asked = not options.yes and sys.stdin.isatty()
    answer = progress.ask(f"try it instead of {before_s:.0f} s? [y/N]", ("yes",)) if asked else ""
    return options.yes or answer.lower() in ("y", "yes")


def watch(options: TuneOptions) -> int:
    """Observe a hold and report whether a session is due (exit 3)."""
    from tuning.proposal.verify import health

    folder = opening.folder_of(options, None)
    folder.require("design")
    made = gains_file.load_gains(folder.file("gains.toml"))
    with opening.linked(options) as link:
        progress = Progress()
        rig = HoldRig(link, options.author, progress)
        progress.begin("watch", options.observe_s, 0.0)
        try:
            found = health(*rig.hold_about(options.observe_s), rig.loop, made)
        except HoldError as error:
            raise DeviceError(str(error)) from None
        except ValueError as error:
            raise InputError(f"watch: {error}") from None
    if options.json:
        print(json.dumps(plain.plain(found)))
    progress.say(
        f"std {found.std_um:.3f} µm, {found.ratio:.2f} of the lower bound "
        f"({found.ratio_designed:.2f} expected); "
        f"k {found.gain:.2f} +- {found.gain_sigma:.2f}; leak {found.leak_um_per_s:.2f} µm/s"
    )
    for suggestion in found.suggestions:
        progress.say(f"a tuning session is due: {suggestion}")
    return Exit.REJECTED if found.suggestions else Exit.DONE


def rollback(options: TuneOptions) -> int:
    """Restore the gains from before the last kept session."""
    kept = gains_file.to_roll_back(options.logs)
    progress = Progress()
    with opening.linked(options) as link:
        rig = HoldRig(link, options.author, progress)
        try:
            shape_s = kept.shape_s[0] if kept.shape_s else math.nan
            loop = gains_file.for_hold(kept.before, rig.loop)
            rig.set_gains(
                loop, f"rollback of {kept.session}: {options.reason}"[:250], shape_s=shape_s
            )
        except HoldError as error:
            raise DeviceError(str(error)) from None
    told_of = (
        kept.session,
        options.author,
        options.reason,
        kept.before,
        kept.after,
        None,
        kept.shape_s,
    )
    told = gains_file.entry("rolled_back", *told_of)
    gains_file.note(options.logs, told)
    progress.say(
        (
            f"back to the gains before {kept.session}: K {kept.before.kp_per_s:g} 1/s, Ti "
            f"{kept.before.ti_s:g} s"
        )
        + (f", time constant of the shape loop {kept.shape_s[0]:.0f} s" if kept.shape_s else "")
    )
    for saved in {line.reason for line in gains_file.entries(options.logs) if line.what == "saved"}:
        progress.say(f"{saved} was saved with gains of a session: check its [loop]")
    return Exit.DONE


def _do(
    step: str, folder: SessionFolder, rig: HoldRig | None, options: TuneOptions, progress: Progress
) -> None:
    """Run one step and report its result in one line."""

    def told(stage: Stage) -> None:
        progress.say(
            f"  after {stage.time_s:.0f} s: std {stage.std_um:.3f} µm, {stage.growth:.2f} of "
            "the previous gains"
        )

    moving: dict[str, Callable[[HoldRig], object]] = {
        "characterise": lambda r: session.characterise_step(
            folder, r, options.limit_um, options.plan
        ),
        "observe": lambda r: session.observe_step(folder, r, options.observe_s),
        "apply": lambda r: session.apply_step(folder, r),
        "verify": lambda r: _verify(folder, r, options, told),
    }
    if step in moving:
        assert rig is not None
        moving[step](rig)
    elif step == "identify":
        session.identify_step(folder)
    elif step == "design":
        session.design_step(folder, options.reason)
    else:
        session.preview_step(folder)
    report.write_report(folder)
    progress.say(f"{step}: {_in_a_line(step, folder)}")
    if step == "identify" and rig is not None and session.found_of(folder).quality.pump_unknown:
        raise session.PumpUnknownError("identify: the pump is not what it is taken for")


def _verify(
    folder: SessionFolder, rig: HoldRig, options: TuneOptions, told: Callable[[Stage], None]
) -> None:
    session.verify_step(folder, rig, told, options.stages)
    _note_verified(folder, options.logs, options.reason, again=True)


def _note_verified(folder: SessionFolder, logs: Path, why: str, again: bool = False) -> None:
    """Note the verification in the journal, unless it is there; `again` if it was repeated."""
    name = folder.path.name
    if not folder.done("verify"):
        return
    if not again and any(
        line.session == name and line.shape_s is None for line in gains_file.entries(logs)
    ):
        return
    done = session.verified_of(folder)
    what: gains_file.What = "kept" if done.kept else "taken_back"
    told_of = (name, folder.head.author, why if done.kept else done.reason, done.before, done.after)
    gains_file.note(logs, gains_file.entry(what, *told_of, session.traded(folder)))


def _in_a_line(step: str, folder: SessionFolder) -> str:
    match step:
        case "identify":
            found = session.found_of(folder)
            model, sigma = found.identified.model, found.identified.sigma
            reasons = "".join(f"; {reason}" for reason in found.quality.reasons)
            tight = f"; {_TOO_TIGHT}" if model.leak_um_per_s < TOO_TIGHT_UM_PER_S else ""
            return (
                f"k {model.gain:.3f} +- {sigma.gain:.3f}, delay {model.delay_s:.3f} +- "
                f"{sigma.delay_s:.3f} s "
                f"(dead time {model.dead_time_s:.3f} +- {sigma.dead_time_s:.3f} s), "
                f"leak {model.leak_um_per_s:.2f} µm/s: {found.quality.verdict}{reasons}{tight}"
            )
        case "observe":
            weather = session.disturbance_of(folder)
            what = "figure" if folder.config.by_optics else "laser"
            return (
                f"{what} noise {weather.laser_um:.2f} µm per reading; in weather like this "
                "the std of ten minutes "
                f"scatters by {weather.unsteady:.0%}"
            )
        case "design":
            gains = gains_file.load_gains(folder.file("gains.toml"))
            return (
                f"{_gains_words(gains.loop)}: {session.traded(folder)}; "
                f"{gains.predicted_std_um / gains.least_std_um:.2f} of the lower bound"
            )
        case "preview":
            shown = session.preview_of(folder)
            std, peak, recovery = (
                " -> ".join(
                    f"{fmean(getattr(p, name) for p in row):.{digits}f}"
                    for row in (shown.present, shown.proposed)
                )
                for name, digits in (("std_um", 3), ("load_peak_um", 2), ("recovery_s", 1))
            )
            return f"on the fitted twin std {std} µm, load peak {peak} µm, recovery {recovery} s"
        case "apply":
            loop = gains_file.load_gains(folder.file("gains.toml")).loop
            return f"{session.traded(folder).candidate} is on trial: {_gains_words(loop)}"
        case "verify":
            done = session.verified_of(folder)
            kept = (
                "kept until the hold ends; `membrane-ctrl tune save --config FILE` saves them "
                "for the next one"
            )
            return kept if done.kept else f"the previous gains are back: {done.reason}"
        case _:
            return "done"


def _gains_words(loop: LoopConfig) -> str:
    return (
        f"K {loop.kp_per_s:.3f} 1/s, Ti {loop.ti_s:.2f} s, filter {loop.measurement_filter_s:.2f} s"
    )


def _begin(progress: Progress, options: TuneOptions, step: str, after: list[str]) -> None:
    planned = {
        "characterise": options.plan.typical_s,
        "observe": 0.0 if options.short else options.observe_s,
        "verify": SETTLE_LEAST_S + options.verify_s,
    }
    progress.begin(step, planned.get(step, 0.0), sum(planned.get(later, 0.0) for later in after))


def _concluded(folder: SessionFolder, options: TuneOptions) -> int:
    if options.json:
        done = [step for step in STEPS if folder.done(step)]
        print(json.dumps({"session": str(folder.path), "done": done}))
    else:
        print(f"session: {folder.path}", file=sys.stderr)
    refused = folder.done("verify") and not session.verified_of(folder).kept
    return Exit.REJECTED if refused else Exit.DONE
