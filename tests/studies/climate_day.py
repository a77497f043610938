"""A day of the twin's climate in virtual time: how far focus and figure wander, by what is held.

The room has +-2 K and +-10 % of humidity (`[twin] climate = "day"`); film and ring are strained as
`sim.climate` has it. Figures come once a minute with 10 nm of noise a term; the truth is integrated
from the profiles of the twin's film, by no code of the product.

`python -m tests.studies.climate_day focus` runs one of `vertex`, `focus`, `best_fit` for 24 hours.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from membrane_ctrl.config.schema import (
    Config,
    EstimatorConfig,
    LoopConfig,
    ShapeConfig,
    TwinConfig,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.arrays import FloatArray
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.model.zernike_terms import ZERNIKE_TERMS
from membrane_ctrl.sim.climate import POISSON_RATIO
from membrane_ctrl.sim.film import NOMINAL_SAG_MM, RADIUS_MM
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.stretched_film import solve_stretched_film
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.changing_film import best_sphere_focus_mm, hencky_profile, radii_mm

TERM_SIGMA_UM = 0.01
FIGURE_EVERY_S = 60.0
JUDGE_EVERY_S = 300.0
SETTLED_S = 600.0  # from the start until the reference is complete
_STEP = 2e-5  # of the strain, for the derivative of the profile
_SAGS_UM = np.linspace(-30.0, 30.0, 601)  # searched for the limit of one actuator


@dataclass(frozen=True)
class ClimateDay:
    """What wandered.

    Attributes
    ----------
    hours : (n,) array
    focus_um : (n,) array
        Change of the focus since the reference.
    figure_um : (n,) array
        RMS change of the figure over the used aperture.
    least_um : (n,) array
        What the best sag would leave of it: the limit of one actuator.
    centre_um : (n,) array
        Change of the centre.
    excess_ppm : (n,) array
        Strain of the film over that of its ring, since the reference.
    faults : tuple of str
    """

    hours: FloatArray
    focus_um: FloatArray
    figure_um: FloatArray
    least_um: FloatArray
    centre_um: FloatArray
    excess_ppm: FloatArray
    faults: tuple[str, ...]


@cache
def profile_change_um() -> FloatArray:
    """Change (n,) of the height at `radii_mm` for an excess of 1e-6, with vertex and rim held."""
    depth = NOMINAL_SAG_MM / RADIUS_MM
    v = (radii_mm() / RADIUS_MM) ** 2
    heights = []
    for strain in (-_STEP, _STEP):
        profile = solve_stretched_film(depth, strain, POISSON_RATIO)[1]
        bowl = np.polynomial.polynomial.polyval(v, profile) - profile[0]
        heights.append(bowl / (profile.sum() - profile[0]))
    return np.asarray(1e3 * NOMINAL_SAG_MM * (heights[0] - heights[1]) / (2 * _STEP) * 1e-6)


class NoisyFigures:
    """The twin's figures once a minute, with noise of each term."""

    def __init__(self, bench: VirtualBench, config: Config, seed: int) -> None:
        self._source = TruthShape(bench, config, seed)
        self._rng = np.random.default_rng(seed)

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        """One figure."""
        figure = self._source(now_s)
        if figure is None:
            return None
        noise_um = TERM_SIGMA_UM * self._rng.normal(size=ZERNIKE_TERMS)
        noise_um[0] = 0.0
        return replace(
            figure,
            coeffs_um=figure.coeffs_um + noise_um,
            covariance_um2=figure.covariance_um2 + TERM_SIGMA_UM**2 * np.eye(ZERNIKE_TERMS),
        )


def run_climate_day(holds: str, hours: float, rate_hz: float = 2.0, seed: int = 3) -> ClimateDay:
    """Hold the twin through a part of a day."""
    config = Config(
        twin=TwinConfig(scenario="quiet", climate="day", seed=seed, laser_noise_um=1.0),
        loop=LoopConfig.model_validate(
            {"rate_hz": rate_hz, "measurement_filter_s": 1 / rate_hz, "holds": holds}
        ),
        shape=ShapeConfig(mode="cycle", period_s=FIGURE_EVERY_S, fresh_s=4 * FIGURE_EVERY_S),
        estimator=EstimatorConfig(process_value="estimate"),
    )
    bench = VirtualBench(Plant(config.twin, config.pump))
    run = VirtualRun(config, bench, zernike_projection(), NoisyFigures(bench, config, seed))
    rows: list[tuple[float, float, float]] = []
    faults: list[str] = []
    sags_um: list[float] = []
    judged_s = SETTLED_S
    command = (Command("hold", "a study", "it runs"),)
    while run.now_s < SETTLED_S + 3600 * hours and run.finished is None:
        tick = run.run_tick(command)
        command = ()
        assert tick is not None
        faults += [event.name for event in tick.events if isinstance(event, Fault)]
        truth = bench.plant.truth()
        sags_um.append(1e3 * truth.sag_mm)
        if run.now_s >= judged_s:
            judged_s += JUDGE_EVERY_S
            last = sags_um[-int(20 * rate_hz) :]
            rows.append((run.now_s, float(np.mean(last)), truth.excess_strain_ppm))
            sags_um = []
    return _judge(np.array(rows).T, tuple(faults))


def _judge(rows: FloatArray, faults: tuple[str, ...]) -> ClimateDay:
    """Scalars of the true figures: time, sag and excess strain, (3, n)."""
    time_s, sag_um, excess_ppm = rows
    rho2 = (radii_mm() / RADIUS_MM) ** 2
    bowl = hencky_profile(rho2)
    heights_um = sag_um[:, None] * bowl + excess_ppm[:, None] * profile_change_um()
    focus_um = np.array([1e3 * best_sphere_focus_mm(1e-3 * height) for height in heights_um])
    change_um = heights_um - heights_um[0]
    # Over area: the rings are even in radius
    area = radii_mm() / radii_mm().sum()
    centred = change_um - (change_um @ area)[:, None]
    bowl_centred = bowl - bowl @ area
    along = (centred * area) @ bowl_centred / (area @ bowl_centred**2)
    left = centred - along[:, None] * bowl_centred
    return ClimateDay(
        hours=(time_s - time_s[0]) / 3600,
        focus_um=focus_um - focus_um[0],
        figure_um=np.sqrt(centred**2 @ area),
        least_um=np.sqrt(left**2 @ area),
        centre_um=sag_um - sag_um[0],
        excess_ppm=excess_ppm - excess_ppm[0],
        faults=faults,
    )


def describe(holds: str, day: ClimateDay) -> str:
    """A row of the table of docs/measurements/climate.md."""
    worst = int(np.argmax(day.least_um))
    return (
        f"| {holds} | {day.focus_um.min():+.1f} to {day.focus_um.max():+.1f} µm "
        f"({day.focus_um.std():.1f} µm RMS) | {day.centre_um.min():+.2f} to "
        f"{day.centre_um.max():+.2f} µm | up to {day.figure_um.max():.2f} µm RMS "
        f"| {day.figure_um[worst]:.3f} of which one actuator leaves {day.least_um[worst]:.3f} µm |"
    )


if __name__ == "__main__":
    holds, hours = sys.argv[1], float((*sys.argv[2:], 24.0)[0])
    found = run_climate_day(holds, hours)
    print(
        describe(holds, found),
        f"{found.hours[-1]:.1f} h; faults: {found.faults}; "
        f"excess {np.ptp(found.excess_ppm):.1f}e-6",
    )
