"""Temperature and humidity over a run, and the change of the figure that they predict."""

from dataclasses import dataclass

import numpy as np

from membrane_ctrl.metrology.film.climate_figure import compute_climate_sensitivity
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.run_files.run import Run

_LAST_S = 60.0  # of the run: the strains and the error at its end are those of this time
_SPHERICAL = 11  # Noll index
_STRAINS = ("film_strain_ppm", "ring_strain_ppm", "climate_sigma_um")
_SENSORS = {
    "film": "film_temperature_c",
    "ring": "ring_temperature_c",
    "humidity": "humidity_percent",
}


@dataclass(frozen=True)
class ClimateReview:
    """The climate of a run.

    Attributes
    ----------
    time_s : (n,) array
        Of the level's windows.
    film_c, ring_c, humidity_percent : (n,) arrays
        Means; all NaN without the sensor.
    figure_um : (n,) array
        Predicted change of the figure, RMS, since the hold began.
    last_sigma_um : float
        Standard deviation of its last value.
    film_ppm, ring_ppm : float
        Strains at the end, since the hold began.
    spherical_um : float
        Spherical term (Noll 11) that their difference predicts.
    notice_um : float
        Predicted change that raises the notice.
    """

    time_s: FloatArray
    film_c: FloatArray
    ring_c: FloatArray
    humidity_percent: FloatArray
    figure_um: FloatArray
    last_sigma_um: float
    film_ppm: float
    ring_ppm: float
    spherical_um: float
    notice_um: float


def review_climate(run: Run, level: dict[str, FloatArray]) -> ClimateReview | None:
    """Return the climate of a run; None if no sensor showed it.

    Parameters
    ----------
    run : Run
    level : dict of str to (n,) array
        Its overview level (`run_files.levels`).
    """
    # Means of the sensors, and the figure's change that the tick predicted from them.
    unknown = np.full(len(level["time_s"]), np.nan)
    means = {key: level.get(f"mean_{name}", unknown) for key, name in _SENSORS.items()}
    figure_um = np.asarray(level.get("mean_climate_figure_um", unknown), float)
    if not any(np.isfinite(values).any() for values in means.values()):
        return None

    # The strains at the end, from the ticks around the last prediction.
    film_ppm = ring_ppm = sigma_um = float("nan")
    known = np.flatnonzero(np.isfinite(figure_um))
    if known.size:
        end_s = float(level["time_s"][known[-1]])
        blocks = list(run.tick_blocks(_STRAINS, end_s - _LAST_S))
        film_ppm, ring_ppm, sigma_um = (
            _find_last(np.concatenate([np.empty(0), *(block[name] for block in blocks)]))
            for name in _STRAINS
        )

    # The spherical term by the excess strain of the film over its ring (section 1 of
    # docs/explanation/climate.md).
    mirror = run.config.optics.mirror
    terms_um = compute_climate_sensitivity(mirror.radius_mm, mirror.sag_mm).terms_um
    spherical_um = float(terms_um[_SPHERICAL - 1]) * (film_ppm - ring_ppm)
    return ClimateReview(
        time_s=np.asarray(level["time_s"], float),
        film_c=np.asarray(means["film"], float),
        ring_c=np.asarray(means["ring"], float),
        humidity_percent=np.asarray(means["humidity"], float),
        figure_um=figure_um,
        last_sigma_um=sigma_um,
        film_ppm=film_ppm,
        ring_ppm=ring_ppm,
        spherical_um=spherical_um,
        notice_um=run.config.climate.figure_max_um,
    )


def _find_last(values: FloatArray) -> float:
    """The last finite value; NaN without one."""
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    return float(known[-1]) if known.size else float("nan")
