"""The `calibrate` command: one geometry, with its covariance, from capture sets at several
pressures.
"""

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from membrane_ctrl.calibration.geometry_writer import write_geometry
from membrane_ctrl.calibration.report import calibration_report, format_report
from membrane_ctrl.calibration.residual_picture import draw_residuals
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.geometry import file, prior_file, set_tables, spread_file
from membrane_ctrl.measure.capture_set import CaptureSet, read_head, read_set
from membrane_ctrl.measure.measurement import Figures, SetFigure, stack_of
from membrane_ctrl.metrology.calibration import rim_edges, screen_pose, set_state, verdict
from membrane_ctrl.metrology.calibration.film_waves import solve_any_film
from membrane_ctrl.metrology.calibration.rim_edges import RADIUS_SIGMA_MM
from membrane_ctrl.metrology.calibration.rim_equations import Rim
from membrane_ctrl.metrology.calibration.solver import Problem
from membrane_ctrl.metrology.figure.bin_figure import bin_figure
from membrane_ctrl.metrology.figure.set_motion import FilmMotion
from membrane_ctrl.metrology.frame_checks import bin_view
from membrane_ctrl.metrology.frame_checks.bin_orders import absolute_phases
from membrane_ctrl.metrology.frame_checks.checked_set import Checked
from membrane_ctrl.metrology.phase import phase_steps, screen_scale
from membrane_ctrl.metrology.phase.frame_stack import bin_frames
from membrane_ctrl.metrology.rays import set_phases
from membrane_ctrl.metrology.rays.bench_parameters import LASER, NAMES, prior_sigmas, usual_sigma
from membrane_ctrl.metrology.rays.geometry import Geometry
from membrane_ctrl.metrology.reconstruction.bin_grid import BinGrid
from membrane_ctrl.metrology.reconstruction.slope_noise import pixel_sigma_adu
from membrane_ctrl.model import errors, terminal
from membrane_ctrl.model.arrays import FloatArray

# A capture set's bins as screen points with their noise, for the calibration.

_NO_FILM = (
    "an artefact, as all sets are: a calibration needs a set of the film, whose figure it is for"
)
_SAME_FILM_UM = 20.0  # apart: a film's change of figure is then known to a tenth of a micrometre
_MOTION_UNSEEN_UM = 100.0  # without a laser; the fringes find it to some micrometres


def phases_of(name: str, checked: Checked, optics: OpticsConfig) -> set_phases.SetPhases:
    """The bins within the analysis radius that the set's own fit kept, corrected for the film's
    motion.

    The stated geometry only chooses the bins and corrects the averaging of a curved phase over a
    bin (some 1e-3 mm, which no calibration changes).
    """
    film = FilmMotion.of(checked)
    x_um, y_um = film.told_um
    # what the film moved from x to y is left to the solution: the stated lens makes of it 2 % too
    # much or too little
    figure = bin_figure(
        optics, checked, replace(film, told_um=(x_um - x_um.mean(), y_um - y_um.mean()))
    )
    grid = BinGrid(checked.tracer.geometry, optics.camera, checked.binned.bin_px)
    return set_phases.SetPhases(
        name=name,
        column_px=grid.column_px[figure.index],
        row_px=grid.row_px[figure.index],
        screen_mm=figure.points.screen_mm,
        sigma_mm=np.sqrt(np.mean(np.square(figure.sigma_mm), axis=0)),
        displacement_um=checked.stack.mean_reading_um,
        motion_um=float(x_um.mean() - y_um.mean()),
        motion_sigma_um=film.x_to_y_sigma_um
        if math.isfinite(film.x_to_y_sigma_um)
        else _MOTION_UNSEEN_UM,
        moved_um=film.moved_um,
        period_mm=optics.pattern.period_mm,
    )


