"""The estimate of the centre: compared with a batch solution, on a foreign plant, and with faulty
sensors.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from membrane_ctrl.config.schema import EstimatorConfig, LoopConfig, PumpConfig, TwinConfig
from membrane_ctrl.control import centre
from membrane_ctrl.control.centre import CentreFilter
from membrane_ctrl.control.centre_estimate import CentreEstimate, CentreReadings, Sensor
from membrane_ctrl.control.gas_transit import Transit
from membrane_ctrl.control.inner_loop import InnerLoop
from membrane_ctrl.control.innovation_ramp import InnovationRamp
from membrane_ctrl.control.noise_learning import LearnedFactor, ReadingNoise, configured_walk
from tests.studies.held_centre import Optics, Sensors, hold
from tests.worlds.foreign_plant import ForeignPlant, ForeignPump

LOOP = LoopConfig()
CONFIG = EstimatorConfig()
DT_S = 0.02
FLOW = 1.24
SAG_UM = 37_100.0
LOCKED_S = 30.0  # by then the laser's mean defines the optics' zero
LASER, OPTICS, BAROMETER = Sensor.LASER, Sensor.OPTICS, Sensor.BAROMETER


# Against a batch solution: all states of all ticks as one Gaussian, conditioned on all readings at
# their true times.


@dataclass(frozen=True)
class Reading:
    """A reading of a sum of states at ticks, with its noise."""

    rows: tuple[tuple[int, np.ndarray], ...]
    value: float
    variance: float


def _model() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Transition, noise of a step, first covariance of gas, leak, pressure, air, gas temperature,
    mount, stand.
    """
    step = np.eye(7)
    step[0, 1] = -DT_S
    follow = 1 - math.exp(-DT_S / LOOP.gas_follows_air_s)
    step[4, 3], step[4, 4] = follow, 1 - follow
    walks = [
        CONFIG.centre_walk_um_per_root_s**2,
        (25 * CONFIG.leak_walk_um_per_s_per_root_s) ** 2,  # as in the first minute
        CONFIG.pressure_walk_pa_per_root_s**2,
        CONFIG.air_walk_k_per_root_s**2,
        0.0,
        CONFIG.mount_walk_um_per_root_s**2,
        0.0,
    ]
    first = np.diag([CONFIG.laser_noise_um**2, 0.09, 1.0, 4e-4, 4e-4, 0.0, 1e6])
    return step, np.diag(walks) * DT_S, first


def _batch(ticks: int, readings: list[Reading], wanted: np.ndarray) -> tuple[float, float]:
    """Mean and standard deviation of `wanted` states of the last tick, given the readings; the
    first mean is 0.
    """
    step, noise, first = _model()
    size = 7 * (ticks + 1)
    whole, last = np.zeros((size, size)), first
    whole[:7, :7] = first
    for k in range(1, ticks + 1):
        now = slice(7 * k, 7 * k + 7)
        whole[now, : 7 * k] = step @ whole[7 * k - 7 : 7 * k, : 7 * k]
        whole[: 7 * k, now] = whole[now, : 7 * k].T
        last = step @ last @ step.T + noise
        whole[now, now] = last
    h = np.zeros((len(readings), size))
    for row, reading in zip(h, readings, strict=True):
        for tick, factors in reading.rows:
            row[7 * tick : 7 * tick + 7] += factors
    spread = h @ whole @ h.T + np.diag([reading.variance for reading in readings])
    at_end = np.zeros(size)
    at_end[7 * ticks : 7 * ticks + 7] = wanted
    gain = np.linalg.solve(spread, h @ whole @ at_end)
    mean = gain @ np.array([reading.value for reading in readings])
    return float(mean), float(np.sqrt(at_end @ whole @ at_end - gain @ h @ whole @ at_end))


CENTRE = np.array([1.0, 0, LOOP.barometer_gain_um_per_pa, 0, LOOP.temperature_gain_um_per_k, 0, 0])
MOUNT, STAND = np.eye(7)[5], np.eye(7)[6]


