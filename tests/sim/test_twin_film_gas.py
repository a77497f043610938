"""The table of film and gas physics, measured on the integrated twin and not on the formulas behind
it.
"""

from __future__ import annotations

import math

import pytest

from membrane_ctrl.config.schema import PumpConfig, TwinConfig
from membrane_ctrl.sim import film, plant
from membrane_ctrl.sim.bench_events import AirTemperatureChange, AmbientChange, LeakChange
from membrane_ctrl.sim.gas import fill_gas
from membrane_ctrl.sim.hencky import solve_hencky
from membrane_ctrl.sim.plant import Plant

TIGHT_S = 1e8  # trapped gas: the leak moves the centre 0.1 nm/s


def calm(**changes: object) -> TwinConfig:
    return TwinConfig.model_validate({"scenario": "calm", "start_error_um": 0.0} | changes)


def trapped(*events: object) -> Plant:
    bench = Plant(calm(leak_time_constant_s=TIGHT_S), PumpConfig(), events)  # type: ignore[arg-type]
    bench.actuate(0.0, 0.0)
    return bench


def moved_um(bench: Plant, duration_s: float) -> float:
    before = bench.truth().displacement_um
    bench.advance(duration_s)
    return bench.truth().displacement_um - before


def test_hencky_coefficients() -> None:
    assert solve_hencky(0.3).sag == pytest.approx(0.65344, abs=5e-6)
    assert solve_hencky(0.3).volume == pytest.approx(0.5214, abs=5e-5)


@pytest.mark.parametrize(("poisson", "b0"), [(0.2, 1.6827), (0.3, 1.7244), (0.4, 1.7769)])
def test_hencky_against_the_published_power_series(poisson: float, b0: float) -> None:
    # Hencky's series with its published first coefficient b0; the terms beyond the seventh add 1e-4
    series = [1, 1 / 2, 5 / 9, 55 / 72, 7 / 6, 205 / 108, 17051 / 5292]
    total = sum(term * b0 ** -(3 * k + 1) for k, term in enumerate(series))
    assert solve_hencky(poisson).sag == pytest.approx(total, rel=2e-4)


@pytest.mark.parametrize("poisson", [-0.1, 0.6])
def test_hencky_refuses_impossible_material(poisson: float) -> None:
    with pytest.raises(ValueError, match="poisson"):
        solve_hencky(poisson)


def test_sag_volume_and_compliance_of_the_nominal_mirror() -> None:
    truth = Plant(calm(), PumpConfig()).truth()
    assert truth.displacement_um == pytest.approx(0.0, abs=1e-6)
    assert truth.sag_mm == pytest.approx(37.1, abs=0.05)
    assert truth.back_sag_mm == pytest.approx(63.4, abs=0.05)
    assert truth.gauge_pressure_pa == pytest.approx(600.0, abs=1e-6)
    volume_l = 0.5214 * math.pi * 25.0 * (truth.sag_mm + truth.back_sag_mm) * 1e-2
    assert volume_l == pytest.approx(41.2, abs=0.1)
    assert plant.gas_compliance_ml_per_pa() == pytest.approx(23.3, abs=0.05)


def test_centre_per_pascal_and_per_ml_of_gas() -> None:
    bench = trapped()
    before = bench.truth()
    bench.actuate(0.5, 0.0)
    bench.advance(60.0)
    bench.actuate(0.0, 0.0)
    bench.advance(60.0)
    after = bench.truth()
    rise_um = after.displacement_um - before.displacement_um
    assert rise_um / (after.gauge_pressure_pa - before.gauge_pressure_pa) == pytest.approx(
        20.6, abs=0.25
    )
    # full flow 5.3 µm/s is 5.98 mL/s: 60 s at (0.5 - 0.1)/0.9 of it
    added_ml = 60.0 * 0.4 / 0.9 * 5.3 / 0.886
    assert rise_um / added_ml == pytest.approx(0.886, rel=0.003)


@pytest.mark.parametrize("gauge_pa", [300.0, 900.0])
def test_centre_per_ml_hardly_depends_on_pressure(gauge_pa: float) -> None:
    volume = float(film.MIRROR_FILM.volume_m3_per_root_pa(film.SETTLED_S) * (1 + 63.4 / 37.1))
    gas = fill_gas(gauge_pa, 296.15, 101_325.0, volume)
    coefficient_um = 1e3 * float(film.MIRROR_FILM.sag_mm_per_root_pa(film.SETTLED_S))
    before_um = coefficient_um * gas.root_pa
    for _ in range(10):
        gas.step(1.0, 0.0, 101_325.0, 296.15, volume)
    assert (coefficient_um * gas.root_pa - before_um) / 10 == pytest.approx(0.886, rel=0.012)


@pytest.mark.parametrize(("change_pa", "over_s"), [(1.0, 0.0), (-100.0, 600.0), (100.0, 600.0)])
def test_ambient_pressure_squeezes_trapped_gas(change_pa: float, over_s: float) -> None:
    bench = trapped(AmbientChange(at_s=1.0, change_pa=change_pa, over_s=over_s))
    creep_um = moved_um(trapped(), over_s + 2.0)
    assert (moved_um(bench, over_s + 2.0) - creep_um) / change_pa == pytest.approx(
        -0.358, abs=0.002
    )


def test_a_door_moves_the_centre_by_seven_um() -> None:
    bench = trapped(AmbientChange(at_s=1.0, change_pa=20.0))
    assert moved_um(bench, 1.01) == pytest.approx(-7.2, abs=0.1)


