"""Errors of tracked figures of simulated crossed fringes, against the reference measured by
`measure`.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from membrane_ctrl.cli import run
from membrane_ctrl.metrology.numerics import zernike
from tests.worlds.crossed_fringes import RADIUS_MM, Array, CrossedWorld

# One change of the world each; 0 switches an effect off.
CLEAN = {
    "drift_um_per_s": 0.0,
    "swing_um": 0.0,
    "shimmer_um": 0.0,
    "brightness": 0.0,
    "ambient_adu": 0.0,
    "bend": 0.0,
    "dim_per_s": 0.0,
    "dust": 0,
    "air_um": 0.0,
}
MOVING = {"swing_um": 0.3, "shimmer_um": 0.1, "drift_um_per_s": 0.002}
SIZE = {"width": 245, "height": 205, "pixel_um": 34.5}


@dataclass(frozen=True)
class TrackedErrors:
    """Errors of the m frames that have a figure, and their error bars;
    a verdict for every frame.

    The bars for changes are those of a bench that does not move.
    """

    time_s: Array  # (m,)
    sag_um: Array  # (m,)
    sag_sigma_um: Array
    sag_change_sigma_um: Array
    terms_um: Array  # (m, terms - 1): all terms but piston
    terms_sigma_um: Array
    steady_terms_sigma_um: Array
    verdicts: tuple[str, ...]
    reasons: tuple[str, ...]
    given: NDArray[np.bool_]  # (frames,): which have a figure

    @property
    def ok_share(self) -> float:
        """Of the frames."""
        return self.verdicts.count("ok") / len(self.verdicts)

    @property
    def sag(self) -> Array:
        """Errors of the sag in their own steady sigmas."""
        return np.asarray(self.sag_um / self.sag_change_sigma_um)

    @property
    def terms(self) -> Array:
        """Errors of the terms in their own steady sigmas."""
        return np.asarray(self.terms_um / self.steady_terms_sigma_um)

    @property
    def moved_sag(self) -> Array:
        """Errors of the sag in their own sigmas, on a bench that may have moved."""
        return np.asarray(self.sag_um / self.sag_sigma_um)

    @property
    def moved_terms(self) -> Array:
        """Errors of the terms in their own sigmas, on a bench that may have moved."""
        return np.asarray(self.terms_um / self.terms_sigma_um)


def errors_of(
    world: CrossedWorld, folder: Path, time_s: Array, step_every_s: float
) -> TrackedErrors:
    """Make a reference and a tracking set, run both commands, compare."""
    world.write_reference(folder / "full")
    world.write_track(folder / "track", time_s, step_every_s)
    assert run(["measure", str(folder / "full"), "--no-pictures"]) == 0
    assert run(["track", str(folder / "track"), "--no-pictures"]) == 0
    return compared(world, folder)


def compared(world: CrossedWorld, folder: Path) -> TrackedErrors:
    """The results of both commands against the world's truth."""
    result, details = (
        json.loads((folder / f"full/result/{name}.json").read_text())
        for name in ("result", "details")
    )
    found = np.load(folder / "track/result/track.npz")
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-0.95, 0.95, 41)] * 2))
    inside = np.hypot(x, y) <= 0.95
    azimuth = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    x, y = (np.append(a[inside], b) for a, b in ((x, np.cos(azimuth)), (y, np.sin(azimuth))))
    before_um = world.height_um(0.0, RADIUS_MM * x, RADIUS_MM * y)
    moved_um = np.array(
        [world.height_um(t, RADIUS_MM * x, RADIUS_MM * y) - before_um for t in found["time_s"]]
    )
    heights_um, rim_um = np.split(moved_um, [-azimuth.size], axis=1)
    columns = zernike.evaluate_terms(x, y).T[: -azimuth.size]
    true_um = np.linalg.lstsq(columns, heights_um.T, rcond=None)[0].T
    error_um = found["coeffs_um"] - np.array(result["zernike"]["coeffs_um"]) - true_um
    given = np.isfinite(
        found["sag_um"]
    )  # rejected frames have no figure, and count in the share that is ok
    return TrackedErrors(
        found["time_s"][given],
        (found["sag_um"] - 1e3 * details["sag_mm"] - rim_um.mean(axis=1))[given],
        found["sag_sigma_um"][given],
        found["sag_change_sigma_um"][given],
        error_um[given, 1:],
        found["sigma_um"][given, 1:],
        found["change_sigma_um"][given, 1:],
        tuple(found["verdict"].tolist()),
        tuple(found["reason"].tolist()),
        given,
    )


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
