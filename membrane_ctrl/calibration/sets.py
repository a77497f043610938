"""The capture sets of a calibration: read, checked to be of one bench, and joined."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from membrane_ctrl.calibration.set_points import edges_of, phases_of, phases_of_screen
from membrane_ctrl.config.schema import OpticsConfig
from membrane_ctrl.geometry import file, prior_file, set_tables
from membrane_ctrl.measure.capture_set import CaptureHead, read_head, read_set
from membrane_ctrl.measure.measurement import Figures, SetFigure
from membrane_ctrl.metrology.rays import set_phases
from membrane_ctrl.metrology.rays.moved_screen import MovedScreen
from membrane_ctrl.model import errors, terminal
from membrane_ctrl.model.arrays import FloatArray

_NO_FILM = (
    "an artefact, as all sets are: a calibration needs a set of the film, whose figure it is for"
)
_SAME_FILM_UM = 20.0  # apart: a film's change of figure is then known to a tenth of a micrometre


@dataclass(frozen=True)
class Bundle:
    """The capture sets of a calibration.

    Attributes
    ----------
    sets : tuple of SetPhases
        Their phases.
    optics : OpticsConfig
        The bench that all of them state.
    reference_um : float
        Laser reading at which the vertex is the origin.
    notes : tuple of str
        Defects of single frames, for people.
    bench_doubt : str
        Why the sets may be of different benches, though each states the same; else empty.
    edges_px : tuple of (2, n) arrays
        Edges of the rim, in the sets that show it.
    """

    sets: tuple[set_phases.SetPhases, ...]
    optics: OpticsConfig
    reference_um: float
    notes: tuple[str, ...] = ()
    bench_doubt: str = ""
    edges_px: tuple[FloatArray, ...] = ()


def read_sets(
    folders: Sequence[Path], geometry: Path | None, reference_um: float | None = None
) -> Bundle:
    """Read capture sets and their phases.

    Parameters
    ----------
    folders : sequence of Path
        The sets.
    geometry : Path or None
        Geometry measured by hand, instead of the sets'.
    reference_um : float, optional
        Laser reading at which the hand measurements hold, if the sets do not state it.

    Raises
    ------
    InputError
        For an invalid set, or one whose bench differs from that of the first.
    RejectedError
        For a set without a figure.
    """
    stated = None
    if geometry is not None:
        stated = file.read_geometry(geometry)
    figures = Figures(stated)
    repeated = [folder for folder, count in Counter(folders).items() if count > 1]
    if repeated:
        raise errors.InputError(f"{repeated[0]}: given twice")
    sets: list[set_phases.SetPhases] = []
    benches: list[OpticsConfig] = []
    used: list[Path] = []
    moved_screens: list[tuple[Path, set_phases.SetPhases, set_tables.ScreenMovedTable]] = []
    notes: list[str] = []
    edges: list[FloatArray] = []
    heads = {folder: read_head(folder, stated) for folder in folders}
    # Sets with the screen in its place come first: those with a moved screen are joined to them.
    ordered = sorted(folders, key=lambda folder: heads[folder].screen_moved is not None)
    for folder in terminal.track_progress(ordered, "sets"):
        # Its phases, and the rim that it shows.
        head = heads[folder]
        _refuse_turned_artefact(head)
        if head.artefact == "screen":
            phases = phases_of_screen(read_set(folder, stated))
        else:
            figure = figures.measure_folder(folder)
            head = figure.head
            phases = phases_of(folder.name, figure.checked, head.optics)
            phases = replace(phases, artefact=figure.artefact, turned=head.turned)
            notes += _list_omitted_frames(folder, figure)
            edges += _find_edges(figure)

        # Its bench, which must be that of the first set.
        bench = head.optics.model_copy(update={"geometry": head.before_move})
        if head.screen_moved is not None:
            if used:
                _same_rig(used[0], benches[0], folder, bench, films=False)
            moved_screens.append((folder, phases, head.screen_moved))
            continue
        sets.append(phases)
        benches.append(bench)
        used.append(folder)
        first = next((k for k, phases in enumerate(sets) if phases.artefact is None), 0)
        same_kind = sets[first].artefact is head.artefact
        _same_rig(used[first], benches[first], folder, bench, same_kind)
    for folder, phases, moved in moved_screens:
        join_moved_screen(sets, folder, phases, moved)
    films = [k for k, phases in enumerate(sets) if phases.artefact is None]
    if not films:
        raise errors.InputError(f"{folders[0]}: {_NO_FILM}")
    if all(sets[k].turned is not None for k in films):
        raise errors.InputError(
            f"{used[films[0]] / 'capture.toml'}: mirror_turned: all sets of the film have it; "
            "a calibration needs one of the mirror as it usually stands"
        )

    # The laser reading at the origin.
    film_sets = [sets[k] for k in films]
    film_benches = [benches[k] for k in films]
    bench_doubt = ""
    if reference_um is None:
        bench_doubt = _explain_other_references(film_benches)
    reference_um = _reference_um(film_sets, film_benches, reference_um)
    if not any(math.isfinite(phases.displacement_um) for phases in film_sets):
        # Without a laser, the origin is the vertex of the first set.
        sets[films[0]] = replace(sets[films[0]], displacement_um=reference_um)
    if not edges:
        notes.append("the rim is not seen in any full set: its size is not used")
    return Bundle(
        tuple(sets), benches[films[0]], reference_um, tuple(notes), bench_doubt, tuple(edges)
    )


def _list_omitted_frames(folder: Path, figure: SetFigure) -> list[str]:
    """Return a note for each frame of a set that is not used."""
    return [
        f"{folder.name}: {figure.head.files[flag.frame]} omitted: {flag.reason}"
        for flag in figure.checked.flags
    ]


def _find_edges(figure: SetFigure) -> list[FloatArray]:
    """Return the points of the rim in the picture of a set, if it shows the mirror as it usually
    stands; else nothing.
    """
    if figure.head.artefact is not None or figure.head.turned is not None:
        return []
    edges_px = edges_of(figure)
    return [] if edges_px is None else [edges_px]


def _explain_other_references(benches: Sequence[OpticsConfig]) -> str:
    """Return what is wrong if sets state different readings at the origin; empty if they do not."""
    stated_um = sorted({bench.geometry.reference_displacement_um or 0.0 for bench in benches})
    if len(stated_um) < 2:
        return ""
    return (
        f"the sets state reference_displacement_um from {stated_um[0]:.0f} to "
        f"{stated_um[-1]:.0f} µm; the first set's is used: if the geometry was measured again "
        "for each set, they are not of one bench"
    )


def _refuse_turned_artefact(head: CaptureHead) -> None:
    """Raise InputError for a set that shows no film, or a moved screen, and a turned mirror."""
    if head.turned is not None and (head.artefact is not None or head.screen_moved is not None):
        raise errors.InputError(
            f"{head.folder / 'capture.toml'}: mirror_turned: only of a film, with the screen in "
            "its place"
        )


def join_moved_screen(
    sets: list[set_phases.SetPhases],
    folder: Path,
    phases: set_phases.SetPhases,
    moved: set_tables.ScreenMovedTable,
) -> None:
    """Join a set with a moved screen to that of the same film with the screen in its place.

    Parameters
    ----------
    sets : list of SetPhases
        The sets with the screen in its place; one of them is replaced.
    folder : Path
        Folder of the set with the moved screen.
    phases : SetPhases
        Its phases.
    moved : ScreenMovedTable
        The stated move.

    Raises
    ------
    InputError
        If no set of the film has a laser reading near enough.
    """
    # The set of the film whose laser reading is nearest.
    films = [k for k, each in enumerate(sets) if each.artefact is None and phases.artefact is None]
    differences_um = [abs(phases.displacement_um - sets[k].displacement_um) for k in films]
    if not any(difference_um <= _SAME_FILM_UM for difference_um in differences_um):
        raise errors.InputError(
            f"{folder / 'capture.toml'}: screen_moved: needs a set of the film with the "
            f"screen in its place, the laser's readings within {_SAME_FILM_UM:.0f} µm"
        )
    nearest = films[int(np.nanargmin(differences_um))]
    base = sets[nearest]

    # The move of the screen as stated, and by how much the film was deeper in the second set: the
    # solution corrects the difference of the two figures by it.
    known = MovedScreen(
        moved.shift_mm,
        moved.shift_sigma_mm,
        moved.turn_sigma_deg,
        phases.displacement_um - base.displacement_um,
        phases.motion_um,
        phases.motion_sigma_um,
    )
    sets[nearest] = base.add_screen_place(phases, known)


def with_priors(bundle: Bundle, priors: Sequence[prior_file.Prior]) -> Bundle:
    """The sets with the bench as found by auxiliary calibrations.

    Parameters
    ----------
    bundle : Bundle
        The sets with the bench that they state.
    priors : sequence of Prior
        Results of `calibrate-camera` or `calibrate-pose`; of two that give the same value, the last
        one counts.

    Raises
    ------
    InputError
        A prior is of a different camera.
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
    sections = ["camera", "pattern", "geometry"]
    if films:
        sections.append("mirror")
    for section in sections:
        ours = getattr(optics, section)
        theirs = getattr(other, section)
        for field in type(ours).model_fields:
            if field in ("reference_displacement_um", "steps", "noise_adu"):
                continue
            if getattr(ours, field) != getattr(theirs, field):
                raise errors.InputError(
                    f"{folder / 'capture.toml'}: {section}.{field}: differs from {first}; a "
                    "calibration needs sets of one rig"
                )
