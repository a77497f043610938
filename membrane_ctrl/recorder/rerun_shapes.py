"""Shape estimates to Rerun: Zernike terms, maps, figures of quality, a waterfall of terms."""

import math
from collections import deque

import numpy as np
import rerun as rr

from membrane_ctrl.metrology.figure import held_quantities
from membrane_ctrl.model import shape_estimate
from membrane_ctrl.model.arrays import AnyArray, FloatArray
from membrane_ctrl.model.figure_columns import LOW_ORDER_COLUMNS
from membrane_ctrl.model.prose import for_people
from membrane_ctrl.recorder import rerun_recording, state_lanes
from membrane_ctrl.run_files import shapes, streams
from membrane_ctrl.run_files.stream import Stream

# Three maps of the change a minute are 60 MB a day. Nothing is lost, as any map can be rebuilt from
# the coefficients of its cycle. In the first minutes somebody is watching.
DIFFERENCE_INTERVAL_S = 60.0
DIFFERENCE_EARLY_S = 10.0
EARLY_S = 300.0
MAP_INTERVAL_S = 600.0
# Of the figures of single frames the timeline has one a second; the table has all.
FRAME_INTERVAL_S = 1.0
# The water-fall: a column for each of these, 8 kB.
WATERFALL_COLUMNS = 120
WATERFALL_INTERVAL_S = 20.0
WATERFALL_EARLY_S = 2.0
WATERFALL_LEAST_UM = 0.05
# Colours span nearly all of a map: a few pixels at the edge must not hide the rest.
_NEARLY_ALL = 0.99
# Zernike terms removed from the maps of change (the mount tilts, the loop holds the bowl's depth),
# and the least span of their colours, µm: noise must not look like a figure.
CHANGES = {
    "difference": (0, 0.5),
    "difference_no_tilt": (3, 0.5),
    "difference_no_defocus": (4, 0.1),
}


def colour_span(values: AnyArray, least_um: float | None) -> tuple[float, float]:
    """Range of colours for nearly all of some maps.

    Parameters
    ----------
    values : array
        Of any shape; NaN is left out.
    least_um : float or None
        Least half width of a range around 0; None: the range begins at 0.
    """
    most = float(np.nanquantile(np.abs(values), _NEARLY_ALL))
    if least_um is None:
        return (0.0, most)
    return (-max(least_um, most), max(least_um, most))


def map_picture(values: AnyArray, span: tuple[float, float]) -> rr.DepthImage:
    """Make the picture of a map, in diverging colours for a range around 0.

    Parameters
    ----------
    values : (m, m) array
        The map; NaN is drawn as the lowest value, so a mask must cover it.
    span : (float, float)
        Lowest and highest value of the colours.
    """
    return rr.DepthImage(
        values, colormap="CyanToYellow" if span[0] < 0 else "Viridis", depth_range=span
    )


