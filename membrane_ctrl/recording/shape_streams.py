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

# A map is 53 kB on the disk: one difference each minute is 76 MB a day. Nothing is lost, as the coefficients of
# every cycle are there, from which any map can be made again. In the first minutes somebody is looking.
DIFFERENCE_INTERVAL_S = 60.0
DIFFERENCE_EARLY_S, EARLY_S = 10.0, 300.0
MAP_INTERVAL_S = 600.0
# The colours of the difference map span at least this, so that noise does not look like a figure.
_DIFFERENCE_LEAST_UM = 0.5


class ShapeStreams:
    """Sends estimates to a recording. Changes are against the first estimate since `rebase` that was not rejected.

    Attributes
    ----------
    reference : ShapeEstimate or None
        That estimate.
    pictures : bool
        Whether maps are sent.
    """

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self.reference: ShapeEstimate | None = None
        self.pictures = True
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._colours: dict[str, tuple[float, float]] = {}
        self._verdict = ""

    def start_segment(self) -> None:
        """Say again in a new file what holds until it changes."""
        self._next_map_s = -math.inf
        self._next_difference_s = -math.inf
        self._verdict = ""

    def rebase(self) -> None:
        """Take the next estimate as the reference, and show the maps against it at once."""
        self.reference = None
        self._next_difference_s = -math.inf

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
        self.reference = self.reference or estimate
        for stream, values in _figure(estimate, self.reference).items():
            self._recording.scalars(stream.path, time_s, np.array([values]))
        change_um = (estimate.coeffs_um - self.reference.coeffs_um)[1:]
        bars = rr.BarChart(change_um, abscissa=np.arange(2, 37))
        self._recording.log("/shape/change_bars", estimate.time_s, bars)
        if self.pictures:
            self._send_maps(estimate, self.reference)

    def _send_maps(self, estimate: ShapeEstimate, reference: ShapeEstimate) -> None:
        time_s = estimate.time_s
        if time_s >= self._next_map_s:
            self._next_map_s = time_s + MAP_INTERVAL_S
            height_mm = height_map_mm(estimate)
            sigma_um = uncertainty_map_um(estimate.covariance_um2)
            self._send_map("height", time_s, height_mm, "mm", _span(height_mm))
            self._send_map("uncertainty", time_s, sigma_um, "um, 1 sigma", (0.0, _span(sigma_um)[1]))
        if time_s >= self._next_difference_s:
            early = time_s - reference.time_s < EARLY_S
            self._next_difference_s = time_s + (DIFFERENCE_EARLY_S if early else DIFFERENCE_INTERVAL_S)
            difference_um = difference_map_um(estimate, reference)
            most_um = max(_DIFFERENCE_LEAST_UM, *(abs(end) for end in _span(difference_um)))
            self._send_map("difference", time_s, difference_um, "um", (-most_um, most_um))
            legend = _legend(estimate, self._colours)
            self._recording.log("/shape/legend", time_s, rr.TextDocument(legend, media_type="text/markdown"))

    def _send_map(
        self, kind: str, time_s: float, values: NDArray[np.float32], unit: str, span: tuple[float, float]
    ) -> None:
        # NaN is drawn like the lowest value: a mask lies over it (`outside`, sent once a file)
        picture = rr.DepthImage(values, colormap="turbo", depth_range=span)
        self._recording.log(f"/shape/map/{kind}", time_s, picture)
        self._colours[f"{kind}, {unit}"] = span


def _span(values: NDArray[np.float32]) -> tuple[float, float]:
    return float(np.nanmin(values)), float(np.nanmax(values))


def _legend(estimate: ShapeEstimate, colours: dict[str, tuple[float, float]]) -> str:
    """Markdown: what the maps' colours mean, and the cycle in one line each."""
    rows = "\n".join(f"| {name} | {low:.4g} | {high:.4g} |" for name, (low, high) in colours.items())
    reason = f" ({estimate.reason})" if estimate.reason else ""
    of_geometry = estimate.geometry_sag_sigma_um
    geometry = f", ± {of_geometry:.3g} um of the geometry" if math.isfinite(of_geometry) else ""
    return (
        f"| map | blue | red |\n|---|---|---|\n{rows}\n\n"
        f"- cycle {estimate.cycle}, {estimate.kind}: {estimate.verdict}{reason}\n"
        f"- sag {estimate.sag_um / 1e3:.4f} mm ± {estimate.sag_sigma_um:.3f} um of noise{geometry}\n"
        f"- slope residual {estimate.slope_residual_urad:.2f} urad, {100 * estimate.valid_fraction:.1f} % valid\n"
    )


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