def edges_of(figure: SetFigure) -> FloatArray | None:
    """Edges of the light at the rim (2, n) in a full set; None where they are not seen."""
    stack, names = figure.checked.stack, [pattern.name for pattern in figure.head.patterns]
    bad = {flag.frame for flag in figure.checked.flags} | set(stack.unusable)
    if not {"white", "black"} <= {name for k, name in enumerate(names) if k not in bad}:
        return None
    white, black = (stack.frames[names.index(name)].astype(float) for name in ("white", "black"))
    rim_z_mm = figure.checked.tracer.vertex_z_mm + figure.figure.fit.surface.sag_mm
    radius_mm = figure.head.optics.mirror.radius_mm
    return rim_edges.find_edges(white - black, figure.checked.tracer.geometry, radius_mm, rim_z_mm)


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of the command.

    Attributes
    ----------
    folders : Sequence[Path]
        Capture sets.
    geometry : Path, optional
        Geometry measured by hand, replacing the sets'.
    out : Path
        The new `geometry.toml`.
    free : Sequence[str]
        Free parameters, each as NAME or NAME=SIGMA.
    laser_sigma_um : float
        Standard uncertainty of a set's mean reading.
    as_json : bool
    pictures : bool
        Draw the residuals of the screen points next to the geometry.
    reference_um : float, optional
        Laser reading at which the manual measurements hold, if the sets do not state it; None: the
        first set's.
    priors : Sequence[Path]
        Results of auxiliary calibrations; the last one wins.
    film : set_state.FilmModel
    radius_sigma_mm : float
        Standard uncertainty of the radius of the ring, whose edge is seen.
    """

    folders: Sequence[Path]
    geometry: Path | None
    out: Path
    free: Sequence[str]
    laser_sigma_um: float
    as_json: bool
    pictures: bool = True
    reference_um: float | None = None
    priors: Sequence[Path] = ()
    film: set_state.FilmModel = "free"
    radius_sigma_mm: float = RADIUS_SIGMA_MM


@dataclass(frozen=True)
class Bundle:
    """The sets read: their phases, the bench that all of them state,
    and defects of single frames.
    """

    sets: tuple[set_phases.SetPhases, ...]
    optics: OpticsConfig
    reference_um: float
    notes: tuple[str, ...] = ()
    apart: str = ""  # why the sets may be of different benches, though each states the same
    edges_px: tuple[FloatArray, ...] = ()  # of the rim, in the sets that show it


def _judge_sets(
    findings: Sequence[verdict.CalibrationFinding], bundle: Bundle
) -> tuple[verdict.CalibrationFinding, ...]:
    """The findings with the notes; a refusal of sets that may be of different benches says so
    first.
    """
    notes = bundle.notes
    if bundle.apart and any(finding.fatal for finding in findings):
        doubt = f"{bundle.apart}; if it was not: "
        findings = [
            replace(each, says=doubt + each.says) if each.fatal else each for each in findings
        ]
    elif bundle.apart:
        notes = (bundle.apart, *notes)
    return (*findings, *(verdict.CalibrationFinding(False, note) for note in notes))


def calibrate_command(options: CalibrateOptions) -> int:
    """Read, solve, judge, write. Returns the exit code; raises CommandError for invalid sets."""
    priors = [prior_file.read_prior(path) for path in options.priors]
    free = {
        name: sigma for prior in priors for name, sigma in prior.content.sigmas.items()
    } | parse_freed(options.free)
    begin = time.perf_counter()
    bundle = with_priors(read_sets(options.folders, options.geometry, options.reference_um), priors)
    read = time.perf_counter()
    problem = problem_of(bundle, free, options)
    findings, solution = verdict.check_before_solving(problem), None
    if not findings:
        try:
            solution, judged = solve_any_film(problem, _make_progress_line())
            findings = _judge_sets(judged, bundle)
        except ValueError as error:
            findings = (verdict.CalibrationFinding(True, str(error)),)
    timing = {"read": read - begin, "solve": time.perf_counter() - read}
    usable = solution is not None and not any(finding.fatal for finding in findings)
    written = (
        write_geometry(options.out, solution, problem, bundle.optics, findings)
        if usable and solution is not None
        else ""
    )
    if solution is not None and options.pictures:
        path = options.out.with_name(f"{options.out.stem}-residuals.png")
        with errors.convert_write_errors(path):  # also for a refused solution, where it helps most
            path.parent.mkdir(parents=True, exist_ok=True)
            draw_residuals(path, solution)
    report = calibration_report(solution, findings, bundle.optics.mirror.analysis_radius_mm)
    report |= {
        "out": str(options.out) if usable else None,
        "hash": written or None,
        "timing_s": timing,
    }
    print(json.dumps(report) if options.as_json else "\n".join(format_report(report)))
    if not usable:
        print(
            f"calibrate: rejected; {options.out} is not written, the old geometry stays in force",
            file=sys.stderr,
        )
    return errors.Exit.DONE if usable else errors.Exit.REJECTED


def parse_freed(texts: Sequence[str]) -> dict[str, float]:
    """`--free NAME[=SIGMA]` as sigmas. Raises InputError."""
    out = {}
    for text in texts:
        name, _, amount = text.partition("=")
        if name not in NAMES:
            raise errors.InputError(
                f"--free {text}: {name} is not a parameter; known: {', '.join(NAMES)}"
            )
        try:
            out[name] = float(amount) if amount else usual_sigma(name)
        except ValueError:
            raise errors.InputError(f"--free {text}: {amount} is not a number") from None
        if not (math.isfinite(out[name]) and out[name] > 0):
            raise errors.InputError(
                f"--free {text}: a sigma must be above 0, as nothing is exact: state how "
                f"well {name} is known, "
                "or omit it, and the data sheet's sigma applies"
            )
    return out


def read_sets(
    folders: Sequence[Path], geometry: Path | None, reference_um: float | None = None
) -> Bundle:
    """Read capture sets and their phases.

    Raises InputError for an invalid set or one whose rig differs from that of the first;
    RejectedError for a set without a figure.
    """
    stated = None if geometry is None else file.read_geometry(geometry)
    figures = Figures(stated)
    if len(set(folders)) < len(folders):
        raise errors.InputError(
            f"{next(f for f in folders if list(folders).count(f) > 1)}: given twice"
        )
    sets: list[set_phases.SetPhases] = []
    benches: list[OpticsConfig] = []
    used: list[Path] = []
    elsewhere: list[tuple[Path, set_phases.SetPhases, set_tables.ScreenMovedTable]] = []
    notes: list[str] = []
    edges: list[FloatArray] = []
    heads = {folder: read_head(folder, stated) for folder in folders}
    # those with the screen in its place first: the others belong to them
    for folder in terminal.track_progress(
        sorted(folders, key=lambda each: heads[each].screen_moved is not None), "sets"
    ):
        head = heads[folder]
        if head.artefact == "screen":
            phases = phases_of_screen(read_set(folder, stated))
        else:
            figure = figures.measure_folder(folder)
            head = figure.head
            phases = replace(
                phases_of(folder.name, figure.checked, head.optics), artefact=figure.artefact
            )
            notes += [
                f"{folder.name}: {head.files[f.frame]} omitted: {f.reason}"
                for f in figure.checked.flags
            ]
            if head.artefact is None and (seen := edges_of(figure)) is not None:
                edges.append(seen)
        bench = head.optics.model_copy(update={"geometry": head.before_move})
        if head.screen_moved is not None:
            if used:
                _same_rig(used[0], benches[0], folder, bench, films=False)
            elsewhere.append((folder, phases, head.screen_moved))
            continue
        sets.append(phases)
        benches.append(bench)
        used.append(folder)
        first = next((k for k, phases in enumerate(sets) if phases.artefact is None), 0)
        _same_rig(used[first], benches[first], folder, bench, sets[first].artefact is head.artefact)
    for each in elsewhere:
        join_moved_screen(sets, *each)
    films = [k for k, phases in enumerate(sets) if phases.artefact is None]
    if not films:
        raise errors.InputError(f"{folders[0]}: {_NO_FILM}")
    named = sorted({benches[k].geometry.reference_displacement_um or 0.0 for k in films})
    apart = ""
    if reference_um is None and len(named) > 1:
        apart = (
            f"the sets state reference_displacement_um from {named[0]:.0f} to "
            f"{named[-1]:.0f} µm; the first set's is "
            "used: if the geometry was measured anew for each set, they are not of one bench"
        )
    reference_um = _reference_um(
        [sets[k] for k in films], [benches[k] for k in films], reference_um
    )
    if not any(math.isfinite(sets[k].displacement_um) for k in films):
        # no laser: the world's origin is the vertex of the first set
        sets[films[0]] = replace(sets[films[0]], displacement_um=reference_um)
    if not edges:
        notes.append("the rim is not seen in any full set: its size is not used")
    return Bundle(tuple(sets), benches[films[0]], reference_um, tuple(notes), apart, tuple(edges))


def phases_of_screen(capture: CaptureSet) -> set_phases.SetPhases:
    """The bins that see the screen itself. Raises RejectedError if they show none."""
    head, stack = capture.head, stack_of(capture)
    binned = bin_frames(stack, 2**head.optics.camera.bits - 1)
    pattern, geometry = head.optics.pattern, Geometry.from_config(head.optics)
    try:
        view = bin_view.combine_frames(stack, binned, set(stack.unusable))
        phase_rad = absolute_phases(stack, binned, view, pattern)
        index = np.flatnonzero(np.isfinite(phase_rad).all(axis=0))
        grid, screen_mm = (
            BinGrid(geometry, head.optics.camera, binned.bin_px),
            screen_scale.screen_mm(phase_rad, pattern),
        )
        place = grid.column_px[index], grid.row_px[index], screen_mm.reshape(2, -1)[:, index]
        screen = screen_pose.screen_seen(geometry, *place)
    except (ValueError, bin_view.NoFigureError) as error:
        raise errors.RejectedError(f"{head.folder}: rejected: {error}") from None
    noise = pixel_sigma_adu(head.optics.camera.noise_adu) / binned.bin_px
    shares = [phase_steps.phase_sigma_rad(stack.shifts_rad(used), noise, 1.0) for used in view.used]
    swing = view.swing_adu.reshape(2, -1)[:, index]
    sigma_mm = (
        screen_scale.mm_per_rad(pattern)
        * np.hypot(*(np.array(shares)[:, None] / swing))
        / math.sqrt(2)
    )
    name, where = head.folder.name, (set_phases.ANYWHERE,)
    known: dict[str, Any] = {"artefact": screen, "elsewhere": where, "period_mm": pattern.period_mm}
    return set_phases.SetPhases(name, *place, sigma_mm, math.nan, **known)


def join_moved_screen(
    sets: list[set_phases.SetPhases],
    folder: Path,
    phases: set_phases.SetPhases,
    moved: set_tables.ScreenMovedTable,
) -> None:
    """Add what was seen with the screen elsewhere to the set of the same film. Raises InputError if
    there is none.
    """
    films = [k for k, each in enumerate(sets) if each.artefact is None and phases.artefact is None]
    apart_um = [abs(phases.displacement_um - sets[k].displacement_um) for k in films]
    if not any(apart <= _SAME_FILM_UM for apart in apart_um):
        raise errors.InputError(
            f"{folder / 'capture.toml'}: screen_moved: needs a set of the film with the "
            "screen in its place, "
            f"the laser's readings within {_SAME_FILM_UM:.0f} µm"
        )
    k = films[int(np.nanargmin(apart_um))]
    base, deeper_um = sets[k], phases.displacement_um - sets[k].displacement_um
    known = set_phases.Elsewhere(
        moved.shift_mm,
        moved.shift_sigma_mm,
        moved.turn_sigma_deg,
        deeper_um,
        phases.motion_um,
        phases.motion_sigma_um,
    )
    sets[k] = base.beside(phases, known)


def with_priors(bundle: Bundle, priors: Sequence[prior_file.Prior]) -> Bundle:
    """The sets with the bench as found by auxiliary calibrations. Raises InputError for a different
    camera.
    """
    optics = bundle.optics
    for prior in priors:
        optics = prior.apply_to_optics(optics)
    return replace(bundle, optics=optics)


def _reference_um(
    sets: Sequence[set_phases.SetPhases], benches: Sequence[OpticsConfig], known_um: float | None
) -> float:
    """Reading at which the vertex is the world's origin: as all sets state, else as given, else the
    first one.

    A set that states none uses its own first reading: then the sets differ.
    """
    stated = {bench.geometry.reference_displacement_um for bench in benches}
    if len(stated) == 1 and (reference_um := stated.pop()) is not None:
        return reference_um
    if known_um is not None:
        return known_um
    return next(
        (phases.displacement_um for phases in sets if math.isfinite(phases.displacement_um)), 0.0
    )


def _same_rig(
    first: Path, optics: OpticsConfig, folder: Path, other: OpticsConfig, films: bool
) -> None:
    """Raises InputError for a set of another bench; an artefact has
    another size than the mirror.
    """
    for section in ("camera", "pattern", "geometry", *(("mirror",) if films else ())):
        ours, theirs = getattr(optics, section), getattr(other, section)
        for field in type(ours).model_fields:
            if field in ("reference_displacement_um", "steps", "noise_adu"):
                continue
            if getattr(ours, field) != getattr(theirs, field):
                raise errors.InputError(
                    f"{folder / 'capture.toml'}: {section}.{field}: differs from {first}; "
                    "a calibration needs sets of one rig"
                )


def known_sigmas(optics: OpticsConfig, free: Mapping[str, float]) -> dict[str, float]:
    """How well poses, lens, screen and laser are known: as freed, else as stated, else by rulers
    and data sheets.

    Nothing is exact: a stated 0 counts as unstated. A focal length that is held and off by 0.1 %
    puts the sag off by 34 µm, which the residuals hardly show.
    """
    stated = optics.geometry
    given = {
        "a_mm": stated.a_sigma_mm,
        "b_mm": stated.b_sigma_mm,
        "alpha_deg": stated.alpha_sigma_deg,
    }
    if stated.sigmas is not None:
        given[LASER.name] = stated.sigmas.laser_relative
    unstated = optics.model_copy(update={"geometry": stated.model_copy(update={"sigmas": None})})
    usual = spread_file.stated_sigmas(unstated) | {
        name: usual_sigma(name) for name in (*given, LASER.name)
    }
    return usual | {
        name: s for name, s in {**spread_file.stated_sigmas(optics), **given, **free}.items() if s
    }


def problem_of(bundle: Bundle, free: dict[str, float], options: CalibrateOptions) -> Problem:
    """The stated bench with its sigmas. Raises InputError if the geometry cannot be calibrated."""
    known = known_sigmas(bundle.optics, free)
    try:
        geometry = Geometry.from_config(bundle.optics)
    except ValueError as error:
        raise errors.InputError(str(error)) from None
    references = set_state.References(
        bundle.reference_um, options.laser_sigma_um, film=options.film
    )
    radius_mm = bundle.optics.mirror.radius_mm
    if sum(math.isfinite(p.displacement_um) for p in bundle.sets if p.artefact is None) < 2:
        known[LASER.name] = 0.0  # no readings to scale
    rim = Rim.of(bundle.edges_px, radius_mm, options.radius_sigma_mm)
    return Problem(geometry, bundle.sets, prior_sigmas(known), references, radius_mm, rim)


def _make_progress_line() -> Any:
    """A line that counts, on a terminal only."""
    if not sys.stderr.isatty():
        return None
    return lambda count, change: print(f"step {count}: {change:.2g} sigma", file=sys.stderr)
