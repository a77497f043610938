"""`climate`: the expansions of film and ring, learned from a run whose figures were measured."""

import json
from pathlib import Path

import numpy as np

from membrane_ctrl.metrology.film.climate_figure import compute_climate_sensitivity
from membrane_ctrl.metrology.film.climate_fit import ClimateFit, Expansion, fit_climate
from membrane_ctrl.model import errors, program
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.review.catalogue import resolve_run
from membrane_ctrl.run_files.run import Run, open_run

_SPHERICAL = 11  # Noll index
_WINDOW_S = 60.0
_LEAST_KNOWN = 0.5  # largest error of an expansion, over itself, that is worth a key
_RING_SIGMA = 0.03  # share by which the configured expansion of a metal may be wrong (assumed)
_SENSORS = ("film_temperature_c", "ring_temperature_c", "humidity_percent")
_KEYS = {
    "film_ppm_per_k": "film_per_k",
    "ring_ppm_per_k": "ring_per_k",
    "film_ppm_per_percent": "film_per_percent",
}


def climate_command(folder: Path, as_json: bool) -> int:
    """Fit the expansions of a run and print them as keys of `[climate]`.

    Parameters
    ----------
    folder : Path
        A run of some hours, held with figures, in which temperature or humidity changed; its
        name, or `last`.
    as_json : bool
        Print one object instead of lines.

    Returns
    -------
    int
        Exit code.

    Raises
    ------
    InputError
        The run has too little for a fit; the message states what.
    """
    run = open_run(resolve_run(folder))
    mirror = run.config.optics.mirror
    sensitivity = compute_climate_sensitivity(mirror.radius_mm, mirror.sag_mm)
    ring_ppm_per_k = run.config.climate.ring_ppm_per_k
    known_ring = None
    if ring_ppm_per_k:
        known_ring = Expansion(ring_ppm_per_k, _RING_SIGMA * abs(ring_ppm_per_k))
    try:
        fit = fit_climate(
            **read_minutes(run),
            sensitivity_um_per_ppm=float(sensitivity.terms_um[_SPHERICAL - 1]),
            known_ring=known_ring,
        )
    except ValueError as error:
        raise errors.InputError(f"{run.name}: {error}") from None
    if as_json:
        print(json.dumps({**program.file_origin("membrane-climate/1"), **_make_table(fit)}))
    else:
        for line in format_fit(fit):
            print(line)
    return 0


def read_minutes(run: Run) -> dict[str, FloatArray]:
    """Minute means of the spherical term and of the climate's sensors, as `fit_climate` takes
    them.
    """
    # The spherical term of each usable figure.
    shapes = run.shapes()
    ok = np.asarray(shapes.verdict) != "rejected"
    shape_s = np.asarray(shapes.time_s)[ok]
    spherical_um = np.asarray(shapes.coeffs_um)[ok, _SPHERICAL - 1]
    names = [f"mean_{name}" for name in _SENSORS]
    level = run.level(_WINDOW_S, names=names)
    time_s = np.asarray(level["time_s"])

    # Means of the figures of each minute; NaN in a minute without one.
    minute = np.searchsorted(time_s, shape_s, side="right") - 1
    counts = np.bincount(np.clip(minute, 0, None), minlength=time_s.size)[: time_s.size]
    sums = np.bincount(np.clip(minute, 0, None), spherical_um, time_s.size)[: time_s.size]
    with np.errstate(invalid="ignore", divide="ignore"):
        means = np.where(counts > 0, sums / counts, np.nan)
    return {
        "time_s": time_s,
        "spherical_um": means,
        "film_c": np.asarray(level[names[0]]),
        "ring_c": np.asarray(level[names[1]]),
        "humidity_percent": np.asarray(level[names[2]]),
    }


def format_fit(fit: ClimateFit) -> list[str]:
    """Lines for people: keys of `[climate]` with their errors."""
    lines = ["[climate]"]
    for key, name in _KEYS.items():
        found: Expansion | None = getattr(fit, name)
        if found is None:
            lines.append(f"# {key}: its cause has changed too little")
        elif found.sigma > _LEAST_KNOWN * abs(found.value):
            lines.append(f"# {key}: not determined, {found.value:.2f} +- {found.sigma:.2f}")
        else:
            lines.append(f"{key} = {found.value:.2f}  # +- {found.sigma:.2f}")
    film_per_k = fit.film_per_k
    if film_per_k is not None and film_per_k.sigma > _LEAST_KNOWN * abs(film_per_k.value):
        lines.append(
            "# film and ring have moved in phase: 14 hours of a day, or a heating that switches "
            "within an hour, separate them"
        )
    film = [
        each
        for each in (fit.film_per_k, fit.film_per_percent)
        if each is not None and each.sigma <= _LEAST_KNOWN * abs(each.value)
    ]
    if film:
        share = max(each.sigma / abs(each.value) for each in film)
        lines.append(f"film_sigma_relative = {min(1.0, max(share, 0.01)):.2f}")
    # The time constant is known as far as the expansion is
    if fit.film_per_percent in film and np.isfinite(fit.follows_humidity_s):
        lines.append(f"film_follows_humidity_s = {fit.follows_humidity_s:.0f}")
    lines.append(
        f"# about a steady drift, the climate explains {fit.explained:.1%} of the spherical "
        f"term's variance; {1e3 * fit.residual_um:.0f} nm remain"
    )
    return lines


def _make_table(fit: ClimateFit) -> dict[str, object]:
    expansions = {
        key: None if found is None else {"value": found.value, "sigma": found.sigma}
        for key, found in ((key, getattr(fit, name)) for key, name in _KEYS.items())
    }
    return {
        **expansions,
        "film_follows_humidity_s": fit.follows_humidity_s,
        "residual_um": fit.residual_um,
        "explained": fit.explained,
    }
