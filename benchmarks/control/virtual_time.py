"""How much faster than real time a hold runs in virtual time, board included, and where the time
goes.
"""

from __future__ import annotations

import cProfile
import pstats
import time
from collections import defaultdict
from pathlib import Path

from membrane_ctrl.config.schema import Config, LoopConfig, ShapeConfig
from membrane_ctrl.hold.virtual_run import TruthShape, VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.sim.plant import Plant
from membrane_ctrl.sim.virtual_bench import VirtualBench
from tests.support.figures import Figure, at_least, at_most
from tests.worlds.virtual_record import run_virtual

RATE_HZ = 10.0
VIRTUAL_S = 3600.0
_SHARES = {  # the first that a file's path contains
    "board, registers, driver": ("firmware_iface/", "sim/virtual_bench.py"),
    "plant": ("membrane_ctrl/sim/",),
    "loops": ("membrane_ctrl/control/",),
    "tick, telemetry": (
        "controller/controller.py",
        "controller/tick.py",
        "model/telemetry.py",
        "membrane_ctrl/hold/",
    ),
    "safety and states": ("membrane_ctrl/controller/",),
}


def _hold(shape: bool) -> None:
    config = Config(loop=LoopConfig(rate_hz=RATE_HZ), shape=ShapeConfig(enabled=shape))
    plant = Plant(config.twin, config.pump)
    if not shape:
        for _ in run_virtual(config, plant, VIRTUAL_S, zernike_projection()):
            pass
        return
    from membrane_ctrl.controller.command import Command

    bench = VirtualBench(plant)
    run = VirtualRun(config, bench, zernike_projection(), TruthShape(bench, config, 1))
    run.run_tick((Command("hold", "benchmark"),))
    while run.now_s < VIRTUAL_S:
        run.run_tick()


def _times_real(shape: bool) -> float:
    start_s = time.process_time()
    _hold(shape)
    return VIRTUAL_S / (time.process_time() - start_s)


def _shares() -> dict[str, float]:
    """Share of each part in the own time of its functions; built-ins count with their caller."""
    profile = cProfile.Profile()
    profile.runcall(_hold, False)
    totals: dict[str, float] = defaultdict(float)
    for (file, _, _), (_, _, own_s, _, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        path = Path(file).as_posix()
        part = next(
            (name for name, marks in _SHARES.items() if any(mark in path for mark in marks)),
            "built-ins",
        )
        totals[part] += own_s
    whole_s = sum(totals.values())
    return {part: own_s / whole_s for part, own_s in totals.items()}


def run() -> list[Figure]:
    """Speed without and with shapes, speed of the plant alone, and the shares."""
    plant = Plant(Config().twin, Config().pump)
    start_s = time.process_time()
    plant.advance(VIRTUAL_S)
    alone = VIRTUAL_S / (time.process_time() - start_s)
    figures = [
        at_least(
            "hold at 10 Hz on one core, speed against real time",
            _times_real(False),
            "",
            1000.0,
            "plant alone",
            alone,
        ),
        at_least(
            "the same with a shape every 2 s", _times_real(True), "", 1000.0, "plant alone", alone
        ),
    ]
    shares = sorted(_shares().items(), key=lambda item: -item[1])
    return figures + [at_most(f"share of {part}", 100 * share, "%") for part, share in shares]
