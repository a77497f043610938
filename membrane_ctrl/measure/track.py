"""The `track` command: the figure of every frame of a crossed pattern
(docs/reference/interfaces.md, section 3b).
"""

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from firmware_iface.settings import Section
from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.config.origin import OriginSection
from membrane_ctrl.geometry.file import GeometryFile, read_geometry
from membrane_ctrl.measure.capture_set import read_image, reference_of, require_inside
from membrane_ctrl.measure.measurement import Figures, SetFigure
from membrane_ctrl.measure.result_files import write_arrays, write_picture
from membrane_ctrl.measure.set_statement import SetStatement, state_set
from membrane_ctrl.metrology.figure.bin_figure import BinFigure
from membrane_ctrl.metrology.figure.pixel_figure import measure_pixels, reconstruct_full
from membrane_ctrl.metrology.rays.bench_motions import describe_hidden_allowance
from membrane_ctrl.metrology.tracking.scene_from_reference import make_scene
from membrane_ctrl.metrology.tracking.step_solution import ENOUGH_STEPS, are_steps_separable
from membrane_ctrl.metrology.tracking.tracked_frame import TrackedFrame, rejected_frame
from membrane_ctrl.metrology.tracking.tracker import Tracker
from membrane_ctrl.model import errors, files, program, terminal
from membrane_ctrl.model.arrays import FloatArray, Image
from membrane_ctrl.model.colours import DIVERGING_MAP
from membrane_ctrl.model.zernike_terms import FIRST_FIGURE_INDEX, ZERNIKE_TERMS, zernike_labels

_SAME_REGION = 1e-4  # relative difference of the pattern's side: rounding of written decimals
_SHOWN_REASONS = 5
_SHOWN_FRAMES = 2000  # in a picture
_COLOUR_QUANTILE = 0.995  # of the sizes, at which the colours end


class CrossedConfig(Section):
    """`[pattern.crossed]`: fringes of both axes at once."""

    periods: Annotated[int, Field(ge=2, le=1000)]
    period_mm: Annotated[float, Field(ge=0.1, le=2000)]
    contrast: Annotated[float, Field(gt=0, le=1)] = 1.0


class TrackPattern(schema.PatternConfig):
    """`[pattern]`: the reference's, and the crossed one."""

    crossed: CrossedConfig


class TrackRow(Section):
    """One `[[frames]]` table."""

    file: str
    role: Literal["crossed"]
    shift_x_rad: Annotated[float, Field(ge=-1e3, le=1e3)] = 0.0
    shift_y_rad: Annotated[float, Field(ge=-1e3, le=1e3)] = 0.0
    time_s: Annotated[float, Field(allow_inf_nan=False)]
    displacement_um: Annotated[float, Field(ge=-1e6, le=1e6)] | None = None


