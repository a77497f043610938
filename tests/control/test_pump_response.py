"""Dead time and lag are identified from on and off, with error bars that hold, whatever the pump's
curve and full flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from membrane_ctrl.config.schema import EstimatorConfig
from membrane_ctrl.control.pump_response import (
    PumpResponse,
    Switch,
    apply_response,
    identify_pump_response,
)
from tests.worlds.foreign_plant import STEP_S, ForeignPump

_FROM_S = 1.0  # earlier readings are not given
_LEAK_UM_PER_S = 1.24


@dataclass(frozen=True)
class Record:
    """Readings of a mirror that moves at the speed of its gas, while a pump switches."""

    shape: str = "straight"
    full_um_per_s: float = 5.3
    delay_s: float = 0.1
    lag_s: float = 0.15
    first_s: float = 1.5  # the first time on; then off and on for `half_s` each
    half_s: float = 1.0
    count: int = 2
    noise_um: float = 1.0
    walk_um_per_root_s: float = 0.1
    dead: bool = False

    @property
    def switches(self) -> list[Switch]:
        later = [
            Switch(self.first_s + number * self.half_s, on=number % 2 == 1)
            for number in range(self.count)
        ]
        return [Switch(0.0, on=True), *later]

    def take_readings(self, seed: int) -> np.ndarray:
        rng = np.random.default_rng(seed)
        pump = ForeignPump(self.shape, self.full_um_per_s, self.delay_s, self.lag_s)
        pump.balance(0.0)
        height_um, readings = 0.0, []
        switches = self.switches
        for step in range(round((switches[-1].at_s + self.half_s) / STEP_S)):
            time_s = step * STEP_S
            if step % 2 == 0:  # 50 Hz
                readings.append((time_s, height_um + self.noise_um * rng.standard_normal()))
            on = [switch.on for switch in switches if switch.at_s <= time_s + 1e-9][-1]
            flow_um_per_s = pump.step(0.8 * on * (not self.dead))
            height_um += STEP_S * (flow_um_per_s - _LEAK_UM_PER_S)
            height_um += self.walk_um_per_root_s * STEP_S**0.5 * rng.standard_normal()
        kept = np.array(readings)
        return kept[kept[:, 0] >= _FROM_S]

    def known(self, seed: int) -> tuple[float, float, float, float]:
        """Noise, the measured speed with the pump off, and the flow of a straight curve."""
        error = float(np.random.default_rng(1000 + seed).standard_normal())
        return self.noise_um, -_LEAK_UM_PER_S + 0.4 * error, 0.4, 4.1

    def identify(self, seed: int) -> PumpResponse:
        found = identify_pump_response(self.take_readings(seed), self.switches, *self.known(seed))
        assert found is not None
        return found


RECORDS = {
    "quick": Record(),
    "quick, quiet laser": Record(noise_um=0.2),
    "quick, noisy laser": Record(noise_um=3.0, count=4),
    "quadratic and weak": Record("quadratic", full_um_per_s=3.5, count=4),
    "0.3 + 0.5 s": Record(delay_s=0.3, lag_s=0.5, first_s=1.9, count=4),
    "0.4 + 0.8 s": Record(delay_s=0.4, lag_s=0.8, first_s=2.5, half_s=1.25, count=4),
    "lag alone": Record(delay_s=0.01, lag_s=1.0, first_s=2.5, half_s=1.25),
    "dead time alone": Record(delay_s=1.0, lag_s=0.02, first_s=2.5, half_s=1.25),
    "2 + 1.5 s": Record(delay_s=2.0, lag_s=1.5, first_s=4.5, half_s=2.0),
}


@pytest.mark.parametrize("name", RECORDS)
def test_the_error_bars_hold(name: str) -> None:
    record = RECORDS[name]
    found = [record.identify(seed) for seed in range(40)]
    # a command is given at the end of a step of the foreign pump
    sum_s = record.delay_s + record.lag_s
    sums = np.array([each.sum_s for each in found]) - sum_s
    delays = np.array([each.delay_s for each in found]) - record.delay_s
    sigmas = np.array([each.sum_sigma_s for each in found])
    scores = sums / sigmas
    # two of a hundred records look like another pump by chance: the tails are longer than Gaussian
    assert np.mean(np.abs(scores) < 2.0) >= 0.85
    assert np.sqrt(np.mean(scores**2)) < 1.6
    assert np.mean(np.abs(delays / [each.delay_sigma_s for each in found]) < 2.0) >= 0.85
    # the bars are not so long that they say nothing: two sigmas exclude twice the sum, or
    # readings are too noisy
    if record.noise_um <= 1.0:
        assert np.median(sigmas) < 0.5 * sum_s


def test_a_longer_pattern_has_a_smaller_error() -> None:
    sigmas = [
        np.mean([Record(count=count).identify(seed).sum_sigma_s for seed in range(10)])
        for count in (2, 4, 6)
    ]
    assert sigmas[0] > 1.2 * sigmas[1] > 1.3 * sigmas[2]


def test_readings_that_the_pump_did_not_move_identify_nothing() -> None:
    """A film that jumps about is no response; a dead pump gives no more than the prior."""
    record = Record()
    readings = record.take_readings(1)
    readings[:, 1] += 20.0 * (np.floor(readings[:, 0] / 0.3) % 2)
    assert identify_pump_response(readings, record.switches, *record.known(1)) is None
    dead = Record(dead=True).identify(2)
    assert dead.sum_sigma_s > 0.5 * dead.sum_s


@pytest.mark.parametrize("count", [0, 1, 9])
def test_few_readings_identify_nothing(count: int) -> None:
    record = Record()
    assert (
        identify_pump_response(record.take_readings(1)[:count], record.switches, *record.known(1))
        is None
    )


def test_one_switch_identifies_nothing() -> None:
    record = Record()
    assert (
        identify_pump_response(record.take_readings(1), record.switches[:1], *record.known(1))
        is None
    )


def test_a_stated_response_stays() -> None:
    found = PumpResponse(0.5, 1.0, 0.1, 0.1, 0.1)
    stated = EstimatorConfig(pump_delay_s=0.2, pump_lag_s=0.3)
    assert apply_response(stated, found) is stated
    identified = EstimatorConfig(pump_response="identified")
    assert apply_response(identified, None) is identified
    used = apply_response(identified, found)
    assert (used.pump_delay_s, used.pump_lag_s) == (0.5, 1.0)
