"""A day of climate within a quarter of an hour: how far focus and figure wander, by what is held.

The film's figure follows temperature (+-1 K, 1.5 µm of spherical aberration a kelvin) and humidity
(+-5 %, 0.6 µm a percent [assumed]) at a constant vertex, 96 times faster than in a day, with a
tracker that is four times faster: harder for it than a day. Prints a row of the table of
docs/measurements/control.md.
`python -m tests.studies.held_figure_day focus` runs one of `vertex`, `focus`, `best_fit`.
"""

from __future__ import annotations

import sys

import numpy as np

from membrane_ctrl.config.schema import Config, EstimatorConfig, LoopConfig, ShapeConfig, TwinConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.sim.film import NOMINAL_SAG_MM
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.worlds.changing_film import ChangingFilm, hencky_profile, true_focus_mm

RATE_HZ = 4.0
STARTS_S, DAY_S = 60.0, 900.0
PER_KELVIN_UM, PER_PERCENT_UM = -1.5, -0.61
EVERY_S = 10.0


def spherical_at(now_s: float) -> float:
    """Spherical aberration, µm: the humidity leads the temperature by a sixth of the day."""
    day = 2 * np.pi * max(now_s - STARTS_S, 0.0) / DAY_S
    kelvin = np.sin(day)
    percent = 5.0 * (np.sin(day + np.pi / 3) - np.sin(np.pi / 3))
    return float(PER_KELVIN_UM * kelvin + PER_PERCENT_UM * percent)


def rms_um(sag_um: float, spherical_um: float) -> float:
    """RMS of a change of sag and of spherical aberration over the used aperture, by radii."""
    rho2 = 0.95**2 * (np.arange(2000) + 0.5) / 2000
    change = spherical_um * np.sqrt(5) * (6 * rho2**2 - 6 * rho2) + sag_um * hencky_profile(rho2)
    return float(np.std(change))


def least_rms_um(spherical_um: float) -> float:
    """The least of it over all sags: the limit of one actuator."""
    return min(rms_um(sag_um, spherical_um) for sag_um in np.linspace(-20.0, 20.0, 401))


def main(holds: str) -> None:
    """Run the day and print what wandered."""
    config = Config(
        twin=TwinConfig(start_error_um=-1.0, scenario="quiet", laser_noise_um=1.0),
        loop=LoopConfig.model_validate({"rate_hz": RATE_HZ, "holds": holds}),
        shape=ShapeConfig(mode="track", time_constant_s=10.0),
        estimator=EstimatorConfig(process_value="estimate"),
    )
    bench = VirtualBench(Plant(config.twin, config.pump))
    run = VirtualRun(
        config, bench, zernike_projection(), ChangingFilm(bench, config, 3, spherical_at)
    )
    run._shape_period_s = 1.0
    focus_mm, figure_um, next_s = [], [], STARTS_S
    first_sag_um = 0.0
    sags: list[float] = []
    while run.now_s < STARTS_S + DAY_S:
        commands = ()
        if run.now_s == 0.0:
            commands = (Command("hold", "a study", "it runs"),)
        tick = run.run_tick(commands)
        assert tick is not None
        sags.append(1e3 * NOMINAL_SAG_MM + tick.inputs.truth_displacement_um)
        if run.now_s >= next_s:
            next_s += EVERY_S
            sag_um = float(np.mean(sags[-20:]))
            first_sag_um = first_sag_um or sag_um
            spherical_um = spherical_at(run.now_s - 2.5)
            focus_mm.append(true_focus_mm(sag_um, spherical_um))
            figure_um.append(rms_um(sag_um - first_sag_um, spherical_um))
    change_um = 1e3 * (np.array(focus_mm) - focus_mm[0])
    worst_um = max((spherical_at(at_s) for at_s in np.arange(STARTS_S, run.now_s)), key=abs)
    print(
        f"{holds}: focus {change_um.min():+.1f} to {change_um.max():+.1f} µm, RMS "
        f"{change_um.std():.1f} µm; figure up to {max(figure_um):.2f} µm RMS, "
        f"of which one actuator leaves {least_rms_um(worst_um):.2f}"
    )


if __name__ == "__main__":
    main(sys.argv[1])