class TrackFile(OriginSection):
    """The content of a tracking set's `capture.toml`."""

    schema_: Annotated[Literal["membrane-capture/1"], Field(alias="schema")]
    kind: Literal["track"]
    reference: str
    pattern: TrackPattern
    frames: Annotated[tuple[TrackRow, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Track:
    """Result of a tracking set.

    Attributes
    ----------
    frames : tuple of TrackedFrame
        Figures of the frames.
    reference : SetStatement
        What `measure` states of the set that anchors it.
    stepped : bool
        Whether it began with five usable steps.
    residual_adu : (rows, columns) array
        Mean of what the fits left, over the bins; NaN outside.
    """

    frames: tuple[TrackedFrame, ...]
    reference: SetStatement
    stepped: bool
    residual_adu: FloatArray

    def make_columns(self) -> dict[str, Any]:
        """The arrays of `track.npz`."""
        names = (
            "time_s",
            "coeffs_um",
            "sigma_um",
            "hencky_um",
            "sag_um",
            "sag_sigma_um",
            "sag_change_sigma_um",
            "verdict",
            "reason",
            "change_sigma_um",
        )
        return {name: np.array([getattr(frame, name) for frame in self.frames]) for name in names}


def track_command(
    folder: Path, geometry: Path | None, out: Path | None, as_json: bool, pictures: bool
) -> int:
    """Track a set of crossed patterns, write `track.npz` and print the result.

    Parameters
    ----------
    folder : Path
        The set.
    geometry : Path or None
        Geometry file that replaces the set's own; None: that of the set.
    out : Path or None
        Folder of the results; None: `result` in the set's folder.
    as_json : bool
        Print the table as one line of JSON instead of text.
    pictures : bool
        Write the picture and the Rerun recording, too.

    Returns
    -------
    int
        `Exit.REJECTED` if no frame has a usable figure, else `Exit.DONE`.

    Raises
    ------
    CommandError
        The set or its reference is invalid, or the result cannot be written.
    """
    begin_s = time.perf_counter()
    given = None
    if geometry is not None:
        given = read_geometry(geometry)
    track = track_set(folder, given, geometry)
    passed_s = time.perf_counter() - begin_s

    # The result; reading the frames counts in the rate.
    out = out.resolve() if out else folder / "result"
    table = _make_track_table(track)
    with errors.convert_write_errors(out):
        files.make_folder(out)
        write_arrays(out / "track.npz", **track.make_columns())
        if pictures:
            _write_pictures(out, track, _format_track(table))
    rate = len(track.frames) / passed_s
    print(f"written to {out}; {rate:.1f} frames/s with reading them", file=sys.stderr)
    print(json.dumps(table) if as_json else "\n".join(_format_track(table)))
    return int(errors.Exit.DONE if table["usable"] else errors.Exit.REJECTED)


def track_set(
    folder: Path, geometry: GeometryFile | None = None, file: Path | None = None
) -> Track:
    """Measure the figures of a set's frames.

    Parameters
    ----------
    folder : Path
        The set of crossed patterns.
    geometry : GeometryFile or None
        Replaces its own and its reference's.
    file : Path or None
        The geometry's file, which has its covariance.

    Returns
    -------
    Track

    Raises
    ------
    InputError
        The set or its reference is invalid.
    RejectedError
        The reference gives no usable figure.
    """
    content = read_track(folder)
    path = folder / "capture.toml"

    # The reference, and a tracker for the crossed pattern on it.
    reference = Figures(geometry).measure_folder(reference_of(content.reference, folder, path))
    _require_reference(content, reference, path)
    stated = state_set(reference.head.folder, geometry, file)
    crossed = content.pattern.crossed
    optics = reference.head.optics
    camera = optics.camera
    size = (camera.height_px, camera.width_px)
    figure = _measure_reference(reference)
    try:
        scene = make_scene(optics, reference.checked, figure, crossed.period_mm, crossed.contrast)
        full_scale_adu = 2**camera.bits - 1
        tracker = Tracker(
            scene,
            size,
            full_scale_adu,
            camera.noise_adu,
            reference.displacement_um,
            reference.checked.image.describe(),
        )
    except ValueError as error:
        raise errors.InputError(f"{path}: pattern.crossed.period_mm: {error}") from None

    # What the set states of each frame, and their pictures one after the other.
    shifts_rad = np.array([(row.shift_x_rad, row.shift_y_rad) for row in content.frames])
    times_s = np.array([row.time_s for row in content.frames])
    readings_um = np.array(
        [math.nan if row.displacement_um is None else row.displacement_um for row in content.frames]
    )
    depth = np.dtype(np.uint8 if camera.bits == 8 else np.uint16)
    pictures = _read_pictures(content, folder, size, depth)

    # The first five frames give light and phases of the bins, if they are readable steps.
    found: list[TrackedFrame] = []
    first: list[Image | str] = []
    if are_steps_separable(shifts_rad[:ENOUGH_STEPS]):
        first = list(islice(pictures, ENOUGH_STEPS))
    steps = [picture for picture in first if not isinstance(picture, str)]
    stepped = bool(steps) and len(steps) == len(first)
    if stepped:
        found = tracker.measure_steps(
            steps,
            shifts_rad[:ENOUGH_STEPS],
            times_s[:ENOUGH_STEPS],
            readings_um[:ENOUGH_STEPS],
        )
        first = []

    # All others are followed.
    rest = terminal.track_progress(chain(first, pictures), "frames", len(times_s) - len(found))
    for k, picture in enumerate(rest, start=len(found)):
        at_s = float(times_s[k])
        if isinstance(picture, str):
            found.append(rejected_frame(at_s, picture))
            continue
        shifts = (shifts_rad[k, 0], shifts_rad[k, 1])
        found.append(tracker.track_frame(picture, shifts, at_s, float(readings_um[k])))
    has_rejected_step = any(frame.verdict == "rejected" for frame in found[:ENOUGH_STEPS])
    return Track(
        tuple(found), stated, stepped and not has_rejected_step, tracker.mean_residual_adu()
    )


def _measure_reference(reference: SetFigure) -> BinFigure:
    """The reference's bins on the surface that `measure` finds.

    Its weights differ from those of the bins' own fit. Where the terms cannot represent the film,
    the two differ by more than the error bar of a frame.
    """
    optics = reference.head.optics
    checked = reference.checked
    found = reconstruct_full(optics, checked, measure_pixels(optics, checked)).fit
    checked.tracer.intersect(reference.figure.points, found.surface)
    return replace(reference.figure, fit=found)


def read_track(folder: Path) -> TrackFile:
    """The content of a set's `capture.toml`, checked. Raises InputError."""
    path = folder / "capture.toml"
    if not folder.is_dir():
        raise errors.InputError(f"{folder}: no such tracking set")

    # The set's file; another kind of set names the command for it.
    tables = toml_file.read_toml(path, follow=False)
    if tables.get("kind") in ("full", "fringes"):
        raise errors.InputError(
            f"{path}: kind: a {tables['kind']} set; use `membrane-ctrl measure`"
        )
    for key in toml_file.prune_unknown_keys(tables, TrackFile):
        print(f"{path}: {key}: unknown key, ignored", file=sys.stderr)
    content = toml_file.parse_tables(tables, TrackFile, str(path))

    # Frames inside the folder, in the order of their times, each once.
    for row in content.frames:
        require_inside(row.file, folder, path)
    for before, after in pairwise(content.frames):
        if not after.time_s > before.time_s:
            raise errors.InputError(
                f"{path}: frames: time_s of {after.file} is {after.time_s:g}, not after "
                f"{before.time_s:g} of the frame before"
            )
    for name, times in Counter(row.file for row in content.frames).items():
        if times > 1:
            raise errors.InputError(f"{path}: frames: {name} is given for {times} frames")
    return content


def _require_reference(content: TrackFile, reference: SetFigure, path: Path) -> None:
    """Raise InputError unless the reference is a full set with the region of this one."""
    if reference.head.kind != "full":
        raise errors.InputError(f"{path}: reference: {reference.head.folder} is not a full set")
    ours = content.pattern
    theirs = reference.head.optics.pattern
    for key in ("periods", "period_mm"):
        own_value = getattr(ours, key)
        their_value = getattr(theirs, key)
        if own_value != their_value:
            raise errors.InputError(
                f"{path}: pattern.{key} = {own_value}, the reference has {their_value}"
            )
    side_mm = ours.crossed.periods * ours.crossed.period_mm
    reference_side_mm = theirs.periods * theirs.period_mm
    if abs(side_mm - reference_side_mm) > _SAME_REGION * reference_side_mm:
        raise errors.InputError(
            f"{path}: pattern.crossed: periods * period_mm = {side_mm:g} mm; it covers the "
            f"reference's region, {reference_side_mm:g} mm"
        )


def _read_pictures(
    content: TrackFile, folder: Path, size: tuple[int, int], depth: np.dtype[Any]
) -> Iterator[Image | str]:
    """The frames one after the other; a reason where there is no picture.

    Raises InputError for a picture of another size or depth.
    """
    for row in content.frames:
        picture = read_image(folder / row.file)
        if isinstance(picture, str):
            yield picture
            continue
        where = f"{folder / 'capture.toml'}: frames: {row.file} has"
        if picture.shape != size:
            seen = f"{picture.shape[1]} x {picture.shape[0]} pixels"
            raise errors.InputError(f"{where} {seen}, the reference {size[1]} x {size[0]}")
        if picture.dtype != depth:
            raise errors.InputError(
                f"{where} {8 * picture.itemsize} bit pixels, the reference {8 * depth.itemsize}"
            )
        yield picture


def _make_track_table(track: Track) -> dict[str, Any]:
    """The result in numbers."""
    used = [frame for frame in track.frames if frame.verdict != "rejected"]

    # Means over the usable frames; null without any.
    figures: dict[str, float | None] = dict.fromkeys(
        (
            "sag_mean_um",
            "sag_sd_um",
            "sag_sigma_um",
            "sag_change_sigma_um",
            "rest_share",
        )
    )
    if used:
        sags_um = np.array([frame.sag_um for frame in used])
        figures["sag_mean_um"] = float(sags_um.mean())
        figures["sag_sd_um"] = float(sags_um.std())
        for name in ("sag_sigma_um", "sag_change_sigma_um", "rest_share"):
            figures[name] = float(np.median([getattr(frame, name) for frame in used]))

    # How often each verdict occurs, and why.
    reasons = Counter(f"{frame.verdict}: {frame.reason}" for frame in track.frames if frame.reason)
    counts = Counter(frame.verdict for frame in track.frames)
    return {
        **program.file_origin("membrane-track/1"),
        "frames": len(track.frames),
        "verdicts": {verdict: counts[verdict] for verdict in ("ok", "degraded", "rejected")},
        "usable": len(used),
        "stepped": track.stepped,
        "reference": track.reference.table(),
        "assumed": describe_hidden_allowance(),
        "seconds": track.frames[-1].time_s - track.frames[0].time_s,
        **figures,
        "reasons": dict(reasons.most_common()),
    }


def _format_track(table: dict[str, Any]) -> list[str]:
    """The result as lines of text."""
    verdicts = ", ".join(
        f"{count} {verdict}" for verdict, count in table["verdicts"].items() if count
    )
    lines = [f"frames    {table['frames']} in {table['seconds']:.1f} s: {verdicts}"]
    reasons = list(table["reasons"].items())[:_SHOWN_REASONS]
    lines += [f"          {count} x {reason}" for reason, count in reasons]

    # The reference, and what gives the light of the bins.
    light = "the reference"
    if table["stepped"]:
        light = "five steps of the first frames"
    known = table["reference"]["geometry_known"]
    judged = table["reference"]
    lines.append(
        f"reference {judged['verdict']}" + (f": {judged['reason']}" if judged["reason"] else "")
    )
    lines.append(f"geometry  {known['state']}: {known['source']}")
    lines.append(f"anchor    light and phases of the bins from {light}")

    # The figures.
    if table["usable"]:
        lines.append(
            f"sag       {table['sag_mean_um'] / 1e3:.5f} mm, standard deviation "
            f"{table['sag_sd_um']:.3f} µm, 1 sigma of a frame "
            f"{table['sag_change_sigma_um']:.3f} µm"
        )
        lines.append(
            f"          1 sigma {table['sag_sigma_um']:.2g} µm, if the bench has moved since the "
            f"reference in ways that frames do not show (1 sigma: {table['assumed']})"
        )
        lines.append(f"fit       leaves {table['rest_share']:.2%} of the fringes' swing")
    return lines


def _write_pictures(out: Path, track: Track, lines: Sequence[str]) -> None:
    """Write `track.png` and `track.rrd`. Raises OSError."""
    import rerun as rr

    from membrane_ctrl.measure.rerun_recording import log_pictures, open_recording

    columns = track.make_columns()
    time_s = columns["time_s"]
    sag_um = columns["sag_um"]
    sigma_um = columns["sag_change_sigma_um"]

    # The terms about their means.
    change_um = None
    if np.isfinite(sag_um).any():
        change_um = columns["coeffs_um"] - np.nanmean(columns["coeffs_um"], axis=0)
    drawn = [_draw_track(out / "track.png", columns, change_um, track.residual_adu)]
    with open_recording(out / "track.rrd", "membrane_ctrl_track") as recording:
        recording.log("track/report", rr.TextDocument("\n".join(lines)), static=True)
        at = [rr.TimeColumn("run_time", duration=time_s)]
        sags = rr.Measurements.columns(values=sag_um, variances=sigma_um**2)
        recording.send_columns("track/sag_um", at, sags)
        if change_um is not None:
            names = zernike_labels(first=2)
            recording.log("track/terms_um", rr.SeriesLines(names=names), static=True)
            terms = rr.Scalars.columns(scalars=change_um[:, 1:])
            recording.send_columns("track/terms_um", at, terms)

        # A line of text at each change of the verdict.
        states = [f"{frame.verdict} {frame.reason}".strip() for frame in track.frames]
        for k, (frame, state) in enumerate(zip(track.frames, states, strict=True)):
            if k == 0 or state != states[k - 1]:
                recording.set_time("run_time", duration=frame.time_s)
                recording.log("track/verdict", rr.TextLog(state))
        log_pictures(recording, "track/pictures", drawn)


def _draw_track(
    path: Path, columns: dict[str, Any], change_um: FloatArray | None, residual_adu: FloatArray
) -> Path:
    """Draw the terms over time, the sag with its band, and what the fits left."""
    from membrane_ctrl.measure.matplotlib_sheet import new_sheet

    figure, (terms, sag, left) = new_sheet(9, 13, 3, 1)
    every = max(1, len(columns["time_s"]) // _SHOWN_FRAMES)
    time_s = columns["time_s"][::every]
    sag_um = columns["sag_um"][::every]
    sigma_um = columns["sag_change_sigma_um"][::every]
    if change_um is not None:
        # The terms over time, from astigmatism on.
        shown = change_um[::every, FIRST_FIGURE_INDEX - 1 :].T
        extent = (time_s[0], time_s[-1] + 1e-9, ZERNIKE_TERMS + 0.5, FIRST_FIGURE_INDEX - 0.5)
        style: dict[str, Any] = {"aspect": "auto", "extent": extent, "interpolation": "nearest"}
        figure.colorbar(terms.imshow(shown, **style, **_diverging_colours(shown)), ax=terms)

        # The sag about its mean.
        middle_um = np.nanmean(sag_um)
        about_um = sag_um - middle_um
        sag.plot(time_s, about_um, linewidth=0.8)
        sag.fill_between(time_s, about_um - sigma_um, about_um + sigma_um, alpha=0.3)
        sag.set(title=f"sag less {middle_um / 1e3:.4f} mm (µm), band of 1 sigma")
    terms.set(title="terms less their means (µm RMS)", xlabel="time (s)", ylabel="Noll index")
    sag.set(xlabel="time (s)", ylabel="µm")

    # The mean residual.
    image = left.imshow(residual_adu, **_diverging_colours(residual_adu))
    figure.colorbar(image, ax=left)
    left.set(
        title="mean light that the fits leave (ADU)", xlabel="column of bins", ylabel="row of bins"
    )
    return write_picture(path, figure)


def _diverging_colours(values: FloatArray) -> dict[str, Any]:
    """Colours about 0 for values, of which a few of the largest are beyond their ends."""
    most = float(np.nanquantile(np.abs(values), _COLOUR_QUANTILE)) or 1.0
    return {"cmap": DIVERGING_MAP, "vmin": -most, "vmax": most}
