"""The protection campaign: every cell of the protection table with every failure, and pairs of
failures.

python tests/campaign/protection_campaign.py                  # all that is not done yet, and docs/measurements/protection.md
python tests/campaign/protection_campaign.py --only "optics drifts" --value estimate    # some cells, printed
python tests/campaign/protection_campaign.py --fresh          # forgets what is done
"""  # noqa: E501

from __future__ import annotations

import argparse
import json
import math
import random
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, as_completed, wait
from dataclasses import asdict, dataclass
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from climate_week import Climate, Week, run_week
from protection_cells import BY_WORDS, FAILURES, Outcome, SensorFailure, Undertaking, run_cell
from protection_page import write_page

from membrane_ctrl.controller.duties import Activity, FilmSensor, ProcessValue

RESULTS = Path(__file__).parents[2] / "build" / "protection.jsonl"
WEEKS = Path(__file__).parents[2] / "build" / "climate.json"
PHASES = (0.0, 2.0, 4.0)  # of humidity against temperature
# How long a cell is followed: beyond the ten minutes of a pause or of manual flow; beyond an
# experiment of a minute; for drifts that take hours in a hold; otherwise for minutes.
PAUSE_S, TUNE_S, DRIFT_S, HOLD_S = 660.0, 120.0, 45_000.0, 330.0
_PAIR_SEED, _ORDER_SEED = 7, 3


@dataclass(frozen=True)
class Cell:
    """One run of the campaign."""

    process_value: str
    undertaking: str
    failures: tuple[str, ...]
    seed: int

    @property
    def lasts_s(self) -> float:
        """How long it is followed: a drift that takes hours in a hold,
        everything else for minutes.
        """
        undertaking = Undertaking(self.undertaking)
        if undertaking is Undertaking.HOLD and len(self.failures) == 1 and self._drifts_slowly():
            return DRIFT_S
        activity = undertaking.activity
        if activity in (Activity.PAUSE, Activity.MANUAL):
            return PAUSE_S
        return TUNE_S if activity is Activity.TUNE else HOLD_S

    def _drifts_slowly(self) -> bool:
        """Whether a sensor that the process value follows drifts for hours; a gauge's drift is the
        same in all.
        """
        failure = BY_WORDS[self.failures[0]]
        followed = {
            ProcessValue.LASER: {FilmSensor.LASER, FilmSensor.GAUGE},
            ProcessValue.ESTIMATE: {FilmSensor.LASER, FilmSensor.OPTICS},
            ProcessValue.OPTICS: {FilmSensor.OPTICS},
        }
        return failure.slow and failure.sensor in followed[ProcessValue(self.process_value)]


def is_possible(value: ProcessValue, failure: SensorFailure) -> bool:
    """Whether the sensor has a part in that process value."""
    return not (value is ProcessValue.OPTICS and failure.sensor is FilmSensor.LASER)


def list_singles() -> Iterator[Cell]:
    """Every process value, undertaking and failure; the seed alternates between two films."""
    for number, (value, undertaking, failure) in enumerate(
        product(ProcessValue, Undertaking, FAILURES)
    ):
        if is_possible(value, failure):
            yield Cell(value.value, undertaking.value, (failure.words,), 1 + number % 2)


def list_pairs() -> Iterator[Cell]:
    """Pairs of failures of two sensors, each in a cell drawn from the seed: a covering array of the
    pairs' cells.

    Each failure meets at least one failure of each other sensor in every process value, and each
    undertaking is drawn equally often.
    """
    rng = np.random.default_rng(_PAIR_SEED)
    undertakings = list(Undertaking)
    count = 0
    for value, first in product(ProcessValue, FAILURES):
        for sensor in FilmSensor:
            partners = [
                other for other in FAILURES if other.sensor is sensor and is_possible(value, other)
            ]
            if sensor is first.sensor or not partners or not is_possible(value, first):
                continue
            second = partners[int(rng.integers(len(partners)))]
            undertaking = undertakings[count % len(undertakings)]
            count += 1
            yield Cell(value.value, undertaking.value, (first.words, second.words), 1 + count % 2)


def run(cell: Cell) -> Outcome:
    """Run one cell."""
    failures = tuple(BY_WORDS[words] for words in cell.failures)
    value, undertaking = ProcessValue(cell.process_value), Undertaking(cell.undertaking)
    return run_cell(value, undertaking, failures, cell.seed, cell.lasts_s)


