"""`tune outer`: measure the figure's response and try a time constant of the shape loop."""

import sys

from membrane_ctrl.config.schema import Config
from membrane_ctrl.model.errors import Exit, RejectedError
from membrane_ctrl.sessions import session_json
from membrane_ctrl.sessions.progress import Progress
from tuning import connection, journal
from tuning.commands.conclusion import conclude
from tuning.options import TuneOptions


def tune_shape_loop(options: TuneOptions) -> int:
    """Measure sag sensitivity, noise and drift of the figure; try the shape loop's time constant
    that follows.
    """
    from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
    from tuning.identification import shape_loop_fit, shape_loop_trial

    assumed = zernike_projection()
    again = "run `membrane-ctrl tune outer` again"
    with connection.open_on_hold(options, again=again, refusal=_without_laser) as (
        folder,
        rig,
        progress,
    ):
        before_s = folder.config.shape.time_constant_s
        # Noise and drift of the figure come from a quiet hold, the sag per µm of the laser from
        # steps of the setpoint.
        progress.begin_step(
            "shape loop", shape_loop_fit.TYPICAL_S + options.observe_s, options.verify_s
        )
        rig.hold(options.observe_s)
        steady = [shape for shape in rig.shapes if shape.verdict != "rejected"]
        levels = shape_loop_fit.run_step_experiment(rig)
        try:
            found = shape_loop_fit.fit_shape_loop(levels, steady, assumed)
        except ValueError as error:
            raise RejectedError(f"shape loop: {error}") from None
        session_json.write_session_file(folder.file_path("outer.json"), found)
        progress.print_line(
            f"optical sag per µm of the laser {found.scale:.3f}, noise {found.sigma_um:.2f} µm per "
            f"cycle of {found.cycle_s:.1f} s, drift "
            f"{'' if found.drift_seen else 'below '}{found.drift_um_per_sqrt_h:.2f} µm/sqrt(h): "
            f"shape.time_constant_s = {found.time_constant_s:.0f}"
        )
        # Nothing to try if the fit is too poor, or the present time constant is as good.
        if not _to_be_tried(
            shape_loop_fit.find_unfit_reason(found),
            found.time_constant_s,
            before_s,
            options,
            progress,
        ):
            return conclude(folder, options)
        # The trial predicts each next shape with both time constants, and takes the new one back if
        # it is worse.
        progress.begin_step("trial of the time constant", options.verify_s, 0.0)
        earlier = [*steady, *(shape for level in levels for shape in level)]
        times_s = (before_s, found.time_constant_s)
        done = shape_loop_trial.try_time_constant(rig, times_s, earlier, assumed, options.verify_s)
        # Keep a record of it: in the journal of the sessions, and in the folder of this one.
        what: journal.What = "taken_back" if done.reason else "kept"
        entry_values = (
            folder.path.name,
            options.author,
            done.reason or options.reason,
            rig.loop,
            rig.loop,
            None,
            times_s,
        )
        journal.append_entry(options.logs, journal.make_entry(what, *entry_values))
        session_json.write_session_file(folder.file_path("outer_verified.json"), done)
        if done.reason:
            progress.print_line(f"taken back: {done.reason}")
        else:
            progress.print_line(
                f"kept until the hold ends: the next shape is predicted to {done.error_um:.2f} µm "
                f"(before {done.error_before_um:.2f} µm); `membrane-ctrl tune save --config FILE` "
                "saves it for the next one"
            )
    code = conclude(folder, options)
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
        progress.print_line(f"the present time constant, {before_s:.0f} s, fits")
        return False
    if options.yes:
        return True
    if not sys.stdin.isatty():
        return False
    answer = progress.ask_question(f"try it instead of {before_s:.0f} s? [y/N]", ("yes",))
    return answer.lower() in ("y", "yes")
