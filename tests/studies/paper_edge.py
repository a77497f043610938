"""What explains the paper's 3 mm at the edge of the mirror: prints the table of
docs/measurements/paper-edge.md.

The paper compares the profile, averaged over azimuth, with Hencky's film without pre-strain and
finds about 3 mm (10 %) at the edge. The size was read off a figure, and the paper states neither
its sign nor the film's modulus: these are drawn. `python -m tests.studies.paper_edge`.
"""

from __future__ import annotations

import numpy as np

from membrane_ctrl.metrology.film.film_law import FilmLaw, HarmonicCause

RADIUS_MM, EDGE_MM, PRESSURE_PA = 500.0, 475.0, 600.0
STIFFNESS_N_PER_M, POISSON = 2.05e5, 0.3  # Hencky's film of the paper: 50 µm of 4.1 GPa
# 1 sigma of what is drawn: "about 3 mm" of a figure; modulus and thickness of a makers' table
# (490 and 510 kg/mm2, 50 µm within 4 %); Poisson ratio 0.30 to 0.38; 1 % of pressure
STEP_MM, STEP_SIGMA_MM = 3.0, 0.5
STIFFNESS_SIGMA, PRESSURE_SIGMA = 0.06, 0.01
POISSONS = (0.30, 0.40)
DRAWS = 300
STRAINS = np.linspace(-2.4e-3, 3e-3, 28)
WAVE_CAUSES: tuple[tuple[HarmonicCause, int, str, float, str], ...] = (
    ("modulus", 2, "moduli apart, of their mean", 100.0, "%"),
    ("shear", 4, "shear modulus off that of an isotropic film", 100.0, "%"),
    ("prestrain", 2, "pre-strain varies, two waves", 1e6, "µm/m"),
    ("flat", 2, "ring not flat, two waves", 1.0, "mm"),
    ("round", 2, "ring not round, two waves", 1.0, "mm"),
)


def edge_mm(strain: float, poisson: float, stiffness: float, pressure_pa: float) -> float:
    """Height of the round film over its vertex at the edge."""
    bowl = FilmLaw(strain, poisson, stiffness, RADIUS_MM).under_pressure(pressure_pa)
    return float(bowl.height_mm(np.array(EDGE_MM / RADIUS_MM)))


def find_strain(wanted_mm: float, poisson: float, stiffness: float, pressure_pa: float) -> float:
    """Pre-strain at which the edge is this much above Hencky's; NaN if none of those tried is."""
    hencky_mm = edge_mm(0.0, POISSON, STIFFNESS_N_PER_M, PRESSURE_PA)
    law = FilmLaw(STRAINS[:, None], poisson, stiffness, RADIUS_MM)
    bowls = law.under_pressure(pressure_pa)
    edges_mm = bowls.height_mm(np.array([EDGE_MM / RADIUS_MM])).ravel() - hencky_mm
    if not edges_mm.min() <= wanted_mm <= edges_mm.max():
        return float("nan")
    return float(np.interp(-wanted_mm, -edges_mm, STRAINS))


def describe(values: np.ndarray, scale: float, unit: str) -> str:
    """Median and 95 % interval."""
    low, middle, high = np.nanquantile(scale * values, (0.025, 0.5, 0.975))
    found = 100 * np.mean(np.isfinite(values))
    interval = f"{middle:.3g} (95 %: {low:.3g} to {high:.3g}) {unit}"
    return f"{interval}, possible in {found:.0f} % of draws"


def main() -> None:
    """Print the table."""
    rng = np.random.default_rng(1)
    hencky_mm = edge_mm(0.0, POISSON, STIFFNESS_N_PER_M, PRESSURE_PA)
    print(f"Hencky's film at {EDGE_MM:g} mm: {hencky_mm:.3f} mm")
    # 1. Round causes, of either sign
    for sign, name in ((-1.0, "3 mm shallower"), (1.0, "3 mm deeper")):
        strains, softer = [], []
        for _ in range(DRAWS):
            wanted_mm = sign * rng.normal(STEP_MM, STEP_SIGMA_MM)
            poisson = rng.uniform(*POISSONS)
            stiffness = STIFFNESS_N_PER_M * np.exp(rng.normal(0, STIFFNESS_SIGMA))
            pressure_pa = PRESSURE_PA * (1 + rng.normal(0, PRESSURE_SIGMA))
            strains.append(find_strain(wanted_mm, poisson, stiffness, pressure_pa))
            # With the stiffness alone: sag goes with its inverse cube root
            softer.append((1 + wanted_mm / hencky_mm) ** -3)
        print(f"{name}: pre-strain {describe(np.array(strains), 1e6, 'µm/m')}")
        print(f"{name}: ring wider by {describe(np.array(strains), RADIUS_MM, 'mm in radius')}")
        print(f"{name}: modulus alone, times {describe(np.array(softer), 1.0, '')}")
    # 2. How far what is known moves the edge by itself
    for name, changed in (
        ("stiffness 6 % lower", (0.0, POISSON, STIFFNESS_N_PER_M / 1.06, PRESSURE_PA)),
        ("nu 0.38 for 0.30", (0.0, 0.38, STIFFNESS_N_PER_M, PRESSURE_PA)),
        ("pressure 1 % higher", (0.0, POISSON, STIFFNESS_N_PER_M, 1.01 * PRESSURE_PA)),
        ("pre-strain 1000 µm/m", (1e-3, POISSON, STIFFNESS_N_PER_M, PRESSURE_PA)),
    ):
        print(f"{name}: {edge_mm(*changed) - hencky_mm:+.3f} mm")
    # 3. What varies with azimuth: nothing of the mean; so much for 3 mm along one azimuth
    bowl = FilmLaw(0.0, POISSON, STIFFNESS_N_PER_M, RADIUS_MM).under_pressure(PRESSURE_PA)
    rho = EDGE_MM / RADIUS_MM
    for cause, order, name, scale, unit in WAVE_CAUSES:
        response_mm = float(rho**order * bowl.harmonic(order, cause)(rho**2))
        print(f"{name}: 3 mm at the crest for {scale * abs(STEP_MM / response_mm):.3g} {unit}")


if __name__ == "__main__":
    main()