class ShapeStreams:
    """Sends estimates to a recording. Changes are against the first
    good one that `set_reference` lets be.

    Parameters
    ----------
    recording : Recording
        The present segment is written.
    scalars : HeldScalars, optional
        Of the mirror, for focus and RMS.
    """

    def __init__(
        self,
        recording: rerun_recording.Recording,
        scalars: held_quantities.HeldScalars | None = None,
    ) -> None:
        self._recording = recording
        self._scalars = scalars
        self.reference: shape_estimate.ShapeEstimate | None = None
        self.pictures = True
        self._reference_from_s = -math.inf
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._next_frame_s = self._next_fall_s = -math.inf
        self._fall: deque[FloatArray] = deque(maxlen=WATERFALL_COLUMNS)
        self._scatter = shapes.Scatter()
        self._colours: dict[str, str] = {}
        self._verdict = ""

    def start_segment(self) -> None:
        """Repeat in a new file what holds until it changes."""
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._verdict = ""

    def set_reference(self, from_s: float) -> None:
        """Take the first estimate from a moment on as the reference, and show the maps against it
        at once.
        """
        self._reference_from_s = from_s

    def send_estimate(self, estimate: shape_estimate.ShapeEstimate) -> None:
        """Send one estimate at the middle of its exposures; if rejected, only quality and verdict.

        Of single frames of one verdict, one a second is sent.
        """
        # Single frames come faster than anybody sees.
        if (
            estimate.kind == "track"
            and estimate.verdict == self._verdict
            and estimate.time_s < self._next_frame_s
        ):
            return
        self._next_frame_s = estimate.time_s + FRAME_INTERVAL_S
        # Quality and verdict, of rejected ones as well.
        time_s = np.array([estimate.time_s])
        for stream, values in _make_quality_scalars(estimate).items():
            self._recording.send_scalars(stream.path, time_s, np.array([values]))
        if estimate.verdict != self._verdict:
            self._verdict = estimate.verdict
            self._recording.send_columns(
                state_lanes.VERDICT.path, time_s, rr.StateChange.columns(state=[estimate.verdict])
            )
        if estimate.verdict == "rejected":
            return
        if (
            self.reference is None
            or self.reference.time_s < self._reference_from_s <= estimate.time_s
        ):
            self.reference = estimate
            self._next_difference_s = -math.inf
            self._next_map_s = -math.inf
            self._scatter = shapes.Scatter()
        # Terms, and their change since the reference.
        self._scatter.add(estimate.coeffs_um)
        self._recording.send_scalars(streams.ZERNIKE.path, time_s, estimate.coeffs_um[np.newaxis])
        for stream, (values, variances) in _make_change_scalars(estimate, self.reference).items():
            self._recording.send_measurements(
                stream.path, time_s, np.array([values]), np.array([variances])
            )
        if self._scalars is not None:
            self._send_scalars(self._scalars, estimate, self.reference)
        if estimate.kind == "track":
            self._fall.append(
                (estimate.coeffs_um - self.reference.coeffs_um)[shapes.WATERFALL_TERMS]
            )
        # Maps, unless pictures are omitted on a full disk.
        if self.pictures:
            self._send_maps(estimate, self.reference)
            self._send_fall(estimate.time_s, estimate.time_s - self.reference.time_s < EARLY_S)

    def _send_scalars(
        self,
        scalars: held_quantities.HeldScalars,
        estimate: shape_estimate.ShapeEstimate,
        reference: shape_estimate.ShapeEstimate,
    ) -> None:
        """Send focus and RMS with their variances."""
        found = held_quantities.measure_scalars(
            scalars,
            estimate.coeffs_um,
            estimate.hencky_um,
            estimate.covariance_um2,
            reference.coeffs_um,
        )
        time_s = np.array([estimate.time_s])
        rms = [found.rms_um, found.least_rms_um]
        for stream, values, variances in (
            (streams.FOCUS, [found.focus_mm], [found.focus_sigma_mm**2]),
            (streams.FIGURE_RMS, rms, [found.rms_sigma_um**2, 0.0]),
        ):
            self._recording.send_measurements(
                stream.path, time_s, np.array([values]), np.array([variances])
            )

    def _send_fall(self, time_s: float, early: bool) -> None:
        """Send the terms of the last two minutes as a picture: a row for each, the newest on the
        right.
        """
        if not self._fall or time_s < self._next_fall_s:
            return
        interval_s = WATERFALL_EARLY_S if early else WATERFALL_INTERVAL_S
        self._next_fall_s = time_s + interval_s
        terms = np.zeros((self._fall[0].size, WATERFALL_COLUMNS), np.float16)
        terms[:, -len(self._fall) :] = np.array(self._fall).T
        most_um = max(WATERFALL_LEAST_UM, float(np.abs(terms).max()))
        self._recording.log_component(
            shapes.WATERFALL_PATH, time_s, map_picture(terms, (-most_um, most_um))
        )
        self._colours["waterfall"] = f"±{most_um:.3g} µm"

    def _send_maps(
        self, estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate
    ) -> None:
        """Send the maps that are due: they are large, so that each kind has an interval of its
        own.
        """
        time_s = estimate.time_s
        early = time_s - reference.time_s < EARLY_S
        # Height, uncertainty and scatter change slowly.
        if time_s >= self._next_map_s:
            interval_s = DIFFERENCE_INTERVAL_S if early else MAP_INTERVAL_S
            self._next_map_s = time_s + interval_s
            self._send_map("height", "mm", time_s, shapes.height_map_mm(estimate))
            self._send_map(
                "uncertainty", "µm", time_s, shapes.uncertainty_map_um(estimate.covariance_um2)
            )
            self._send_map("scatter", "µm", time_s, self._scatter.map_um())
        # The change since the reference, at first more often.
        if time_s >= self._next_difference_s:
            interval_s = DIFFERENCE_EARLY_S if early else DIFFERENCE_INTERVAL_S
            self._next_difference_s = time_s + interval_s
            difference_um = shapes.difference_map_um(estimate, reference)
            for kind, (terms, least_um) in CHANGES.items():
                self._send_map(
                    kind, "µm", time_s, shapes.without_terms(difference_um, terms), least_um
                )
            terms_um = (estimate.coeffs_um - reference.coeffs_um)[1:]
            self._recording.log_component(
                shapes.BARS_PATH, time_s, rr.BarChart.from_fields(values=terms_um)
            )
            self._recording.send_page(
                "/shape/legend", time_s, _make_legend(estimate, reference, self._colours)
            )

    def _send_map(
        self, kind: str, unit: str, time_s: float, values: shapes.Map, least_um: float | None = None
    ) -> None:
        """Send a map; with `least_um` in diverging colours, which span at least that, around 0."""
        span = colour_span(values, least_um)
        if unit != "mm":  # millimetres need more than three digits
            values = values.astype(np.float16)
        picture = map_picture(values, span)
        self._recording.log_component(f"/shape/map/{kind}", time_s, picture)
        sign = "0 to " if least_um is None else "±"
        self._colours[kind] = f"{sign}{span[1]:.3g} {unit}"


