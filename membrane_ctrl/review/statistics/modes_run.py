"""`modes`: the mirror's vibrations in tracked figures, minute by minute, and whether one of them
moves.
"""

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from membrane_ctrl.measure.result_files import read_arrays, write_json, write_picture
from membrane_ctrl.metrology.numerics import zernike
from membrane_ctrl.metrology.vibrations.mode_search import (
    LEAST_RATE_HZ,
    LEAST_S,
    MOVED,
    SEARCH_S,
    VibrationMode,
    find_modes,
)
from membrane_ctrl.model import errors, files, program, terminal
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.colours import DIVERGING_MAP
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.run_files.run_lookup import is_run

if TYPE_CHECKING:
    import rerun.blueprint as rrb

_SEARCHES = 60  # of a run, evenly spread: a quarter of a second each
_ENDS = 3  # searches, whose median is where a mode was at first, or is at last
_SHOWN = 6  # modes in the picture
_USUAL = 0.5  # share of the searches that a mode is in
_LARGEST_UM = 1e6  # a term of a metre is none
_FRAMES_MOST = 300_000  # of a set: four hours at 20 Hz


@dataclass(frozen=True)
class SeenMode:
    """A vibration in the searches that found it."""

    time_s: FloatArray  # (n,): UTC, or the set's own seconds
    lines: tuple[VibrationMode, ...]

    @property
    def frequency_hz(self) -> float:
        """Mean, weighted by the searches' own errors."""
        return float(
            np.average([line.frequency_hz for line in self.lines], weights=self._make_weights())
        )

    @property
    def sigma_hz(self) -> float:
        """Standard error of the mean, from the searches' errors or from their scatter if that is
        larger.
        """
        own = 1 / np.sqrt(np.sum(self._make_weights()))
        values = [line.frequency_hz for line in self.lines]
        return float(
            max(own, np.std(values, ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0)
        )

    @property
    def shape(self) -> FloatArray:
        """Terms (terms,) of unit RMS: the mean of the searches', their signs aligned."""
        together = np.array([line.shape for line in self.lines])
        return np.asarray(np.linalg.svd(together, full_matrices=False)[2][0])

    @property
    def relative_change(self) -> float:
        """Relative change from the first searches to the last, three of each; 0 with fewer than six
        in all.

        More of them, as thirds of all, would hide a third of what moves slowly.
        """
        values = np.array([line.frequency_hz for line in self.lines])[np.argsort(self.time_s)]
        ends = min(_ENDS, len(values) // 3)
        if ends > 1:
            return float(np.median(values[-ends:]) / np.median(values[:ends]) - 1)
        return 0.0

    def _make_weights(self) -> FloatArray:
        return np.array([line.sigma_hz for line in self.lines]) ** -2.0


def modes_command(folders: Sequence[Path], out: Path | None, as_json: bool, pictures: bool) -> int:
    """Search tracked frames for vibrations, write `modes.json` and print the modes.

    Parameters
    ----------
    folders : sequence of Path
        Results of `track`, or runs with tracked frames.
    out : Path or None
        Folder of the results; None: `modes` in the last folder.
    as_json : bool
        Print the table as one line of JSON instead of text.
    pictures : bool
        Draw the modes and write a recording, too.

    Returns
    -------
    int
        0, the exit code.

    Raises
    ------
    RejectedError
        No folder has enough frames at a steady rate.
    CommandError
        A folder cannot be read, or the result cannot be written.
    """
    # Search some minutes of each run by themselves: lines come and go.
    times: list[float] = []
    searches: list[tuple[VibrationMode, ...] | None] = []
    for folder in folders:
        time_s, coeffs_um, origin_s = _read_frames(folder)
        for part in terminal.track_progress(_choose_minutes(time_s), "searches"):
            times.append(origin_s + float(time_s[part].mean()))
            searches.append(find_modes(time_s[part], coeffs_um[part]))

    # A search without enough frames at a steady rate has no result.
    done = [(at_s, lines) for at_s, lines in zip(times, searches, strict=True) if lines is not None]
    if not done:
        raise errors.RejectedError(
            f"{folders[0]}: less than {LEAST_S:g} s of frames at a steady rate"
        )
    # A line that at least half of the searches see is a mode; the others are passing.
    modes, passing = _group_lines(
        np.array([at_s for at_s, _ in done]), [lines for _, lines in done]
    )

    # The result.
    table = _make_table(folders, modes, passing, len(done))
    out = (out or folders[-1] / "modes").resolve()
    with errors.convert_write_errors(out):
        files.make_folder(out)
        write_json(out / "modes.json", table)
        if pictures and modes:
            _write_pictures(out, modes, min(times), _format_table(table))
    print(f"written to {out}", file=sys.stderr)
    print(json.dumps(table) if as_json else "\n".join(_format_table(table)))
    return 0


def _read_frames(folder: Path) -> tuple[FloatArray, FloatArray, float]:
    """Times, terms (n, terms) with NaN where rejected, and the UTC of time 0.
    Raises CommandError.
    """
    # From a run's tables, or from the result of tracking.
    if is_run(folder):
        run = open_run(folder)
        shapes = run.shapes()
        origin_s = run.origin_utc.timestamp()
        time_s = shapes.time_s
        coeffs_um = shapes.coeffs_um
        verdict = shapes.verdict
    else:
        path = next(
            (p for p in (folder / "track.npz", folder / "result" / "track.npz") if p.exists()), None
        )
        if path is None:
            raise errors.InputError(
                f"{folder}: neither a run nor the result of `membrane-ctrl track`"
            )
        try:
            time_s, coeffs_um = read_arrays(
                path, ("time_s", "coeffs_um"), _FRAMES_MOST * ZERNIKE_TERMS
            )
        except (OSError, ValueError) as error:
            raise errors.InputError(f"{path}: {error}") from None
        if coeffs_um.shape != (time_s.size, ZERNIKE_TERMS):
            found = " x ".join(str(size) for size in coeffs_um.shape)
            wanted = f"{time_s.size} x {ZERNIKE_TERMS}"
            raise errors.InputError(
                f"{path}: coeffs_um: {found} numbers where times x terms are {wanted}"
            )
        origin_s, verdict = 0.0, np.full(time_s.size, "")  # rejected frames are NaN
    # Accepted frames in the order of their times.
    good = (
        np.isfinite(time_s)
        & (verdict != "rejected")
        & (np.abs(coeffs_um) < _LARGEST_UM).all(axis=1)
    )
    order = np.argsort(time_s[good], kind="stable")
    time_s = np.asarray(time_s[good][order], float)
    coeffs_um = np.asarray(coeffs_um[good][order], float)
    if time_s.size < 2:
        raise errors.RejectedError(f"{folder}: no usable figures")
    # Slow figures alias all vibrations.
    interval_s = float(np.median(np.diff(time_s)))
    if not interval_s * LEAST_RATE_HZ <= 1:
        raise errors.RejectedError(
            f"{folder}: a figure every {interval_s:.2g} s shows no vibrations; "
            f"{LEAST_RATE_HZ:g} a second are "
            'needed: hold with shape.mode = "track"'
        )
    return time_s, coeffs_um, origin_s


def _choose_minutes(time_s: FloatArray) -> list[slice]:
    """Minutes of frames, evenly spread if there are many."""
    _, first = np.unique(np.floor((time_s - time_s[0]) / SEARCH_S), return_index=True)
    edges = [*first, time_s.size]
    chosen = np.unique(
        np.linspace(0, len(first) - 1, min(len(first), _SEARCHES)).round().astype(int)
    )
    return [slice(edges[k], edges[k + 1]) for k in chosen]


def _group_lines(
    times_s: FloatArray, searches: Sequence[tuple[VibrationMode, ...]]
) -> tuple[list[SeenMode], int]:
    """Lines of neighbouring frequencies in at least half of the searches, the strongest first; how
    many others.
    """
    # In the order of their frequencies, each line joins the first mode whose last line it
    # resembles, unless that mode already has a line of the same search.
    modes: list[SeenMode] = []
    seen = [(line, at_s) for at_s, lines in zip(times_s, searches, strict=True) for line in lines]
    for line, at_s in sorted(seen, key=lambda each: each[0].frequency_hz):
        near = (
            k
            for k, m in enumerate(modes)
            if at_s not in m.time_s.tolist() and line.is_like(m.lines[-1])
        )
        if (k := next(near, None)) is None:
            modes.append(SeenMode(np.array([at_s]), (line,)))
        else:
            modes[k] = SeenMode(np.append(modes[k].time_s, at_s), (*modes[k].lines, line))
    # Keep modes that were seen often enough, the strongest evidence first.
    least = math.ceil(_USUAL * len(searches))
    usual = sorted(
        (mode for mode in modes if len(mode.lines) >= least),
        key=lambda mode: -sum(one.evidence for one in mode.lines),
    )
    return usual, len(seen) - sum(len(mode.lines) for mode in usual)


def _make_table(
    folders: Sequence[Path], modes: Sequence[SeenMode], passing: int, searches: int
) -> dict[str, Any]:
    return {
        **program.file_origin("membrane-modes/1"),
        "sources": [folder.name for folder in folders],
        "searches": searches,
        "modes": [
            {
                "frequency_hz": mode.frequency_hz,
                "sigma_hz": mode.sigma_hz,
                "amplitude_nm": float(np.median([line.amplitude_nm for line in mode.lines])),
                "searches": len(mode.lines),
                "aliases_hz": list(mode.lines[0].aliases_hz)
                if all(line.aliases_hz for line in mode.lines)
                else [],
                "moved": mode.relative_change,
                "shape": mode.shape.tolist(),
            }
            for mode in modes
        ],
        "passing": passing,
    }


def _format_table(table: dict[str, Any]) -> list[str]:
    lines = [f"searches   {table['searches']} of a minute at most"]
    for mode in table["modes"]:
        # The mode by its frequency, and its shape by the largest terms.
        terms = np.argsort(np.abs(mode["shape"]))[::-1][:3]
        made = ", ".join(f"{mode['shape'][j]:+.2f} Z{j + 1}" for j in terms)
        line = (
            f"mode       {mode['frequency_hz']:.3f} +- {mode['sigma_hz']:.3f} Hz, "
            f"{mode['amplitude_nm']:.1f} nm, in "
            f"{mode['searches']} searches; {made}"
        )
        if mode["aliases_hz"]:
            others = ", ".join(f"{alias:.2f}" for alias in mode["aliases_hz"])
            line += f"; or {others} Hz: the frames have one rate"
        lines.append(line)

        # A frequency goes with the root of the tension.
        if abs(mode["moved"]) > MOVED:
            lines.append(
                f"           it moved by {mode['moved']:+.1%}: the film's tension by "
                f"{2 * mode['moved']:+.1%}; check "
                "clamping and pressure"
            )
    if not table["modes"]:
        lines.append("mode       none that stands out of the noise")
    if table["passing"]:
        lines.append(f"passing    {table['passing']} lines in fewer than half of the searches")
    return lines


def _write_pictures(
    out: Path, modes: Sequence[SeenMode], begin_s: float, lines: Sequence[str]
) -> None:
    """Write `modes.png` and `modes.rrd`. Raises OSError."""
    import rerun as rr

    from membrane_ctrl.measure.rerun_recording import log_pictures, open_recording

    picture = _draw_modes(out / "modes.png", modes, begin_s)
    with open_recording(
        out / "modes.rrd", "membrane_ctrl_modes", _make_layout(len(modes), picture)
    ) as recording:
        recording.log("modes/report", rr.TextDocument("\n".join(lines)), static=True)
        for k, mode in enumerate(modes, start=1):
            at = [rr.TimeColumn("run_time", duration=mode.time_s - begin_s)]
            frequency_hz = np.array([line.frequency_hz for line in mode.lines])
            columns = {
                "frequency_hz": frequency_hz,
                "change_percent": 100 * (frequency_hz / frequency_hz[0] - 1),
                "amplitude_nm": np.array([line.amplitude_nm for line in mode.lines]),
            }
            for name, values in columns.items():
                recording.log(
                    f"modes/{k}/{name}",
                    rr.SeriesLines(names=f"{mode.frequency_hz:.2f} Hz", widths=2),
                    static=True,
                )
                recording.send_columns(f"modes/{k}/{name}", at, rr.Scalars.columns(scalars=values))
        log_pictures(recording, "modes/pictures", [picture])


def _make_layout(count: int, picture: Path) -> "rrb.Blueprint":
    """Changes of the frequencies and amplitudes beside the picture and the report."""
    import rerun as rr

    end = rr.TimeRangeBoundary.infinite()
    # the default is a minute
    whole = rr.blueprint.TimeAxis(view_range=rr.TimeRange(start=end, end=end))
    plots = (
        ("Change of the frequency, %", "change_percent"),
        ("Amplitude, nm RMS", "amplitude_nm"),
    )
    return rr.blueprint.Blueprint(
        rr.blueprint.Horizontal(
            rr.blueprint.Vertical(
                *(
                    rr.blueprint.TimeSeriesView(
                        name=name,
                        origin="/",
                        axis_x=whole,
                        contents=[f"+ /modes/{k}/{of}" for k in range(1, count + 1)],
                    )
                    for name, of in plots
                ),
                rr.blueprint.TextDocumentView(name="Modes", origin="/modes/report"),
            ),
            rr.blueprint.Spatial2DView(name="Shapes", origin=f"/modes/pictures/{picture.stem}"),
        ),
        rr.blueprint.TimePanel(state="collapsed", timeline="run_time"),
        rr.blueprint.SelectionPanel(state="collapsed"),
        rr.blueprint.BlueprintPanel(state="collapsed"),
        auto_views=False,
    )


def _draw_modes(path: Path, modes: Sequence[SeenMode], begin_s: float) -> Path:
    """Draw the frequencies over time and the shapes of the strongest modes."""
    from membrane_ctrl.measure.matplotlib_sheet import new_sheet

    # A row of two pictures for each mode.
    shown = modes[:_SHOWN]
    figure, axes = new_sheet(11, 3 * len(shown), len(shown), 2)
    side = np.linspace(-1, 1, 121)
    x, y = np.meshgrid(side, side)
    for mode, (over_time, shape) in zip(shown, np.reshape(axes, (-1, 2)), strict=True):
        # Frequency of each search with its 1 sigma.
        minutes = (mode.time_s - begin_s) / 60
        over_time.errorbar(
            minutes,
            [line.frequency_hz for line in mode.lines],
            [line.sigma_hz for line in mode.lines],
            fmt=".",
        )
        over_time.set(xlabel="time (min)", ylabel="frequency (Hz)")

        # Height over the unit disc, of unit RMS.
        height = np.tensordot(mode.shape, zernike.evaluate_terms(x, y), 1)
        height = np.where(np.hypot(x, y) <= 1, height, np.nan)
        most = float(np.nanmax(np.abs(height)))
        shape.imshow(
            height, cmap=DIVERGING_MAP, vmin=-most, vmax=most, origin="lower", extent=(-1, 1, -1, 1)
        )
        shape.set(title=f"shape at {mode.frequency_hz:.2f} Hz", xticks=[], yticks=[])
    return write_picture(path, figure)
