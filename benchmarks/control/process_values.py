"""What `process_value = "auto"` reaches on benches of the second world, against the PI by laser.

Both start as a lab does: with the default gains, the default curve of the pump, and the test of the
actuators. They meet the same weather. The true centre is judged after three minutes, when a loop
that swings has fallen back.

python -m benchmarks.control.process_values [--drawn 40] [--file build/process_values.jsonl]

A second call continues where the first ended, and prints the tables of
docs/measurements/estimator.md.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.tuning.benches import drawn
from membrane_ctrl.config.schema import Config, EstimatorConfig, ShapeConfig
from membrane_ctrl.controller.command import Command
from membrane_ctrl.hold.virtual_run import VirtualRun
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model.events import ProcessValueChosen
from membrane_ctrl.model.telemetry import State
from tests.worlds.eleven_benches import BENCHES, ForeignCamera
from tests.worlds.foreign_plant import ForeignPlant, foreign_bench

SETTLE_S, HOLD_S = 180.0, 180.0
DRAWN_HOLD_S = 120.0
FIGURES_HZ = 20.0
RATE_MOST_HZ = (
    20.0  # the benches are run at this tick rate at most, which takes a third of the time
)


@dataclass(frozen=True)
class HeldBench:
    """A bench held three ways, standard deviations of the true centre in µm.

    Attributes
    ----------
    name : str
    laser_um, auto_um, auto_camera_um : float
        By the laser; with `auto`, without and with a tracking camera. NaN if it was not held.
    decisions : list of str
        Codes of the decisions without the camera, then with it.
    """

    name: str
    laser_um: float
    auto_um: float
    auto_camera_um: float
    decisions: list[str]


def hold_bench(
    plant: ForeignPlant, config: Config, value: str, camera: bool, hold_s: float
) -> tuple[float, list[str]]:
    """Standard deviation of the true centre, and the decisions."""
    shape = ShapeConfig(enabled=False)
    if camera:
        shape = ShapeConfig(mode="track", track_rate_hz=min(FIGURES_HZ, config.loop.rate_hz))
    estimator = EstimatorConfig.model_validate(
        {"process_value": value, "pump_response": "identified"}
    )
    config = config.model_copy(update={"shape": shape, "estimator": estimator})
    source = ForeignCamera(plant, 1) if camera else None
    run = VirtualRun(config, foreign_bench(plant), zernike_projection(), source)
    tick = run.run_tick((Command("hold", "benchmark"),))
    true_um, decisions = [], []
    while tick is not None and run.now_s < SETTLE_S + hold_s:
        decisions += [event.code for event in tick.events if isinstance(event, ProcessValueChosen)]
        if run.now_s > SETTLE_S:
            if tick.row.state != State.HOLD:
                return float("nan"), decisions
            true_um.append(plant.truth().displacement_um)
        tick = run.run_tick()
    return (float(np.std(true_um)) if true_um else float("nan")), decisions


def examine_bench(name: str) -> HeldBench:
    """One of the eleven benches, or a drawn one, `drawn N`."""
    if name.startswith("drawn "):
        bench = drawn(int(name.split()[1]))
        bench = replace(bench, rate_hz=min(bench.rate_hz, RATE_MOST_HZ))
        plants, config, hold_s = lambda: bench.plant(2), bench.config(), DRAWN_HOLD_S
    else:
        (known,) = (each for each in BENCHES if each.name == name)
        known = replace(known, rate_hz=min(known.rate_hz, RATE_MOST_HZ))
        plants, config, hold_s = lambda: known.plant(1), known.config(), HOLD_S
    laser_um, _ = hold_bench(plants(), config, "laser", False, hold_s)
    auto_um, alone = hold_bench(plants(), config, "auto", False, hold_s)
    camera_um, together = hold_bench(plants(), config, "auto", True, hold_s)
    return HeldBench(name, laser_um, auto_um, camera_um, [*alone, "camera", *together])


def print_tables(rows: list[HeldBench]) -> None:
    """A row for each bench, then shares."""
    print("| bench | laser µm | auto µm | ratio | auto, camera µm | ratio | decisions |")
    print("|---|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row.name} | {row.laser_um:.3f} | {row.auto_um:.3f} | "
            f"{row.auto_um / row.laser_um:.2f} | {row.auto_camera_um:.3f} | "
            f"{row.auto_camera_um / row.laser_um:.2f} | {', '.join(row.decisions)} |"
        )
    for kind in ("auto_um", "auto_camera_um"):
        ratios = np.array([getattr(row, kind) / row.laser_um for row in rows])
        ratios = ratios[np.isfinite(ratios)]
        print(
            f"{kind}: {ratios.size} held; at most 1.05 on {np.mean(ratios <= 1.05):.0%}, median "
            f"{np.median(ratios):.2f}, worst {ratios.max():.2f}"
        )


def main() -> None:
    """Examine the benches that the file does not have, and print all."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--drawn", type=int, default=40)
    parser.add_argument("--first", type=int, default=400)
    parser.add_argument("--file", type=Path, default=Path("build/process_values.jsonl"))
    options = parser.parse_args()
    lines = options.file.read_text().splitlines() if options.file.exists() else []
    rows = [HeldBench(**json.loads(line)) for line in lines]
    done = {row.name for row in rows}
    numbers = range(options.first, options.first + options.drawn)
    names = [*(bench.name for bench in BENCHES), *(f"drawn {number}" for number in numbers)]
    options.file.parent.mkdir(parents=True, exist_ok=True)
    for name in names:
        if name in done:
            continue
        rows.append(examine_bench(name))
        with options.file.open("a") as file:
            file.write(json.dumps(asdict(rows[-1])) + "\n")
    print_tables(rows)


if __name__ == "__main__":
    main()