def load_done() -> dict[Cell, Outcome]:
    """The results so far."""
    done: dict[Cell, Outcome] = {}
    if RESULTS.exists():
        for line in RESULTS.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            cell = Cell(**{**entry["cell"], "failures": tuple(entry["cell"]["failures"])})
            done[cell] = Outcome(
                **{key: math.nan if x is None else x for key, x in entry["outcome"].items()}
            )
    return done


def order_cells(cells: Iterable[Cell]) -> list[Cell]:
    """Cells in a seeded random order, so that a part of them is a fair sample."""
    ordered = list(cells)
    random.Random(_ORDER_SEED).shuffle(ordered)
    return ordered


def run_all(cells: Iterable[Cell], processes: int, minutes: float) -> dict[Cell, Outcome]:
    """Run what is not done yet, for so long; store each result, and return those that are done."""
    done = load_done()
    wanted = list(cells)
    todo = (cell for cell in wanted if cell not in done)
    until_s = time.monotonic() + 60.0 * minutes
    RESULTS.parent.mkdir(exist_ok=True)
    with (
        RESULTS.open("a", encoding="utf-8") as file,
        ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool,
    ):
        running: dict[Future[Outcome], Cell] = {}
        while True:
            while len(running) < 2 * processes and time.monotonic() < until_s:
                cell = next(todo, None)
                if cell is None:
                    break
                running[pool.submit(run, cell)] = cell
            if not running:
                break
            finished, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in finished:
                cell = running.pop(future)
                done[cell] = future.result()
                file.write(json.dumps(_to_json(cell, done[cell])) + "\n")
                file.flush()
    return {cell: done[cell] for cell in wanted if cell in done}


def _to_json(cell: Cell, outcome: Outcome) -> dict[str, object]:
    finite = {
        key: None if isinstance(x, float) and math.isnan(x) else x
        for key, x in asdict(outcome).items()
    }
    return {"cell": asdict(cell), "outcome": finite}


def run_weeks(days: float, processes: int) -> dict[str, Week]:
    """A week of climate in each process value; one that is done is read."""
    weeks: dict[str, Week] = {}
    if WEEKS.exists():
        for value, entry in json.loads(WEEKS.read_text(encoding="utf-8")).items():
            weeks[value] = Week(
                entry["days"], tuple(entry["faults"]), tuple(entry["notices"]), entry["held_share"]
            )
    todo = [value for value in ProcessValue if value.value not in weeks]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        futures = {
            pool.submit(run_week, value, Climate(humidity_phase=phase), 1, days): value
            for value, phase in zip(todo, PHASES, strict=False)
        }
        for future in as_completed(futures):
            weeks[futures[future].value] = future.result()
            WEEKS.write_text(
                json.dumps({v: asdict(week) for v, week in weeks.items()}), encoding="utf-8"
            )
    return {value.value: weeks[value.value] for value in ProcessValue if value.value in weeks}


def main() -> int:
    """Run the campaign, or the cells that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only", default="", help="failures whose names contain this; prints, writes no document"
    )
    parser.add_argument("--value", default="", help="only this process value")
    parser.add_argument(
        "--in", dest="within", default="", help="only undertakings whose names contain this"
    )
    parser.add_argument("--fresh", action="store_true", help="forget what is done")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument(
        "--minutes", type=float, default=math.inf, help="begin no cell after so long"
    )
    parser.add_argument(
        "--days",
        type=float,
        default=7.0,
        help="of climate without a failure, for each process value",
    )
    arguments = parser.parse_args()
    if arguments.fresh:
        RESULTS.unlink(missing_ok=True)
        WEEKS.unlink(missing_ok=True)
    if arguments.only or arguments.value or arguments.within:
        for cell in [*list_singles(), *list_pairs()]:
            chosen = arguments.value in cell.process_value and arguments.within in cell.undertaking
            if chosen and arguments.only in " and ".join(cell.failures):
                print(cell, run(cell), flush=True)
        return 0
    cells = [*list_singles(), *list_pairs()]
    results = run_all(order_cells(cells), arguments.processes, arguments.minutes)
    weeks = run_weeks(arguments.days, arguments.processes) if arguments.days > 0 else {}
    beyond = write_page(results, weeks, cells)
    faults = sum(len(week.faults) for week in weeks.values())
    print(
        f"{len(results)} runs, {beyond} beyond their bound; {len(weeks)} weeks, {faults} "
        "false faults"
    )
    return int(beyond > 0 or faults > 0)


if __name__ == "__main__":
    sys.exit(main())
