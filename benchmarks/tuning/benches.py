"""Random benches of another physics: a hold with the defaults, a whole session, and a hold with its
result.

The benches share no physics with the twin (`tests/worlds/foreign_plant.py`). The session knows of
them what a lab knows: the rate, and which sensors there are. `python -m benchmarks.tuning.benches
--benches 200` examines them, one line each in `build/benches.jsonl`; a second call goes on where
the first ended. It prints the tables of docs/measurements/tuning.md.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import re
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from multiprocessing import Pool
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from membrane_ctrl.config.schema import Config
from membrane_ctrl.control_port.ctl import Where
from membrane_ctrl.model.errors import CommandError
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.sessions.folder import find_newest_session
from membrane_ctrl.sessions.live_hold import HoldError
from tests.support.figures import Figure, at_least, at_most
from tests.worlds import foreign_plant
from tuning import gains_file, twin_hold
from tuning.commands.run import run_session
from tuning.options import TuneOptions
from tuning.report import page
from tuning.steps import design, observe, verify
from tuning.twin_hold import TwinHold

DEFAULT_FILE = Path("build/benches.jsonl")
SETTLE_S, HOLD_S = 120.0, 600.0
# ten minutes with gusts differ from ten others by a fifth, and up to 1.7 times
GUSTY_HOLD_S = 3600.0
LIMIT_UM = 10.0  # of the experiments: `tune run --limit-um`
FRESH = 3  # benches of `make bench`, others every day
OBEYED_MOST = 2  # refusals of a bench; what they ask for is done
_ASKED = re.compile(
    r"loop\.bleed_fraction larger by (?P<bleed>[\d.]+)|--limit-um "
    r"(?P<limit>[\d.]+)|(?P<larger>a larger --limit-um)"
)
_SLOWER = "halve loop.kp_per_s and double loop.ti_s"
SOUND = 1.2  # least ratio of full flow to leak of a bench that can be held


@dataclass(frozen=True)
class DrawnBench:
    """What the second world has, and what the configuration says of it."""

    seed: int
    shape: str
    full_um_per_s: float
    delay_s: float
    lag_s: float
    start: float
    stall: float
    play: float
    leak_um_per_s: float
    laser_um: float
    rate_hz: float
    barometer: bool
    weather: float
    gusts: bool

    def plant(self, weather_seed: int) -> foreign_plant.ForeignPlant:
        """The bench, in weather that no other bench has: what one hour shares is no proof."""
        pump = foreign_plant.ForeignPump(
            self.shape,
            self.full_um_per_s,
            self.delay_s,
            self.lag_s,
            self.start,
            self.stall,
            self.play,
        )
        return foreign_plant.ForeignPlant(
            pump,
            10 * self.seed + weather_seed,
            self.weather,
            self.leak_um_per_s,
            self.gusts,
            self.laser_um,
            self.barometer,
        )

    def config(self) -> Config:
        """The configuration of somebody who knows the rate and which sensors there are."""
        sensors = {
            "feedforward_barometer": self.barometer,
            "feedforward_temperature": self.barometer,
        }
        return foreign_plant.foreign_config(rate_hz=self.rate_hz, **sensors)


def drawn(seed: int) -> DrawnBench:
    """A sound bench: gain 0.3 to 3, delay, lag, leak, laser, rate,
    sensors and weather at random.
    """
    rng = np.random.default_rng([20261122, seed])

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    while True:
        full, leak = 5.3 * log(0.3, 3.0), log(0.3, 5.0)
        if SOUND <= full / leak <= 20.0:
            break
    shape = str(rng.choice(sorted(foreign_plant.CURVES)))
    stiction = float(rng.uniform(0.0, 0.08)) if rng.random() < 0.5 else 0.0
    starts = next((d for d in np.linspace(0, 1, 1001) if foreign_plant.CURVES[shape](d) > 0), 0.0)
    return DrawnBench(
        seed=seed,
        shape=shape,
        full_um_per_s=full,
        delay_s=log(0.05, 1.0),
        lag_s=log(0.05, 1.5),
        start=starts + stiction if stiction else 0.0,
        stall=starts + stiction / 2 if stiction else 0.0,
        play=float(rng.uniform(0.01, 0.05)) if shape == "hysteretic" else 0.0,
        leak_um_per_s=leak,
        laser_um=log(0.1, 3.0),
        rate_hz=float(rng.choice([10.0, 20.0, 25.0, 50.0, 100.0])),
        barometer=bool(rng.random() < 0.6),
        weather=log(0.3, 3.0),
        gusts=bool(rng.random() < 0.3),
    )


def least_std_um(bench: DrawnBench, weather_seed: int) -> float:
    """The minimum-variance bound of this bench with its laser alone.

    The centre's error is at least that of the best linear prediction of the disturbance over the
    dead time from the readings until now (see `minimum_variance`); here the predictor is fitted to
    one half of the weather itself and judged by the other one, as the second world's weather has no
    model. A finite predictor: the bound is an estimate, a few per cent too high.
    """
    plant = bench.plant(weather_seed)
    centre_um = plant.undisturbed_um()
    step_s = 1 / bench.rate_hz
    time_s = np.arange(0.0, plant.weather_s, step_s)
    true = np.interp(
        time_s, np.linspace(0, plant.weather_s, centre_um.size, endpoint=False), centre_um
    )
    read = true + bench.laser_um * np.random.default_rng(weather_seed).standard_normal(true.size)
    ahead = max(1, round((bench.delay_s + 0.5 * step_s) * bench.rate_hz))
    # means over spans that grow with age: the newest readings one by one, older ones in ever longer
    # means
    edges = np.unique(np.round(np.geomspace(1, min(4096, true.size // 8), 40)).astype(int))
    total = np.concatenate(([0.0], np.cumsum(read)))
    now = np.arange(edges[-1], true.size - ahead, max(1, round(0.2 * bench.rate_hz)))
    means = np.column_stack([(total[now + 1] - total[now + 1 - span]) / span for span in edges])
    target = true[now + ahead] - means[:, -1]
    features = means[:, :-1] - means[:, -1:]
    half = now.size // 2
    weights, *_ = np.linalg.lstsq(features[:half], target[:half], rcond=None)
    return float((target[half:] - features[half:] @ weights).std())


def examined(bench: DrawnBench, short: bool = False) -> dict[str, Any]:
    """Figures of one bench; a refusal or an error is a figure as well. What a refusal asks for is
    done.
    """
    found: dict[str, Any] = asdict(bench) | {"least_um": least_std_um(bench, 3), "obeyed": []}
    config, limit_um = bench.config(), LIMIT_UM
    found |= _held("default", bench, config)
    if _SLOWER in found.get("default_error", ""):
        found["obeyed"].append(found.pop("default_error"))
        slower = {"kp_per_s": config.loop.kp_per_s / 2, "ti_s": 2 * config.loop.ti_s}
        config = config.model_copy(update={"loop": config.loop.model_copy(update=slower)})
        found |= _held("default", bench, config)
    while "default_error" not in found:
        found |= _session(bench, config, limit_um, short) | {"limit_um": limit_um}
        asked = _ASKED.search(found.get("refused", ""))
        if short or asked is None or len(found["obeyed"]) == OBEYED_MOST:
            break
        found["obeyed"].append(found.pop("refused"))
        if asked["bleed"]:
            opened = config.loop.bleed_fraction + float(asked["bleed"])
            config = config.model_copy(
                update={"loop": config.loop.model_copy(update={"bleed_fraction": opened})}
            )
        else:
            limit_um = float(asked["limit"] or 1.5 * limit_um)
    return found


def _session(bench: DrawnBench, config: Config, limit_um: float, short: bool) -> dict[str, Any]:
    """Figures of a whole session and, if gains were kept, of a hold with them."""
    hold: list[TwinHold] = []

    def opened(given: Config) -> TwinHold:
        hold.append(twin_hold_of(bench, given, 1))
        return hold[-1]

    found: dict[str, Any] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.object(twin_hold, "TwinHold", opened),
        patch.object(page, "write_report"),  # its pictures take as long as the session
    ):
        output = io.StringIO()
        try:
            with contextlib.redirect_stderr(output), contextlib.redirect_stdout(output):
                found["exit"] = run_session(_options(config, Path(folder), limit_um, short))
        except CommandError as error:
            found |= {"exit": int(error.exit), "refused": "; ".join(error.lines)}
        except Exception as error:
            found |= {"exit": 1, "crashed": f"{type(error).__name__}: {error}"}
        found["said"] = output.getvalue().splitlines()[-6:]
        rows = [row for each in hold for row in each.rows if row.state in (State.HOLD, State.TUNE)]
        rate = bench.rate_hz
        found["minutes"] = len(rows) / rate / 60
        found["excursion_um"] = max(
            (abs(row.truth_displacement_um) for row in rows[round(60 * rate) :]), default=0.0
        )
        with contextlib.suppress(CommandError, OSError):
            found |= _kept(bench, Path(folder), config)
    return found


def _options(config: Config, logs: Path, limit_um: float, short: bool = False) -> TuneOptions:
    return TuneOptions(
        config=config,
        twin=True,
        where=Where(),
        logs=logs,
        session=None,
        name="bench",
        author="benchmark",
        reason="drawn bench",
        limit_um=limit_um,
        observe_s=observe.OBSERVE_S,
        verify_s=300.0 if short else 600.0,
        take_over=False,
        yes=not short,
        choose="same-load" if short else "",
        json=False,
        short=short,
    )


def _kept(bench: DrawnBench, logs: Path, config: Config) -> dict[str, Any]:
    folder = find_newest_session(logs)
    done = verify.load_verified(folder)
    gains = gains_file.load_gains(folder.file_path("gains.toml"))
    sigma = design.load_candidates(folder)[1].sigma
    found: dict[str, Any] = {
        "kept": done.kept,
        "reason": done.reason,
        "predicted_um": gains.predicted_std_um,
    }
    found["predicted_sigma_um"] = sigma.std_um if sigma is not None else math.nan
    if not done.kept:
        return found
    tuned = config.model_copy(update={"loop": done.after, "pump": folder.config.pump})
    return found | _held("tuned", bench, tuned)


def twin_hold_of(bench: DrawnBench, config: Config, weather_seed: int) -> TwinHold:
    """A hold of the bench in virtual time."""
    return TwinHold(config, bench=foreign_plant.foreign_bench(bench.plant(weather_seed)))


def _held(name: str, bench: DrawnBench, config: Config) -> dict[str, Any]:
    """The true centre of a hold in weather of its own; its end, if it ends early."""
    try:
        hold = twin_hold_of(bench, config, 2)
        while hold.rows[-1].mono_s < SETTLE_S + (GUSTY_HOLD_S if bench.gusts else HOLD_S):
            hold.read_news()
    except HoldError as error:
        return {f"{name}_error": str(error)}
    true_um = np.array([row.truth_displacement_um for row in hold.rows if row.mono_s > SETTLE_S])
    held = np.mean([row.state == State.HOLD for row in hold.rows if row.mono_s > SETTLE_S])
    return {f"{name}_um": float(true_um.std()), f"{name}_held": float(held)}


def _one(seed: int, short: bool = False) -> dict[str, Any]:
    try:
        return examined(drawn(seed), short)
    except Exception as error:  # one bench that fails must not end the others
        return asdict(drawn(seed)) | {"crashed": f"{type(error).__name__}: {error}"}


def outcome(row: dict[str, Any]) -> str:
    """One word for a bench."""
    if "crashed" in row:
        return "crashed"
    if "default_error" in row:
        return "not held"
    first = "refused, then " if row.get("obeyed") else ""
    if row.get("kept"):
        return f"{first}kept"
    return f"{first}rolled back" if "kept" in row else f"{first}refused"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """The tables of docs/measurements/tuning.md."""
    kept = [row for row in rows if "tuned_um" in row]
    ratio = np.array([row["tuned_um"] / row["least_um"] for row in kept])
    predicted = np.array([row["predicted_um"] / row["tuned_um"] for row in kept])
    off = [(row["predicted_um"] - row["tuned_um"]) / row["predicted_sigma_um"] for row in kept]
    default = np.array([row["default_um"] / row["least_um"] for row in rows if "default_um" in row])
    lines = ["| of the drawn benches | |", "|---|---|", f"| examined | {len(rows)} |"]
    words = [outcome(row) for row in rows]
    lines += [f"| {word} | {words.count(word)} |" for word in sorted(set(words))]
    if ratio.size:
        lines += [
            f"| std with defaults / bound: median, worst | {np.median(default):.2f}, "
            f"{default.max():.2f} |",
            f"| std after tuning / bound: median, worst | {np.median(ratio):.2f}, "
            f"{ratio.max():.2f} |",
            f"| predicted over achieved | {predicted.min():.2f} to {predicted.max():.2f}, median "
            f"{np.median(predicted):.2f} |",
            f"| predicted within 20 % of achieved | {np.mean(abs(predicted - 1) <= 0.2):.0%} |",
            f"| achieved within 2 sigma of the prediction | {np.mean(np.abs(off) <= 2):.0%} |",
        ]
    lines.append(f"| excursion above the limit | {sum(_too_far(row) for row in rows)} |")
    lines += ["", "| bench | outcome | why |", "|---|---|---|"]
    for row in rows:
        ends = [row.get(name) for name in ("crashed", "default_error", "refused", "reason")]
        last = next(filter(None, ends), "kept")
        why = "; then: ".join([*row.get("obeyed", ()), last])
        over = f"; excursion {row['excursion_um']:.1f} µm" if _too_far(row) else ""
        if outcome(row) != "kept" or over:
            lines.append(f"| {row['seed']}: {_short(row)} | {outcome(row)} | {why}{over} |")
    return "\n".join(lines)


def _too_far(row: dict[str, Any]) -> bool:
    """Whether the session moved the mirror further than its limit."""
    return bool(row.get("excursion_um", 0.0) > row.get("limit_um", LIMIT_UM))


def run(count: int = FRESH) -> list[Figure]:
    """Figures of `make bench`: benches that nobody has seen, beside the stored table of
    docs/measurements/tuning.md.
    """
    first = 1000 + FRESH * datetime.now(UTC).toordinal()
    rows = [_one(seed) for seed in range(first, first + count)]
    kept = [row for row in rows if "tuned_um" in row]
    figures = [at_least("kept gains", 100 * len(kept) / count, "%", 95.0)]
    figures.append(
        at_most(
            "furthest excursion", max(row.get("excursion_um", 0.0) for row in rows), "um", LIMIT_UM
        )
    )
    if kept:
        ratio = float(np.median([row["tuned_um"] / row["least_um"] for row in kept]))
        largest_excess = max(abs(row["predicted_um"] / row["tuned_um"] - 1) for row in kept)
        figures.append(at_most("std after tuning over the bound, median", ratio, "", 1.25))
        figures.append(
            at_most("predicted std against achieved, worst", 100 * largest_excess, "%", 20.0)
        )
    return figures


def _short(row: dict[str, Any]) -> str:
    return (
        f"{row['shape']}, {row['full_um_per_s']:.1f} against {row['leak_um_per_s']:.1f} µm/s, "
        f"{row['delay_s']:.2f} + {row['lag_s']:.2f} s, laser {row['laser_um']:.1f} µm, "
        f"{row['rate_hz']:g} Hz"
        f"{', gusty' if row['gusts'] else ''}"
    )


def main() -> None:
    """Examine what is missing in the file, then print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--benches", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--file", type=Path, default=DEFAULT_FILE)
    parser.add_argument("--short", action="store_true")
    given = parser.parse_args()
    given.file.parent.mkdir(parents=True, exist_ok=True)
    rows = (
        [json.loads(line) for line in given.file.read_text().splitlines()]
        if given.file.exists()
        else []
    )
    known = {row["seed"] for row in rows}
    with Pool(given.processes) as pool, given.file.open("a", encoding="utf-8") as file:
        missing = sorted({*range(given.first, given.first + given.benches)} - known)
        for row in pool.imap_unordered(partial(_one, short=given.short), missing):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    print(table(sorted(rows, key=lambda row: row["seed"])))


if __name__ == "__main__":
    main()
