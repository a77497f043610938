"""Program for a changed source: live cycles and tracked frames of one film; prints their figures as
JSON.

The film has terms up to Noll 21, so that every supported number of terms represents it, and every
number of terms sees the same frames.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from membrane_ctrl.config.schema import CameraConfig, OpticsConfig
from membrane_ctrl.metrology.cycle.live_reconstructor import LiveReconstructor
from membrane_ctrl.metrology.phase.pattern_sequence import fringe_sequence, full_sequence
from membrane_ctrl.metrology.tracking.live_tracker import LiveTracker
from membrane_ctrl.model.shape_estimate import ShapeEstimate, pack_estimate, unpack_estimate
from membrane_ctrl.sim.optics.camera import OpticsRenderer
from membrane_ctrl.sim.optics.film_shape import FilmShape

SHRINK = 8
OPTICS = OpticsConfig(
    camera=CameraConfig(width_px=2448 // SHRINK, height_px=2048 // SHRINK, pixel_um=3.45 * SHRINK)
)
FILM = FilmShape(
    37.1,
    zernike_um=(0, 0, 0, 0, 200, -150, 80, -40, 30, 20, 5, -3, -4, 3, 6, 2, -1, 1.5, -2, 1, 0.5),
)
MOVED_UM = (0.0, 30.0, -12.0)
FRAMES, RATE_HZ, PERIODS, STEP_S = 12, 4.0, 32, 1.0


def figure(estimate: ShapeEstimate) -> dict[str, Any]:
    """What the test compares; the estimate crosses as a message first."""
    received = unpack_estimate(pack_estimate(estimate))
    return {
        "verdict": received.verdict,
        "reason": received.reason,
        "sag_um": received.sag_um,
        "sag_change_sigma_um": received.sag_change_sigma_um,
        "coeffs_um": received.coeffs_um.tolist(),
        "sigma_um": np.sqrt(np.diag(received.covariance_um2)).tolist(),
    }


def live_figures() -> list[dict[str, Any]]:
    """A full cycle and two that carry its fringe orders on."""
    renderer, live, out = OpticsRenderer(OPTICS, FILM, seed=5), LiveReconstructor(OPTICS, 1), []
    for number, moved_um in enumerate(MOVED_UM):
        patterns = full_sequence(OPTICS.pattern) if number == 0 else fringe_sequence(OPTICS.pattern)
        frames = [renderer.render_picture(pattern, moved_um).copy() for pattern in patterns]
        reconstruct = live.measure_full if number == 0 else live.measure_fringes
        times_s = 10.0 * number + 0.1 * np.arange(len(patterns))
        out.append(figure(reconstruct(frames, times_s, np.full(len(patterns), moved_um))))
    return out


def tracked_figures() -> list[dict[str, Any]]:
    """Frames of a crossed pattern after a full cycle."""
    renderer = OpticsRenderer(OPTICS, FILM, seed=6)
    tracker = LiveTracker(OPTICS, LiveReconstructor(OPTICS, 1), PERIODS, STEP_S, exposure_s=0.02)
    patterns = full_sequence(OPTICS.pattern)
    frames = [renderer.render_picture(pattern, 0.0).copy() for pattern in patterns]
    tracker.measure_full(frames, 0.1 * np.arange(len(patterns)), np.zeros(len(patterns)))
    out = []
    for k in range(FRAMES):
        moved_um, time_s = 0.5 * math.sin(k), 3.0 + k / RATE_HZ
        picture = renderer.render_picture(tracker.pattern, moved_um)
        estimate = tracker.measure_fringes([picture], np.array([time_s]), np.array([moved_um]))
        out.append({**figure(estimate), "moved_um": moved_um})
    return out


if __name__ == "__main__":
    print(json.dumps({"live": live_figures(), "tracked": tracked_figures()}))
