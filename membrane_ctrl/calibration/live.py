"""`calibrate --live`: takes sets at several setpoints of a running hold, solves and adopts them.

The plan is confirmed by a person before the mirror moves, and so is the new geometry before it
replaces the old one.
"""

import contextlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from membrane_ctrl.calibration import session as sessions
from membrane_ctrl.calibration.adopt import adopt_geometry
from membrane_ctrl.calibration.calibrate import calibrate_command
from membrane_ctrl.calibration.calibrate_options import CalibrateOptions, parse_freed
from membrane_ctrl.calibration.compare_geometries import compare_geometries
from membrane_ctrl.calibration.procedure import Procedure
from membrane_ctrl.calibration.session import CalibrationHead, CalibrationSession
from membrane_ctrl.calibration.setpoints import HeldMirror, plan_setpoints_um, setpoint_reach
from membrane_ctrl.calibration.stated_problem import known_sigmas
from membrane_ctrl.calibration.sweep import CaptureLink, Sweep
from membrane_ctrl.config.schema import CameraConfig, GeometryConfig, OpticsConfig
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.geometry.file import GeometryOrigin, read_geometry, stated_origin
from membrane_ctrl.geometry.prior_file import read_prior
from membrane_ctrl.geometry.run_geometry import read_run_geometry
from membrane_ctrl.measure.capture_set import read_head
from membrane_ctrl.metrology.calibration import figure_uncertainty, foresight, verdict
from membrane_ctrl.metrology.rays import bench_parameters
from membrane_ctrl.model.errors import DeviceError, Exit, InputError
from membrane_ctrl.sessions.folder import now_utc
from membrane_ctrl.sessions.live_hold import HoldError, live_hold
from membrane_ctrl.sessions.progress import Progress

USUAL_SETS = 5
_NEARLY_ALL = 0.9  # of the good range: more would hardly help


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Options of the command line; sets and output of `solving` are the session's."""

    where: Where
    session: Path | None
    name: str
    range_um: float | None
    sets: int | None
    yes: bool
    take_over: bool
    solving: CalibrateOptions


def calibrate_live(options: LiveOptions) -> int:
    """Take a session's missing sets, solve, and adopt the result if a person agrees.

    Returns
    -------
    int
        The exit code of the command.

    Raises
    ------
    InputError
        If the options do not fit one another, or no person agrees to move the mirror.
    """
    parse_freed(options.solving.free)  # check these before the mirror moves
    for path in options.solving.priors:
        read_prior(path)
    session = None
    if options.session is not None:
        if options.range_um is not None or options.sets is not None:
            raise InputError("--session has its own setpoints: omit --range-um and --sets")
        session = sessions.resume_session(options.session)
    if session is None or session.missing_indices:
        with live_hold(
            options.where,
            options.take_over,
            "calibrate --live",
            session=f"calibrate {options.name}",
        ) as link:
            session = take_sets(link, session, options)
    return solve_and_adopt(session, options)