@pytest.fixture
def fixed_noises(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is learned, and the gains of the weather are known."""
    monkeypatch.setattr(centre, "_GAIN_ERROR", 0.0)
    monkeypatch.setattr(LearnedFactor, "learn", lambda *_: None)
    monkeypatch.setattr(InnovationRamp, "update", lambda *_: False)
    monkeypatch.setattr(centre, "FRESH_S", dict.fromkeys(Sensor, -1.0))
    monkeypatch.setattr(centre, "_HUBER2", math.inf)
    monkeypatch.setattr(centre, "_FAR2", math.inf)


@pytest.mark.usefixtures("fixed_noises")
@pytest.mark.parametrize("locks", [True, False], ids=["locked", "before the lock"])
@pytest.mark.parametrize("late_ticks", [0, 3, 40], ids=lambda n: f"{n} ticks late")
def test_it_is_the_best_linear_estimate_of_all_readings_at_their_own_times(
    late_ticks: int, locks: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames taken every four ticks, some between two ticks, arrive later than what the other
    sensors said since.
    """
    monkeypatch.setattr(centre, "_LOCK_SIGMA_UM", math.inf if locks else 0.0)
    rng, ticks = np.random.default_rng(late_ticks), 64
    filtered = CentreFilter(CONFIG, LOOP)
    filtered.start(0.0, FLOW, 0.0)
    readings: list[Reading] = []
    until_lock: list[Reading] = []
    frames = locked_at = 0
    noises = rng.standard_normal((ticks + 1, 4)) * (1.0, 0.05, 0.002, 0.05)
    for k in range(1, ticks + 1):
        laser, pressure, air, frame = noises[k]
        readings.append(
            Reading(((k, np.eye(7)[2]),), pressure - noises[1, 1], CONFIG.barometer_noise_pa**2)
        )
        readings.append(
            Reading(((k, np.eye(7)[3]),), air - noises[1, 2], CONFIG.thermometer_noise_k**2)
        )
        taken, sag_um, sag_s = k - late_ticks, math.nan, math.nan
        if taken >= 1 and taken % 4 == 0:
            frames += 1
            between = 0.5 if taken % 8 == 0 and late_ticks else 0.0
            sag_um, sag_s = SAG_UM + (frame if frames > 1 else 0.0), (taken + between) * DT_S
            rows: tuple[tuple[int, np.ndarray], ...] = ((taken, (1 - between) * CENTRE - STAND),)
            if between:
                rows += ((taken + 1, between * CENTRE),)
            readings.append(Reading(rows, sag_um - SAG_UM, 0.036**2 + CONFIG.optics_noise_um**2))
            if frames == centre.LOCK_FRAMES:
                locked_at, until_lock = k, list(readings)
        readings.append(Reading(((k, CENTRE + MOUNT),), laser, CONFIG.laser_noise_um**2))
        given = CentreReadings(
            k * DT_S, FLOW, laser, 98_000 + pressure, 21 + air, sag_um, 0.036, sag_s
        )
        estimate = filtered.step(given, DT_S)
    stand_um, error = 0.0, 0.0 * STAND
    if locks:
        stand_um, _ = _batch(locked_at, until_lock, STAND)
        error = STAND
    mean, sigma = _batch(ticks, readings, CENTRE - error)
    assert estimate.um - estimate.mount_um == pytest.approx(mean + stand_um, abs=1e-5)
    assert estimate.sigma_um == pytest.approx(sigma, rel=1e-4)
    mount, _ = _batch(ticks, readings, MOUNT + error)
    assert estimate.mount_um == pytest.approx(mount - stand_um, abs=1e-5)


# In the second world.


def _watch(
    plant: ForeignPlant, seconds: float, laser: Callable[[float], bool] = lambda _: True
) -> np.ndarray:
    """Run the filter beside a plant whose pump balances the leak, roughly; (n, 3) truth, estimate,
    sigma.
    """
    loop = LoopConfig(
        barometer_gain_um_per_pa=-0.36,
        temperature_gain_um_per_k=124.0,
        gas_follows_air_s=0.0,
        setpoint_um=0.0,
    )
    filtered = CentreFilter(EstimatorConfig(pump_delay_s=0.1, pump_lag_s=0.1), loop)
    rng, frames, rows = np.random.default_rng(5), deque[tuple[float, float]](), []
    flow = 1.24
    filtered.start(plant.sample().displacement_um, flow, 0.0)
    for k in range(round(seconds / DT_S)):
        now_s, truth = plant.time_s, plant.truth()
        sample = plant.sample_of(truth)
        sag = (math.nan, math.nan, math.nan)
        if k % 3 == 0 and now_s > 3.0:
            frames.append((now_s, SAG_UM + truth.displacement_um + 0.05 * rng.standard_normal()))
        if frames and frames[0][0] <= now_s - 0.06:
            taken_s, sag_um = frames.popleft()
            sag = (sag_um, 0.05, taken_s)
        given = CentreReadings(
            now_s,
            flow,
            sample.displacement_um if laser(now_s) else math.nan,
            sample.ambient_pressure_pa,
            sample.air_temperature_c,
            *sag,
        )
        estimate = filtered.step(given, DT_S)
        rows.append((truth.displacement_um, estimate.um - estimate.mount_um, estimate.sigma_um))
        wanted = 1.24 - 0.5 * (estimate.um - estimate.mount_um) + 0.6 * math.sin(now_s / 3)
        fraction = 0.1 + 0.9 * max(0.3, min(wanted, 5.3)) / 5.3
        flow = plant.pump.settled(fraction)
        plant.actuate(fraction, 0.0)
        plant.advance(DT_S)
    return np.array(rows)


@pytest.mark.parametrize(
    ("laser", "gusts"),
    [
        (True, True),
        pytest.param(False, True, marks=pytest.mark.campaign),
        pytest.param(True, False, marks=pytest.mark.campaign),
        pytest.param(False, False, marks=pytest.mark.campaign),
    ],
    ids=["all, gusts", "optics alone, gusts", "all, calm", "optics alone, calm"],
)
def test_sigma_matches_the_error_on_a_foreign_plant(laser: bool, gusts: bool) -> None:
    ratios, misses = [], []
    for seed in (3,):
        plant = ForeignPlant(ForeignPump(delay_s=0.1, lag_s=0.1), seed, gusts=gusts)
        truth, estimate, sigma = _watch(plant, 30.0, lambda now_s: laser or now_s < 5.0)[500:].T
        miss = estimate - truth
        miss -= miss.mean()  # the figure at lock is the one to hold
        ratios.append(np.mean((miss / sigma) ** 2))
        misses.append(miss.std())
    assert 0.4 < math.sqrt(np.mean(ratios)) < 1.3  # the levels are still being learned, from above
    assert max(misses) < 0.15  # µm; the weather there moves the centre by 0.4 within seconds


def _estimate_beside_weather(gains: tuple[float, float], seconds: float) -> CentreFilter:
    """Run a filter without optics, ten times a second, beside a plant of its own equations.

    `gains`: the plant's gains of pressure and temperature over the configured ones.
    """
    rng, dt_s = np.random.default_rng(11), 0.1
    filtered = CentreFilter(
        EstimatorConfig(laser_noise_um=0.4), LOOP.model_copy(update={"rate_hz": 10.0})
    )
    filtered.start(0.0, FLOW, 0.0)
    pressure_pa, air_k, gas_k = 0.0, 0.0, 0.0
    for k in range(round(seconds / dt_s)):
        kick = rng.standard_normal(5).tolist()
        pressure_pa += -pressure_pa * dt_s / 30.0 + 0.3 * math.sqrt(dt_s) * kick[0]
        air_k += -air_k * dt_s / 300.0 + 0.004 * math.sqrt(dt_s) * kick[1]
        gas_k += (air_k - gas_k) * dt_s / LOOP.gas_follows_air_s
        centre_um = gains[0] * LOOP.barometer_gain_um_per_pa * pressure_pa
        centre_um += gains[1] * LOOP.temperature_gain_um_per_k * gas_k
        given = CentreReadings(
            k * dt_s,
            FLOW,
            centre_um + 0.4 * kick[2],
            98_000.0 + pressure_pa + 0.05 * kick[3],
            21.0 + air_k + 0.002 * kick[4],
        )
        filtered.step(given, dt_s)
    return filtered


def test_wrong_gains_of_the_weather_are_learned() -> None:
    learned = _estimate_beside_weather((1.2, 0.85), 240.0).memory.x
    assert 1.0 + learned[centre._PRESSURE_ERROR] == pytest.approx(1.2, abs=0.07)
    assert 1.0 + learned[centre._WARMTH_ERROR] == pytest.approx(0.85, abs=0.05)


def test_other_gains_do_not_move_the_centre() -> None:
    filtered = _estimate_beside_weather((1.1, 1.0), 40.0)
    before_um = filtered._compute_centre_um()
    filtered.set_gains(LOOP.model_copy(update={"barometer_gain_um_per_pa": -0.5}))
    assert filtered._compute_centre_um() == pytest.approx(before_um, abs=1e-9)
    assert filtered.memory.p[centre._PRESSURE_ERROR, centre._PRESSURE_ERROR] == pytest.approx(0.04)


# Bad sensors.


def _still(
    seconds: float,
    alter: Callable[[float, CentreReadings], CentreReadings] = lambda _, given: given,
    filtered: CentreFilter | None = None,
) -> list[CentreEstimate]:
    """A mirror that stands still at 0, seen by everything;
    `alter` changes the readings of a time.
    """
    rng = np.random.default_rng(1)
    if filtered is None:
        filtered = CentreFilter(CONFIG, LOOP)
        filtered.start(0.0, FLOW, 0.0)
    estimates = []
    for k in range(round(seconds / DT_S)):
        now_s = k * DT_S
        laser, pressure, air, frame = (rng.standard_normal(4) * (1.0, 0.05, 0.002, 0.036)).tolist()
        sag = (SAG_UM + frame, 0.036, now_s - 0.03) if k % 2 else (math.nan, math.nan, math.nan)
        given = CentreReadings(now_s, FLOW, laser, 98_000.0 + pressure, 21.0 + air, *sag)
        estimates.append(filtered.step(alter(now_s, given), DT_S))
    return estimates


def _centres(estimates: list[CentreEstimate], from_s: float, against_s: float = 6.0) -> np.ndarray:
    """The centre from a time on, against its mean in the three seconds before another."""
    um = np.array([estimate.um - estimate.mount_um for estimate in estimates])
    before = slice(round((against_s - 3.0) / DT_S), round(against_s / DT_S))
    return um[round(from_s / DT_S) :] - um[before].mean()


def _changed(given: CentreReadings, **added: float) -> CentreReadings:
    values = {name: getattr(given, name) + by for name, by in added.items()}
    return CentreReadings(
        **{name: values.get(name, getattr(given, name)) for name in CentreReadings.__slots__}
    )


@pytest.mark.parametrize(
    "name",
    ["laser_um", "sag_um", "ambient_pressure_pa", "air_temperature_c", "sag_change_sigma_um"],
)
def test_single_bad_readings_have_no_effect(name: str) -> None:
    bad = [20.0, 1e300, math.inf, -math.inf, math.nan]

    def alter(now_s: float, given: CentreReadings) -> CentreReadings:
        tick = round(now_s / DT_S)
        return (
            _changed(given, **{name: bad[tick // 10 % 5]}) if now_s > 6 and tick % 10 < 2 else given
        )

    assert np.abs(_centres(_still(8.0, alter), 6.0)).max() < 0.15


def test_a_jump_that_only_the_laser_shows_is_attributed_to_its_mount() -> None:
    estimates = _still(
        10.0, lambda now_s, given: _changed(given, laser_um=12.0 if now_s > 6 else 0.0)
    )
    assert np.abs(_centres(estimates, 6.0)).max() < 0.15
    before_um = estimates[round(5.9 / DT_S)].mount_um  # what was uncertain at lock is the mount's
    assert estimates[-1].mount_um - before_um == pytest.approx(12.0, abs=0.5)
    assert next(jump for estimate in estimates for jump in estimate.jumped).startswith("laser +")


def _moved(given: CentreReadings, um: float, at_s: float = 6.0) -> CentreReadings:
    """What laser and optics read of a film that moved; frames show the film at their own time."""
    given = _changed(given, laser_um=um if given.now_s > at_s else 0.0)
    return _changed(given, sag_um=um if given.sag_time_s > at_s else 0.0)


@pytest.mark.parametrize("um", [7.0, -1.5])
def test_a_film_that_moves_is_followed_within_a_few_frames(um: float) -> None:
    estimates = _still(9.0, lambda _, given: _moved(given, um))
    assert _centres(estimates, 6.3)[:50] == pytest.approx(um, abs=0.5)
    assert _centres(estimates, 8.0) == pytest.approx(um, abs=0.4)


def _swung(hz: float, um: float, laser_um: float, seed: int) -> float:
    """By how much the estimate is off after a door has made the film swing, at 10 ticks and 5
    figures a second, without a barometer.
    """
    rate_hz, door_s, age_ticks = 10.0, 66.0, 2
    loop = LOOP.model_copy(
        update={
            "rate_hz": rate_hz,
            "feedforward_barometer": False,
            "feedforward_temperature": False,
        }
    )
    filtered = CentreFilter(CONFIG, loop)
    filtered.start(0.0, FLOW, 0.0)
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(82.0 * rate_hz)) / rate_hz
    since_s = np.maximum(time_s - door_s - seed * 0.03, 0.0)
    film_um = um * np.sin(2 * np.pi * hz * since_s) * np.exp(-since_s * hz / 2)
    errors_um = []
    for k, now_s in enumerate(time_s.tolist()):
        sag = (math.nan, math.nan, math.nan)
        if k % 2 == 0 and k >= age_ticks:
            seen_um = film_um[k - age_ticks] + 0.036 * rng.standard_normal()
            sag = (SAG_UM + seen_um, 0.036, time_s[k - age_ticks])
        read_um = film_um[k] + laser_um * rng.standard_normal()
        given = CentreReadings(now_s, FLOW, read_um, math.nan, math.nan, *sag)
        estimate = filtered.step(given, 1 / rate_hz)
        errors_um.append(estimate.um - estimate.mount_um - film_um[k])
    before = slice(round((door_s - 20.0) * rate_hz), round(door_s * rate_hz))
    return float(np.mean(errors_um[-30:]) - np.mean(errors_um[before]))


@pytest.mark.parametrize(
    ("hz", "um", "laser_um", "seed"),
    [
        (0.7, -7.0, 0.8, 1),
        (0.7, -7.0, 0.4, 7),
        (1.0, 5.0, 0.4, 1),
        (1.57, 5.0, 0.8, 5),
        (1.57, -7.0, 0.8, 11),
    ],
)
def test_a_film_that_swings_behind_a_door_moves_neither_zero_nor_mount(
    hz: float, um: float, laser_um: float, seed: int
) -> None:
    assert _swung(hz, um, laser_um, seed) == pytest.approx(0.0, abs=0.4)


def test_a_pressure_step_of_the_barometer_moves_the_estimate_at_once() -> None:
    by_um = 20 * LOOP.barometer_gain_um_per_pa
    estimates = _still(
        7.0,
        lambda now_s, given: _moved(
            _changed(given, ambient_pressure_pa=20.0 if now_s > 6 else 0.0), by_um
        ),
    )
    assert _centres(estimates, 6.08) == pytest.approx(by_um, abs=1.5)
    assert _centres(estimates, 6.3) == pytest.approx(by_um, abs=0.25)


def test_a_pressure_step_that_other_sensors_contradict_is_reverted() -> None:
    estimates = _still(
        8.0, lambda now_s, given: _changed(given, ambient_pressure_pa=20.0 if now_s > 6 else 0.0)
    )
    assert np.abs(_centres(estimates, 6.3)).max() < 0.25


def test_a_jump_of_the_optics_is_undone_by_the_laser() -> None:
    estimates = _still(
        12.0, lambda _, given: _changed(given, sag_um=8.0 if given.sag_time_s > 6 else 0.0)
    )
    assert np.abs(_centres(estimates, 11.0)).max() < 0.5


def test_a_drifting_mount_does_not_move_the_centre() -> None:
    """It is followed, and neither taken for noise nor left behind: the laser may soon have to hold
    alone.
    """

    def drift(now_s: float, given: CentreReadings) -> CentreReadings:
        return _changed(given, laser_um=max(0.0, now_s - LOCKED_S) * 2.0 / 60)

    filtered = CentreFilter(CONFIG, LOOP)
    filtered.start(0.0, FLOW, 0.0)
    estimates = _still(150.0, drift, filtered)
    assert np.abs(_centres(estimates, LOCKED_S, LOCKED_S)).max() < 0.12
    assert estimates[-1].mount_um - estimates[round(LOCKED_S / DT_S)].mount_um == pytest.approx(
        120 * 2 / 60, abs=0.6
    )
    assert filtered.memory.noises[LASER].factor == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("um", [1.5, 8.0])
def test_returning_optics_remove_the_mount_motion_of_the_gap(um: float) -> None:
    def alter(now_s: float, given: CentreReadings) -> CentreReadings:
        gap_s = now_s - LOCKED_S
        given = _changed(given, laser_um=um * min(max(gap_s, 0.0) / 10, 1.0))
        return _changed(given, sag_um=math.nan) if 0 < gap_s < 11 else given

    estimates = _still(LOCKED_S + 14.0, alter)
    assert [jump.split()[0] for estimate in estimates for jump in estimate.jumped] == ["optics"]
    centres_um = _centres(estimates, LOCKED_S, LOCKED_S)
    assert centres_um[round(10.5 / DT_S)] == pytest.approx(um, abs=0.5)  # only the laser sees it
    assert np.abs(centres_um[round(12.0 / DT_S) :]).max() < 0.15


def test_the_estimate_works_with_each_single_sensor_and_with_none() -> None:
    nothing = {"laser_um": math.nan, "sag_um": math.nan}
    lost = _still(
        LOCKED_S + 12.0,
        lambda now_s, given: _changed(given, **(nothing if now_s > LOCKED_S else {})),
    )
    assert lost[-1].sigma_um > 3 * lost[round(LOCKED_S / DT_S) - 50].sigma_um
    assert [lost[-1].sensors[sensor].fresh for sensor in (LASER, OPTICS, BAROMETER)] == [
        False,
        False,
        True,
    ]
    blind = _still(
        LOCKED_S + 12.0,
        lambda now_s, given: _changed(given, laser_um=math.nan if now_s > LOCKED_S else 0.0),
    )
    assert blind[-1].sensors[OPTICS].share > 0.99
    assert blind[-1].sigma_um < 0.05
    no_camera = _still(8.0, lambda _, given: _changed(given, sag_um=math.nan))
    assert no_camera[-1].sensors[LASER].share == pytest.approx(1.0)
    assert abs(no_camera[-1].um) < 4 * no_camera[-1].sigma_um


def test_random_readings_never_make_the_estimate_infinite() -> None:
    rng = np.random.default_rng(9)
    rubbish = [math.nan, math.inf, -math.inf, 1e308, -1e308, 0.0, 1e-308, 4e3]

    def alter(_: float, given: CentreReadings) -> CentreReadings:
        values = {name: getattr(given, name) for name in CentreReadings.__slots__}
        for name in list(values)[2:]:
            if rng.random() < 0.4:
                values[name] = float(rng.choice(rubbish))
        return CentreReadings(**values)

    for estimate in _still(20.0, alter):
        assert all(
            map(
                math.isfinite,
                (estimate.um, estimate.sigma_um, estimate.ahead_um, estimate.drift_um_per_s),
            )
        )


def test_relock_takes_a_new_zero_without_moving_the_centre() -> None:
    filtered = CentreFilter(CONFIG, LOOP)
    filtered.start(0.0, FLOW, 0.0)
    before = _still(6.0, filtered=filtered)
    filtered.relock()
    after = _still(
        6.0, lambda _, given: _changed(given, now_s=6.0, sag_time_s=6.0, sag_um=500.0), filtered
    )
    centres = [estimate.um - estimate.mount_um for estimate in (before[-1], *after)]
    assert np.ptp(centres) < 0.2


@pytest.mark.parametrize("seed", [1, 2])
def test_the_mean_of_the_laser_defines_the_zero_of_the_optics(seed: int) -> None:
    """Its first second alone, in which five frames come, is up to 0.5 µm off."""
    rng = np.random.default_rng([seed, 11])
    filtered = CentreFilter(CONFIG, LOOP)
    filtered.start(float(rng.standard_normal()), FLOW, 0.0)
    estimates = _still(
        60.0, lambda _, given: _changed(given, laser_um=float(rng.standard_normal())), filtered
    )
    assert filtered.memory.locked
    late = estimates[round(40.0 / DT_S) :]
    assert max(abs(estimate.um - estimate.mount_um) for estimate in late) < 0.12
    assert estimates[-1].mount_um == pytest.approx(0.0, abs=0.12)


def test_the_zero_is_locked_after_a_minute_if_the_laser_is_lost() -> None:
    blind = lambda now_s, given: _changed(given, laser_um=math.nan if now_s > 1 else 0.0)  # noqa: E731
    for seconds, locked in ((55.0, False), (65.0, True)):
        filtered = CentreFilter(CONFIG, LOOP)
        filtered.start(0.0, FLOW, 0.0)
        _still(seconds, blind, filtered)
        assert filtered.memory.locked == locked


# Its loop.


def test_a_loop_of_few_ticks_a_second_does_not_swing() -> None:
    """A tick of 0.25 s is four times the loop's own time: what it removes in one must not exceed
    the error.
    """
    loop = LoopConfig(rate_hz=4.0)
    held = hold(
        Sensors(optics=Optics(rate_hz=4.0)), TwinConfig(start_error_um=0.0), 60.0, loop=loop
    )
    assert held.after(30.0).std() < 0.1


def test_a_slow_pump_is_not_driven_from_limit_to_limit() -> None:
    """A micrometre asks for no more flow of a slow pump than of a quick one."""
    quick, slow = (
        InnerLoop(LOOP, PumpConfig(), EstimatorConfig(pump_lag_s=lag_s)) for lag_s in (0.15, 0.6)
    )
    assert slow._error_gain_per_s < quick._error_gain_per_s < 30.0


# Gas in transit.


@pytest.mark.parametrize(
    ("delay_s", "lag_s"), [(0.08, 0.15), (0.0, 0.1), (0.05, 0.0), (0.013, 0.3)]
)
def test_transit_is_a_dead_time_and_a_lag(delay_s: float, lag_s: float) -> None:
    """Against a simulation in steps of 1 ms; what is under way arrives, to the last bit."""
    flows = np.random.default_rng(2).uniform(0, 5, 20)
    transit, fine = Transit(delay_s, lag_s, DT_S), deque([0.0] * (round(delay_s / 0.001) + 1))
    arriving = risen = expected = 0.0
    for k in range(400):
        flow = float(flows[k // 5]) if k < 100 else 0.0
        risen += transit.advance(flow, DT_S)
        if k == 99:
            coming = transit.coming_um(0.0)
            at_100 = risen
        for _ in range(20):
            fine.append(flow)
            fine.popleft()
            share = -math.expm1(-0.001 / lag_s) if lag_s else 1.0
            arriving += share * (fine[0] - arriving)
            expected += arriving * 0.001
        assert risen == pytest.approx(expected, abs=0.02)
    assert coming == pytest.approx(risen - at_100, abs=1e-5)


# Noise levels.


def _follow(
    reading: ReadingNoise, level: LearnedFactor, noise: float, walk: float, steps: int = 12_000
) -> list[float]:
    """Follow a walk seen with noise, both stated as 1 a step, with what is learned; the last 5,000
    error to sigma.
    """
    rng = np.random.default_rng(4)
    true = estimate = 0.0
    p, errors = 1.0, []
    for moved, off in (rng.standard_normal((steps, 2)) * (walk, noise)).tolist():
        true += moved
        p += level.factor
        spread = p + reading.factor
        innovation = true + off - estimate
        reading.learn(innovation / math.sqrt(spread), p / spread, DT_S, ((level, 1.0),))
        estimate += p / spread * innovation
        p *= reading.factor / spread
        errors.append((estimate - true) / math.sqrt(p))
    return errors[-5000:]


@pytest.mark.parametrize(
    ("noise", "walk"), [(1.0, 1.0), (0.3, 0.3), (3.0, 0.3), (1.0, 5.0), (2.0, 0.1)]
)
def test_noise_and_walk_are_learned(noise: float, walk: float) -> None:
    reading, level = ReadingNoise.of_reading(stated=False), configured_walk()
    errors = _follow(reading, level, noise, walk)
    assert math.sqrt(reading.factor) == pytest.approx(noise, rel=0.15 if walk <= noise else 0.7)
    hidden = walk < noise / 5  # a walk far below the noise is learned slowly
    assert 0.65 < math.sqrt(level.factor) / walk < (3.0 if hidden else 1.35)
    assert (0.6 if hidden else 0.85) < float(np.std(errors)) < 1.15


def test_learned_noise_stays_within_its_bounds() -> None:
    reading, level = ReadingNoise.of_reading(stated=False), configured_walk()
    for innovation in (1e3, 0.0):
        for k in range(20_000):
            reading.learn(innovation * (k % 2), 0.5, DT_S, ((level, 1.0),))
        assert 0.999 / 25 <= reading.factor <= 25 * 1.001
        assert 0.999 / 900 <= level.factor <= 900 * 1.001


def test_few_readings_do_not_overturn_a_long_learned_noise_level() -> None:
    level, bound = configured_walk(), math.log(900.0)
    for _ in range(5000):
        level.learn(0.0, 1e-4, 0.01, bound)
    for _ in range(5):
        level.learn(4.0, 0.2, 0.01, bound)
    assert math.log(level.factor) < 5.1


def test_a_ramp_is_found_with_start_and_slope_and_white_noise_gives_none() -> None:
    ramp, noise = InnovationRamp(), np.random.default_rng(3).standard_normal(2000)
    assert not any(ramp.update(float(value), 0.05 * k, 8.0) for k, value in enumerate(noise[:1000]))
    for k, value in enumerate(noise[1000:].tolist()):
        if ramp.update(value - 0.4 * k, 50.0 + 0.05 * k, 8.0):
            break
    assert k < 9
    assert ramp.since_s == pytest.approx(50.0, abs=0.2)
    assert -0.4 / 0.05 * 2 < ramp.slope < -0.4 / 0.05 / 2
