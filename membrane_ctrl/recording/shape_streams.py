"""Shape estimates to Rerun: every cycle its numbers, now and then its maps."""

from __future__ import annotations

import math

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from membrane_ctrl.estimate import ShapeEstimate
from membrane_ctrl.recording.height_map import difference_map_um, height_map_mm, uncertainty_map_um
from membrane_ctrl.recording.lanes import VERDICT
from membrane_ctrl.recording.sink import Recording
from membrane_ctrl.recording.streams import (
    CHANGE,
    LATENCY,
    LOW_ORDERS,
    MODULATION,
    QUALITY,
    RESIDUAL,
    SAG,
    ZERNIKE,
    Stream,
)

# Sets of maps (3 x 66 kB) are this far apart: 1.7 GB a day, and a figure that drifts over minutes loses nothing;
# the coefficients of every cycle are there, from which any map can be made again.
MAP_INTERVAL_S = 10.0
# The colours of the difference map span at least this, so that noise does not look like a figure.
_DIFFERENCE_LEAST_UM = 0.5


class ShapeStreams:
    """Sends estimates to a recording. Changes are against the first estimate that was not rejected."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._reference: ShapeEstimate | None = None
        self._next_map_s = -math.inf
        self._verdict = ""

    def start_segment(self) -> None:
        """Say again in a new file what holds until it changes."""
        self._next_map_s = -math.inf
        self._verdict = ""

    def send(self, estimate: ShapeEstimate) -> None:
        """Send one estimate at the middle of its exposures; of a rejected one only quality and verdict."""
        time_s = np.array([estimate.time_s])
        for stream, values in _quality(estimate).items():
            self._recording.scalars(stream.path, time_s, np.array([values]))
        if estimate.verdict != self._verdict:
            self._verdict = estimate.verdict
            self._recording.columns(VERDICT.path, time_s, rr.StateChange.columns(state=[estimate.verdict]))
        if estimate.verdict == "rejected":
            return
        self._reference = self._reference or estimate
        for stream, values in _figure(estimate, self._reference).items():
            self._recording.scalars(stream.path, time_s, np.array([values]))
        change_um = (estimate.coeffs_um - self._reference.coeffs_um)[1:]
        bars = rr.BarChart(change_um, abscissa=np.arange(2, 37))
        self._recording.log("/shape/change_bars", estimate.time_s, bars)
        if estimate.time_s >= self._next_map_s:
            self._next_map_s = estimate.time_s + MAP_INTERVAL_S
            self._send_maps(estimate, self._reference)

    def _send_maps(self, estimate: ShapeEstimate, reference: ShapeEstimate) -> None:
        height_mm = height_map_mm(estimate.coeffs_um)
        difference_um = difference_map_um(estimate.coeffs_um, reference.coeffs_um)
        sigma_um = uncertainty_map_um(estimate.covariance_um2)
        span_um = max(_DIFFERENCE_LEAST_UM, float(np.nanmax(np.abs(difference_um))))
        sigma_max_um = max(1e-6, float(np.nanmax(sigma_um)))
        low_mm, high_mm = float(np.nanmin(height_mm)), float(np.nanmax(height_mm))
        self._send_map("height", estimate.time_s, height_mm, (low_mm, high_mm))
        self._send_map("difference", estimate.time_s, difference_um, (-span_um, span_um))
        self._send_map("uncertainty", estimate.time_s, sigma_um, (0.0, sigma_max_um))
        legend = (
            "| map | blue | red |\n|---|---|---|\n"
            f"| height, mm | {low_mm:.3f} | {high_mm:.3f} |\n"
            f"| difference to the first, um | {-span_um:.3f} | {span_um:.3f} |\n"
            f"| uncertainty (1 sigma), um | 0 | {sigma_max_um:.4f} |\n\n"
            f"cycle {estimate.cycle} ({estimate.kind}): sag {estimate.sag_um / 1e3:.4f} mm "
            f"± {estimate.sag_sigma_um:.3f} um, slope residual {estimate.slope_residual_urad:.2f} urad, "
            f"{100 * estimate.valid_fraction:.1f} % valid, {estimate.verdict} {estimate.reason}"
        )
        self._recording.log("/shape/legend", estimate.time_s, rr.TextDocument(legend, media_type="text/markdown"))

    def _send_map(self, kind: str, time_s: float, values: NDArray[np.float32], span: tuple[float, float]) -> None:
        # NaN is drawn like the lowest value: a mask lies over it (`outside`, sent once a file)
        picture = rr.DepthImage(values, colormap="turbo", depth_range=span)
        self._recording.log(f"/shape/map/{kind}", time_s, picture)


def _quality(estimate: ShapeEstimate) -> dict[Stream, list[float]]:
    return {
        RESIDUAL: [estimate.slope_residual_urad],
        QUALITY: [estimate.valid_fraction, estimate.saturated_fraction],
        MODULATION: [estimate.modulation_median_adu],
        LATENCY: [estimate.latency_s * 1e3],
    }


def _figure(estimate: ShapeEstimate, reference: ShapeEstimate) -> dict[Stream, list[float]]:
    change_um = estimate.coeffs_um - reference.coeffs_um
    sag_um, sigma_um = estimate.sag_um - reference.sag_um, estimate.sag_sigma_um
    laser_um = estimate.displacement_um - reference.displacement_um
    return {
        ZERNIKE: list(estimate.coeffs_um),
        CHANGE: [float(change_um[j - 1]) for j in LOW_ORDERS],
        SAG: [sag_um, sag_um + sigma_um, sag_um - sigma_um, laser_um],
    }
