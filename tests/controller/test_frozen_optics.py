"""The laser is lost, and the optics that take over are frozen with their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from membrane_ctrl.config.schema import (
    Config,
    EstimatorConfig,
    LoopConfig,
    ShapeConfig,
    StatesConfig,
    TwinConfig,
)
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import Fault
from membrane_ctrl.model.shape_estimate import ShapeEstimate
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench

RATE_HZ = 5.0
FAILS_S = 90.0
MOST_UM = 35.0


class FreezingShape:
    """Figures of the truth until the optics freeze; then the last one with fresh noise."""

    def __init__(self, source: TruthShape, freezes: bool) -> None:
        self._source = source
        self._freezes = freezes
        self._rng = np.random.default_rng(5)
        self._frozen_um: float | None = None

    def __call__(self, now_s: float) -> ShapeEstimate | None:
        figure = self._source(now_s)
        if figure is None or not self._freezes or now_s < FAILS_S:
            return figure
        if self._frozen_um is None:
            self._frozen_um = figure.sag_um
        sag_um = self._frozen_um + 0.01 * float(self._rng.standard_normal())
        return replace(figure, sag_um=sag_um, coeffs_um=sag_um * zernike_projection())


def hold_without_laser(seed: int, freezes: bool, process_value: str) -> tuple[str, float]:
    """The first fault, and how far the centre went until the pump was off."""
    config = Config(
        loop=LoopConfig(rate_hz=RATE_HZ),
        shape=ShapeConfig(mode="track", track_rate_hz=RATE_HZ),
        estimator=EstimatorConfig.model_validate({"process_value": process_value}),
        states=StatesConfig(stay_after_trip=True),
        twin=TwinConfig(seed=seed, scenario="typical", start_error_um=-5.0),
    )
    bench = VirtualBench(Plant(config.twin, config.pump))
    shapes = FreezingShape(TruthShape(bench, config, seed), freezes)
    run = VirtualRun(config, bench, zernike_projection(), shapes)
    run.run_tick((Command("hold", "test"),))
    furthest_um, begun_um, fault = 0.0, 0.0, ""
    while run.now_s < FAILS_S + 200.0:
        bench.wrong.no_light = run.now_s >= FAILS_S
        tick = run.run_tick()
        assert tick is not None
        faults = [event.name for event in tick.events if isinstance(event, Fault)]
        fault = fault or next(iter(faults), "")
        if run.now_s < FAILS_S:
            begun_um = bench.truth.displacement_um
        else:
            furthest_um = max(furthest_um, abs(bench.truth.displacement_um - begun_um))
        if fault and tick.row.pump_fraction == 0.0:
            break
    return fault, furthest_um


@pytest.mark.parametrize("process_value", ["estimate", "auto"])
@pytest.mark.parametrize("seed", [1, 3])
def test_frozen_optics_without_a_laser_are_found(seed: int, process_value: str) -> None:
    """The gauge alone found them after 40 to 54 µm."""
    fault, furthest_um = hold_without_laser(seed, True, process_value)
    assert fault == "laser_gauge_apart"
    assert furthest_um < MOST_UM


def test_sound_optics_hold_the_mirror_without_a_laser() -> None:
    fault, furthest_um = hold_without_laser(2, False, "estimate")
    assert fault == ""
    assert furthest_um < 2.0
