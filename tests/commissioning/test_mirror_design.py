"""What follows from a mirror's data, against the twin's own solution and the paper's figures."""

from __future__ import annotations

import math

import pytest

from membrane_ctrl.commissioning.guide.mirror_design import (
    PAPER_MIRROR,
    MirrorFacts,
    derive_design,
)
from membrane_ctrl.commissioning.guide.mirror_stages import list_facts
from membrane_ctrl.config.schema import Config
from membrane_ctrl.sim.film import MIRROR_FILM, SETTLED_S
from membrane_ctrl.sim.plant import NOMINAL_UM_PER_ML


def test_the_papers_mirror_has_the_papers_pressure() -> None:
    design = derive_design(PAPER_MIRROR)
    assert design.pressure_pa == pytest.approx(600.0, rel=0.005)
    assert design.volume_l == pytest.approx(41.0, rel=0.01)


def test_the_twin_moves_by_as_much_per_millilitre() -> None:
    assert derive_design(PAPER_MIRROR).um_per_ml == pytest.approx(NOMINAL_UM_PER_ML, rel=0.01)


def test_pressure_of_other_depths_follows_the_twins_film() -> None:
    for sag_mm in (10.0, 20.0, 60.0):
        wanted_pa = (sag_mm / float(MIRROR_FILM.sag_mm_per_root_pa(SETTLED_S))) ** 3
        design = derive_design(PAPER_MIRROR.model_copy(update={"sag_mm": sag_mm}))
        assert design.pressure_pa == pytest.approx(wanted_pa, rel=1e-3)


def test_stress_balances_the_pressure_on_the_film() -> None:
    # The membrane's equation at the vertex of a bowl: 2 N kappa = p, kappa = 4 w0 / (2 a^2) of the
    # same order; a sphere of the same sag gives the stress within the bowl's departure from it.
    facts, design = PAPER_MIRROR, derive_design(PAPER_MIRROR)
    radius_m, sag_m = 0.5e-3 * facts.diameter_mm, 1e-3 * facts.sag_mm
    sphere_m = (radius_m**2 + sag_m**2) / (2 * sag_m)
    sphere_mpa = 1e-6 * design.pressure_pa * sphere_m / (2e-6 * facts.thickness_um)
    assert design.front_stress_mpa == pytest.approx(sphere_mpa, rel=0.15)
    # At one pressure the stress goes with t^(-2/3).
    assert design.back_stress_mpa / design.front_stress_mpa == pytest.approx(5 ** (2 / 3), rel=1e-3)


def test_weather_gains_are_those_of_the_configuration() -> None:
    design, loop = derive_design(PAPER_MIRROR), Config().loop
    assert design.barometer_um_per_pa == pytest.approx(loop.barometer_gain_um_per_pa, rel=0.01)
    assert design.temperature_um_per_k == pytest.approx(loop.temperature_gain_um_per_k, rel=0.01)


def test_limits_are_those_of_the_configuration() -> None:
    design, limits = derive_design(PAPER_MIRROR), Config().limits
    assert design.gauge_max_pa == limits.gauge_pressure_max_pa
    assert design.displacement_min_um == limits.displacement_min_um
    assert design.displacement_max_um == limits.displacement_max_um


def test_a_pump_below_the_leak_never_fills() -> None:
    weak = MirrorFacts(pump_ml_per_s=1.0)
    assert derive_design(weak).pump_reserve > 1.0
    assert math.isinf(derive_design(weak).filling_s)
    assert derive_design(PAPER_MIRROR).filling_s == pytest.approx(7500, rel=0.05)


def test_the_report_lists_the_data_in_words() -> None:
    listed = dict(list_facts(PAPER_MIRROR))
    assert listed["depth of the bowl to hold (sag)"] == "37.1 mm"
    assert listed["Young's modulus of the film"] == "4.1 GPa"
    assert listed["relief valve"] == "none"
    assert listed["kind of pump"] == "diaphragm"
    own = PAPER_MIRROR.model_copy(update={"relief_pa": 900.0, "front_bulge_mm": 63.4})
    assert dict(list_facts(own))["opening pressure of the relief valve"] == "900 Pa"
    assert dict(list_facts(own))["height of the clear film in front"] == "63.4 mm"
    assert not [name for name, _ in list_facts(own) if "_" in name]