def _make_legend(
    estimate: shape_estimate.ShapeEstimate,
    reference: shape_estimate.ShapeEstimate,
    colours: dict[str, str],
) -> str:
    """Markdown: the ranges of the maps' colours, and one line per cycle."""
    names = {**shapes.MAPS, "waterfall": "terms over time"}
    rows = "\n".join(
        f"| {name} | {colours[kind]} |" for kind, name in names.items() if kind in colours
    )
    reason = f" ({estimate.reason})" if estimate.reason else ""
    shared_um = estimate.geometry_sag_sigma_um
    shared = ""
    if math.isfinite(shared_um):
        shared = f", ± {shared_um:.3g} µm shared by all cycles"
    return (
        f"| map | colours |\n|---|---|\n{rows}\n\n"
        "Change: cyan below, dark 0, yellow above. Others: violet to yellow. 99 % of a map "
        "is in its range.\n\n"
        f"- cycle {estimate.cycle}, {estimate.kind}: {estimate.verdict}{for_people(reason)}\n"
        f"- changes are against cycle {reference.cycle}, at {reference.time_s:.0f} s\n"
        f"- sag {estimate.sag_um / 1e3:.4f} mm ± {estimate.sag_change_sigma_um:.3f} µm in a "
        f"change{shared}\n"
        f"- slope residual {estimate.slope_residual_urad:.2f} µrad, "
        f"{100 * estimate.valid_fraction:.1f} % valid\n"
    )


def _make_quality_scalars(
    estimate: shape_estimate.ShapeEstimate,
) -> dict[Stream, list[float]]:
    return {
        streams.RESIDUAL: [estimate.slope_residual_urad],
        streams.QUALITY: [estimate.valid_fraction, estimate.saturated_fraction],
        streams.MODULATION: [estimate.modulation_median_adu],
        streams.LATENCY: [estimate.latency_s * 1e3],
    }


def _make_change_scalars(
    estimate: shape_estimate.ShapeEstimate, reference: shape_estimate.ShapeEstimate
) -> dict[Stream, tuple[list[float], list[float]]]:
    """Values and variances; these are this cycle's own,
    as those of the reference shift all equally.
    """
    change_um = estimate.coeffs_um - reference.coeffs_um
    variances_um2 = np.diag(estimate.covariance_um2)
    sag_um = [
        estimate.sag_um - reference.sag_um,
        estimate.displacement_um - reference.displacement_um,
    ]
    terms = [j - 1 for j in LOW_ORDER_COLUMNS]
    return {
        streams.CHANGE: (change_um[terms].tolist(), variances_um2[terms].tolist()),
        streams.SAG: (sag_um, [estimate.sag_change_sigma_um**2, 0.0]),
    }