def take_sets(
    link: CaptureLink, session: CalibrationSession | None, options: LiveOptions
) -> CalibrationSession:
    """Take the missing sets, if a person agrees, and move the mirror back.

    The session's folder keeps the sets that were taken before an error.

    Parameters
    ----------
    link : CaptureLink
        The running hold.
    session : CalibrationSession or None
        The session to continue; None begins a new one.
    options : LiveOptions
        Range and number of the sets, and whether to ask before the mirror moves.

    Raises
    ------
    InputError, DeviceError, RejectedError, KeyboardInterrupt
    """
    progress = Progress()
    sweep = Sweep(link, link.config.limits, progress)
    try:
        held = sweep.observe_hold()
        procedure = Procedure(link, sweep, held, progress)

        # Continue a session, or plan the setpoints of a new one.
        if session is not None:
            head, missing = session.head, session.missing_indices
            _check_same_bench(link, session)
        else:
            sets = options.sets or USUAL_SETS
            reach = setpoint_reach(held, link.config)
            setpoints_um = plan_setpoints_um(held, reach, options.range_um, sets)
            head = CalibrationHead(
                link.name, now_utc(), held.setpoint_um, held.shape_on, setpoints_um
            )
            missing = tuple(range(sets))

        # The plan, and the agreement of a person, before anything moves.
        procedure.check_setpoints(head)
        minutes = sum(procedure.times_s(head, missing)) / 60
        progress.print_line(_format_plan(head, len(missing), held, minutes))
        progress.print_line(_format_forecast(link, head, held, options))
        _require_agreement(f"move the mirror through {len(missing)} setpoints?", options.yes)

        # From here on the mirror moves.
        sweep.claim_command(held.setpoint_um)
        session = session or sessions.begin_session(
            options.where.logs, options.name, head, link.config
        )
        progress.print_line(f"session: {session.path}")
        procedure.take_sets(session)
    except HoldError as error:
        raise DeviceError(str(error)) from None
    return session


def solve_and_adopt(session: CalibrationSession, options: LiveOptions) -> int:
    """Solve a session's sets, and adopt the new geometry if a person agrees.

    Old and new geometry are printed before.

    Parameters
    ----------
    session : CalibrationSession
        All its sets are there.
    options : LiveOptions
        `solving` holds the options of the solver, except sets and result, which are the session's;
        `yes` adopts without asking.

    Returns
    -------
    int
        The exit code of the command: that of the solver, also if nothing is adopted.

    Raises
    ------
    CommandError
        The sets are refused, or a file cannot be written.
    """
    solving = replace(
        options.solving,
        folders=session.set_folders,
        out=session.geometry_path,
        reference_um=session.head.start_um,
    )
    code = calibrate_command(solving)
    if code != Exit.DONE:
        return code

    # Old and new geometry beside each other, for the person who decides.
    place = session.config.optics.geometry_file
    old = read_head(session.set_folders[0]).optics
    new = read_geometry(session.geometry_path)
    for line in compare_geometries(old, _set_origin(session, place), new):
        _print_progress(line)

    # Adopted only where the configuration has a place for it, and if the person agrees.
    if place is None:
        _print_progress(
            "not adopted: the configuration names no optics.geometry_file; the geometry is "
            f"{session.geometry_path}"
        )
    elif not _ask_person(f"adopt it as {place}?", options.yes):
        _print_progress(
            f"not adopted; `membrane-ctrl calibrate --live --session {session.path} --yes` "
            "adopts it"
        )
    else:
        kept = adopt_geometry(session.geometry_path, place)
        before = ""
        if kept:
            before = f"; the previous one is {kept}"
        _print_progress(f"adopted: {place}{before}; the next hold uses it")
    return code


def _check_same_bench(link: CaptureLink, session: CalibrationSession) -> None:
    """Raise InputError if the hold's geometry differs from that of the sets so far."""
    now = read_run_geometry(link.run_dir, link.config).optics
    for folder in session.set_folders:
        if not folder.exists():
            continue
        then = read_head(folder).optics
        if _geometry_and_camera(then) != _geometry_and_camera(now):
            raise InputError(
                f"{folder}: camera or geometry differs from that of {link.name}; start a new "
                "session"
            )


def _geometry_and_camera(optics: OpticsConfig) -> tuple[GeometryConfig, CameraConfig]:
    """The parts of a bench that two sets must share.

    The principal point is written out, since one file may omit it; the reference may differ.
    """
    camera = optics.camera.model_copy(update={"principal_px": optics.camera.principal})
    return optics.geometry.model_copy(update={"reference_displacement_um": None}), camera