@pytest.mark.parametrize("change_k", [-0.1, 0.1])
def test_gas_follows_the_air_in_twelve_seconds(change_k: float) -> None:
    bench, still = trapped(AirTemperatureChange(at_s=1.0, change_k=change_k)), trapped()
    after_one_constant = moved_um(bench, 1.0 + 12.0) - moved_um(still, 1.0 + 12.0)
    after_all = after_one_constant + moved_um(bench, 120.0) - moved_um(still, 120.0)
    assert after_all / change_k == pytest.approx(123.0, abs=0.3)
    assert after_one_constant / after_all == pytest.approx(1 - math.exp(-1), abs=0.002)


def test_leak_lets_the_centre_fall() -> None:
    bench = Plant(calm(), PumpConfig())
    bench.actuate(0.0, 0.0)
    bench.advance(5.0)
    assert bench.truth().leak_um_per_s == pytest.approx(1.24, abs=0.005)
    assert moved_um(bench, 10.0) / 10.0 == pytest.approx(-1.24, abs=0.005)
    assert bench.truth().leak_um_per_s / plant.NOMINAL_UM_PER_ML == pytest.approx(1.40, abs=0.01)


def test_pressure_decays_with_the_leaks_time_constant() -> None:
    bench = Plant(calm(leak_time_constant_s=1e4), PumpConfig())
    bench.actuate(0.0, 0.0)
    before = bench.truth().gauge_pressure_pa
    bench.advance(100.0)
    fall = math.log(before / bench.truth().gauge_pressure_pa)
    assert fall == pytest.approx(
        100.0 / 1e4, rel=0.02
    )  # the compliance falls a little with the pressure


def test_leak_doubled() -> None:
    bench = Plant(calm(), PumpConfig(), [LeakChange(at_s=10.0)])
    bench.advance(9.0)
    before = bench.truth().leak_um_per_s
    bench.advance(2.0)
    assert bench.truth().leak_um_per_s == pytest.approx(2 * before, rel=1e-3)


# By hand: gas volume c p^(1/3) with c the sum over films, P V constant, so d ln w = d ln J / 3 of
# the film itself minus k d ln c, k = 1 / (1 + 3p/P) = 0.983. The mirror film has 0.369 of c:
# (1/3)(1 - 0.369 k) and -(1/3) 0.631 k of 1.01 % of 37.1 mm are 79.2 and -77.0 µm (81 and -79 in
# the design's table need
# another split
# than 37.1 : 63.4).
@pytest.mark.parametrize(("softer", "expected_um"), [("MIRROR_FILM", 79.2), ("BACK_FILM", -77.0)])
def test_one_softer_film_moves_trapped_gas(
    softer: str, expected_um: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    ordinary = getattr(film, softer)
    soft = film.Film(ordinary.thickness_um, ordinary.creep_per_decade, 0.99 * film.MODULUS_PA)
    bench = trapped()
    moved_um(bench, 1.0)
    before = bench.truth().displacement_um
    monkeypatch.setattr(film, softer, soft)
    bench.advance(20.0)  # into the next block, where the coefficients are made again
    assert bench.truth().displacement_um - before == pytest.approx(expected_um, abs=0.3)


def test_differential_creep_lowers_the_mirror_slowly() -> None:
    hour_um = moved_um(trapped(), 3600.0)
    day, t0 = film.SETTLED_S, film.CREEP_START_S

    def softened(m: float) -> float:
        creep = [1 + m * math.log10(1 + t / t0) for t in (day, day + 3600)]
        return creep[1] / creep[0] - 1

    leak_um = -1.24e-4 * 3600
    expected_um = (79.2 * softened(0.005) - 77.0 * softened(0.02)) / 0.0101
    assert expected_um == pytest.approx(-1.9, abs=0.2)
    assert hour_um - leak_um == pytest.approx(expected_um, rel=0.02)


def test_no_gas_is_made_or_lost_without_leak_and_pump() -> None:
    events = [AmbientChange(5.0, 20.0), AmbientChange(15.0, -20.0), AirTemperatureChange(20.0, 1.0)]
    events += [AirTemperatureChange(40.0, -1.0)]
    bench, still = trapped(*events), trapped()
    assert moved_um(bench, 400.0) == pytest.approx(moved_um(still, 400.0), abs=1e-3)


def test_vent_lets_the_mirror_down_in_proportion() -> None:
    for fraction in (0.01, 0.1, 1.0):
        bench = trapped()
        bench.actuate(0.0, fraction)
        assert moved_um(bench, 0.1) / 0.1 == pytest.approx(-100 * fraction, rel=0.01)
        assert bench.truth().vent_um_per_s == pytest.approx(100 * fraction, rel=0.01)


def test_a_vented_mirror_goes_down_for_good() -> None:
    bench = trapped()
    bench.actuate(0.0, 1.0)
    sags_mm = []
    for _ in range(60):
        bench.advance(60.0)
        sags_mm.append(bench.truth().sag_mm)
    assert sags_mm == sorted(sags_mm, reverse=True)
    # V^2 dV = -const V^3 dt: the last mm take ever longer, sag ~ 1/sqrt(1 + 2 t 100 µm/s / 37 mm)
    assert sags_mm[-1] == pytest.approx(37.1 / math.sqrt(1 + 2 * 3600 * 0.1 / 37.1), rel=0.03)
