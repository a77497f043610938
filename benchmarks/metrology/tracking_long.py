"""Half an hour of tracking with all disturbances, with a clean screen, and with a camera mount that
expands.

The pictures are those of a world that shares no code with the product
(`tests/worlds/crossed_fringes.py`). Each pixel is the mean of 10 x 10 of the real sensor: 16 bits,
a tenth of its noise.

python -m benchmarks tracking_long
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from tests.studies.tracked_errors import CLEAN, MOVING, SIZE, TrackedErrors, errors_of, rms
from tests.support.figures import Figure, at_most
from tests.worlds.crossed_fringes import CrossedWorld

NOISE_ADU = 0.49  # of the real sensor's pixels
LONG_S, SHORT_S, FRAME_S, STEP_S = 1800.0, 120.0, 1.0, 10.0
ALL = {
    **MOVING,
    "brightness": 0.005,
    "ambient_adu": 2.0,
    "bend": 0.04,
    "dust": 20,
    "air_um": 0.1,
    "dim_per_s": 1e-5,
    "backlight_hz": 1923.0,
    "sticking": 0.02,
    "drum_nm": 5.0,
}
KELVIN = 0.2


def run() -> list[Figure]:
    """All figures."""
    both = {"all disturbances": ALL, "the same, rolling shutter": ALL | {"rolling_s": 0.02}}
    figures = []
    for name, effects in both.items():
        figures += _judged(name, _errors(effects, LONG_S))
    clean = _errors({}, SHORT_S)
    figures.append(at_most("clean screen: figure of a frame", 1e3 * _figure_um(clean), "nm", 15.0))
    figures.append(at_most("clean screen: sag of a frame", 1e3 * rms(clean.sag_um), "nm"))
    grown = _errors({"kelvin": KELVIN}, 300.0)  # a quarter of its swing: from none to all
    return [
        *figures,
        at_most(
            "stand that grows by 60 µm/K: sag", float(grown.sag_um[-20:].mean()) / KELVIN, "um/K"
        ),
    ]


def _errors(effects: dict[str, float], lasts_s: float) -> TrackedErrors:
    setup = SIZE | CLEAN | {"bits": 16, "noise_adu": NOISE_ADU / 10} | effects
    times = 0.5 + np.arange(0.0, lasts_s, FRAME_S)
    with tempfile.TemporaryDirectory() as folder:
        return errors_of(CrossedWorld(seed=1, **setup), Path(folder), times, STEP_S)  # type: ignore[arg-type]


def _judged(name: str, found: TrackedErrors) -> list[Figure]:
    errors = np.column_stack([found.sag_um, found.terms_um])
    drift = np.polyfit(found.time_s / LONG_S, errors, 1)[0]
    ratio = rms(found.terms)
    within = Figure(
        f"{name}: error / sigma of the terms", ratio, "", target="0.8 to 1.3", met=0.8 < ratio < 1.3
    )
    return [
        at_most(
            f"{name}: figure of a frame",
            _figure_um(found),
            "um",
            0.15,
            "1 sigma",
            _stated_um(found),
        ),
        at_most(
            f"{name}: sag of a frame",
            rms(found.sag_um),
            "um",
            0.05,
            "1 sigma",
            rms(found.sag_change_sigma_um),
        ),
        within,
        at_most(f"{name}: error / sigma of the sag", rms(found.sag), ""),
        at_most(f"{name}: drift of the sag in 30 min", abs(float(drift[0])), "um", 0.1),
        at_most(
            f"{name}: drift of the figure in 30 min", float(np.linalg.norm(drift[1:])), "um", 0.1
        ),
        at_most(f"{name}: frames that are not ok", 100.0 * (1 - found.ok_share), "%"),
    ]


def _figure_um(found: TrackedErrors) -> float:
    """Of a frame, RMS over the mirror."""
    return float(np.sqrt(np.mean(np.sum(found.terms_um**2, axis=1))))


def _stated_um(found: TrackedErrors) -> float:
    return float(np.sqrt(np.mean(np.sum(found.steady_terms_sigma_um**2, axis=1))))
