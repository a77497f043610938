"""From SOFAST frames to what each pixel sees on the screen.

SOFAST shows cos(2 pi p s - k pi / 2), s from 1 at column 0 to 0 at the last column, and from 1 at row 0 to 0 at the
last row; its screen coordinates have y the other way round, so the y fraction is 1 - s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.metrology.display import DisplayResponse, ScreenShape
from membrane_ctrl.metrology.facet import Sight
from membrane_ctrl.metrology.multifrequency import Unwrapped, unwrap
from membrane_ctrl.metrology.phase import equal_shifts, phasors, wrapped_phase
from membrane_ctrl.metrology.series_integrity import Series
from membrane_ctrl.metrology.sofast import STEPS, SofastCamera, SofastMeasurement

FloatArray = NDArray[np.float64]

SHIFTS_RAD = -equal_shifts(STEPS)
_LIT_SHARE = 0.3  # of the swing of the bright pixels


@dataclass(frozen=True)
class Decoded:
    """Screen positions of N pixels along both axes."""

    x: Unwrapped
    y: Unwrapped

    @property
    def screens(self) -> FloatArray:
        """Fractions of the screen, (2, N), in SOFAST's sense."""
        return np.stack([self.x.screens, 1 - self.y.screens])

    @property
    def consistent(self) -> NDArray[np.bool_]:
        """Pixels whose frequencies agree on both axes."""
        return self.x.consistent & self.y.consistent


def lit_pixels(measurement: SofastMeasurement) -> NDArray[np.bool_]:
    """Pixels (H, W) that see fringes: the median over the series of their swing, which no single frame can spoil."""
    series = (*measurement.frames_y, *measurement.frames_x)
    swing = np.median([np.abs(phasors(steps, SHIFTS_RAD)) for steps in series], axis=0)
    return np.asarray(swing > _LIT_SHARE * np.percentile(swing, 95))


def series_of(measurement: SofastMeasurement, mask: NDArray[np.bool_]) -> tuple[Series, Series]:
    """The axes of a measurement at the pixels in `mask`, in the order in which they were taken."""
    return (
        Series("y", measurement.frames_y[..., mask], measurement.periods_y, SHIFTS_RAD),
        Series("x", measurement.frames_x[..., mask], measurement.periods_x, SHIFTS_RAD),
    )


def wrapped_phases(
    measurement: SofastMeasurement, mask: NDArray[np.bool_], response: DisplayResponse | None
) -> tuple[FloatArray, FloatArray]:
    """Wrapped phases (F, N) along x and y of the pixels in `mask`; frames as seen if there is no response."""
    black, white = measurement.black[mask], measurement.white[mask]

    def phases(frames: FloatArray) -> FloatArray:
        seen = frames[..., mask]
        shown = seen if response is None else response.shown_levels(seen, black, white)
        return np.stack([wrapped_phase(phasors(steps, SHIFTS_RAD)) for steps in shown])

    return phases(measurement.frames_x), phases(measurement.frames_y)


def decode(measurement: SofastMeasurement, mask: NDArray[np.bool_], response: DisplayResponse | None) -> Decoded:
    """Screen positions of the pixels in `mask`, in reading order."""
    along_x, along_y = wrapped_phases(measurement, mask, response)
    return Decoded(unwrap(along_x, measurement.periods_x), unwrap(along_y, measurement.periods_y))


def sight(decoded: Decoded, mask: NDArray[np.bool_], camera: SofastCamera, screen: ScreenShape) -> Sight:
    """What the pixels of `mask` see, those left out whose frequencies disagree or that look past the screen."""
    rows_px, columns_px = (index.astype(float) for index in np.nonzero(mask))
    screen_mm = screen.screen_mm(decoded.screens)
    good = decoded.consistent & np.isfinite(screen_mm).all(axis=0)
    return Sight(columns_px[good], camera.square_rows(rows_px[good]), screen_mm[:, good])
