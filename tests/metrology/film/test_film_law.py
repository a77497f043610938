"""The film's law against an integrated differential equation, an energy in Cartesian coordinates,
and its limits.
"""

from __future__ import annotations

import numpy as np
import pytest

from membrane_ctrl.metrology.film.film_law import FilmLaw, HarmonicCause
from tests.support.film_world import FloatArray, MinimalFilm, Ring
from tests.support.metrology_truth import film_solution, hencky_depth

RHO = np.linspace(0, 1, 41)
STIFFNESS = 2.05e5  # 50 µm of 4.1 GPa
RADIUS_MM = 500.0


@pytest.mark.parametrize(
    ("prestrain", "poisson", "pressure_pa"),
    [
        (0.0, 0.3, 600.0),
        (1e-3, 0.3, 600.0),
        (2e-5, 0.45, 300.0),
        (3e-2, 0.2, 900.0),
        (-4e-4, 0.1, 500.0),
    ],
)
def test_bowl_solves_the_differential_equation(
    prestrain: float, poisson: float, pressure_pa: float
) -> None:
    law = FilmLaw(prestrain, poisson, STIFFNESS, RADIUS_MM)
    bowl = law.under_pressure(pressure_pa)
    load = pressure_pa * 0.5 / STIFFNESS
    strain = prestrain / load ** (2 / 3)
    sag_mm = RADIUS_MM * load ** (1 / 3) * film_solution(strain, poisson).y[2, -1] / 2
    assert float(bowl.sag_mm) == pytest.approx(sag_mm, rel=1e-9)
    assert bowl.height_mm(RHO) == pytest.approx(
        sag_mm * hencky_depth(RHO, strain, poisson), abs=1e-9 * sag_mm
    )


def test_the_sag_alone_gives_the_same_film_as_the_pressure() -> None:
    law = FilmLaw(3e-4, 0.38, STIFFNESS, RADIUS_MM)
    under = law.under_pressure(np.array([[350.0], [600.0], [900.0]]))
    with_sag = law.with_sag(under.sag_mm)
    assert law.pressure_pa(with_sag) == pytest.approx(law.pressure_pa(under), rel=1e-11)
    assert with_sag.height_mm(RHO) == pytest.approx(under.height_mm(RHO), abs=1e-11)


def test_a_drum_is_a_paraboloid_of_the_linear_membrane() -> None:
    """p a^2 / (4 N) with N = E t e / (1 - nu); the next term is of the order of q^(2/3) / e."""
    law = FilmLaw(0.3, 0.35, STIFFNESS, RADIUS_MM)
    bowl = law.under_pressure(0.1)
    linear_mm = 0.1 * 0.25 / (4 * STIFFNESS * 0.3 / 0.65) * 1e3
    assert bowl.height_mm(RHO) == pytest.approx(linear_mm * RHO**2, rel=1e-6)


def test_forces_balance_the_pressure() -> None:
    """Inside any radius the film's pull along z carries the load: 2 r N_r h' = p r^2."""
    law = FilmLaw(2e-4, 0.3, STIFFNESS, RADIUS_MM)
    bowl = law.under_pressure(640.0)
    radial, hoop = bowl.stresses(RHO)
    pull = 2 * radial * STIFFNESS * bowl.rise_mm(RHO) / RADIUS_MM
    assert pull == pytest.approx(640.0 * 0.5 * RHO, rel=1e-12)
    assert hoop[1:-1] == pytest.approx(np.gradient(RHO * radial, RHO)[1:-1], rel=2e-3)


def test_a_film_that_no_ring_holds_is_refused() -> None:
    with pytest.raises(ValueError, match="slack at its ring"):
        FilmLaw(-6e-3, 0.3, STIFFNESS, RADIUS_MM).under_pressure(600.0)
    with pytest.raises(ValueError, match=r"poisson = 0.6 is outside 0 .. 0.5"):
        FilmLaw(0.0, 0.6, STIFFNESS, RADIUS_MM)


def test_disturbances_of_the_ring() -> None:
    """Of the minimal energy, two films with opposite disturbances: their difference is linear to
    second order.
    """
    law = FilmLaw(4e-4, 0.35, STIFFNESS, RADIUS_MM)
    bowl = law.under_pressure(600.0)
    amounts: dict[tuple[HarmonicCause, int], float] = {
        ("prestrain", 2): 6e-5,
        ("flat", 3): 0.1,
        ("round", 1): 0.5,
    }
    rho, angle = 0.95 * np.sqrt(np.linspace(0, 1, 40)), 2.4 * np.arange(40)

    def film(sign: int) -> FloatArray:
        def ring(cause: HarmonicCause) -> Ring:
            parts = [(order, sign * a) for (of, order), a in amounts.items() if of == cause]
            return lambda at: sum(a * np.cos(order * at) for order, a in parts)

        stretched, flat, wide = ring("prestrain"), ring("flat"), ring("round")
        world = MinimalFilm(
            float(bowl.load),
            0.35,
            lambda a: 4e-4 + stretched(a),
            lambda a: flat(a) / RADIUS_MM,
            lambda a: wide(a) / RADIUS_MM,
        )
        return RADIUS_MM * world.height(rho * np.cos(angle), rho * np.sin(angle))

    expected = sum(
        amount * rho**order * bowl.harmonic(order, cause)(rho**2) * np.cos(order * angle)
        for (cause, order), amount in amounts.items()
    )
    assert np.abs(expected).max() > 0.1
    assert (film(1) - film(-1)) / 2 == pytest.approx(expected, abs=4e-4)