def _format_plan(head: CalibrationHead, missing: int, held: HeldMirror, minutes: float) -> str:
    """Number of sets, range and duration, as a sentence."""
    low_um = min(head.setpoints_um)
    high_um = max(head.setpoints_um)
    return (
        f"{missing} of {len(head.setpoints_um)} sets from {low_um:g} to {high_um:g} µm (sag "
        f"{held.sag_at_mm(low_um):.1f} to {held.sag_at_mm(high_um):.1f} mm; now "
        f"{held.setpoint_um:g} µm, {held.pressure_pa:.0f} Pa, leak {held.leak_um_per_s:.1f} µm/s), "
        f"then back to {head.start_um:g} µm: about {minutes:.0f} min"
    )


def _format_forecast(
    link: CaptureLink, head: CalibrationHead, held: HeldMirror, options: LiveOptions
) -> str:
    """How well the sets will determine the geometry, and how much better a wider range would."""
    here = _forecast_figure(link, held, head.setpoints_um, options)
    line = (
        f"a figure after these sets: sag +- {here.sag_um:.1f} µm, figure +- "
        f"{here.figure_rms_um:.1f} µm RMS"
    )
    low_um = min(head.setpoints_um)
    high_um = max(head.setpoints_um)
    if high_um - low_um >= _NEARLY_ALL * verdict.GOOD_SPREAD_UM:
        return line

    # As many sets over the good range, with the same middle.
    wide_low_um = (low_um + high_um - verdict.GOOD_SPREAD_UM) / 2
    wide_high_um = (low_um + high_um + verdict.GOOD_SPREAD_UM) / 2
    wide_um = np.linspace(wide_low_um, wide_high_um, len(head.setpoints_um)).tolist()
    best = _forecast_figure(link, held, wide_um, options)
    reach = setpoint_reach(held, link.config)
    return (
        f"{line}; {verdict.GOOD_SPREAD_UM:.0f} µm of range would give {best.sag_um:.1f} and "
        f"{best.figure_rms_um:.1f} ({reach.low_why} and {reach.high_why} allow "
        f"{reach.high_um - reach.low_um:.0f})"
    )


def _forecast_figure(
    link: CaptureLink, held: HeldMirror, setpoints_um: Sequence[float], options: LiveOptions
) -> figure_uncertainty.Propagated:
    """Uncertainty of a figure that is measured with the geometry from sets at these setpoints.

    Raises InputError if the stated bench does not show the mirror.
    """
    optics = read_run_geometry(link.run_dir, link.config).optics
    solving = options.solving
    if solving.geometry is not None:
        optics = read_geometry(solving.geometry).apply_to_optics(optics)
    known = bench_parameters.prior_sigmas(known_sigmas(optics, parse_freed(solving.free)))
    sags_mm = [held.sag_at_mm(each) for each in sorted(setpoints_um)]
    try:
        return foresight.forecast_figure(
            optics, known, sags_mm, held.swing_adu, solving.laser_sigma_um
        )
    except ValueError as error:
        raise InputError(f"{link.name}: {error}; does [optics] describe this bench?") from None


def _set_origin(session: CalibrationSession, place: Path | None) -> GeometryOrigin:
    """Origin of the sets' geometry: the file at `place` if unchanged, else the numbers' hash."""
    optics = read_head(session.set_folders[0]).optics
    if place is not None and place.exists():
        with contextlib.suppress(InputError):  # a damaged file does no harm here
            file = read_geometry(place)
            if file.geometry == optics.geometry:
                return file.origin
    return stated_origin(optics)


def _require_agreement(question: str, yes: bool) -> None:
    """Raise InputError unless a person agrees, or `yes` was given on the command line."""
    if not yes and not sys.stdin.isatty():
        raise InputError(f"{question} Not a terminal: confirm with --yes")
    if not _ask_person(question, yes):
        raise InputError("nothing was moved")


def _ask_person(question: str, yes: bool) -> bool:
    """Whether `yes` was given, or a person at a terminal answers yes."""
    if yes:
        return True
    if not sys.stdin.isatty():
        return False
    print(f"{question} [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _print_progress(line: str) -> None:
    print(line, file=sys.stderr)
