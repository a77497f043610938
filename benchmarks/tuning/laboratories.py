"""Laboratories drawn at random: a hold with the defaults by laser and by estimate, a session, and a
hold with its gains.

The laboratories (`tests/worlds/drawn_laboratories.py`) have actuators, rooms and lasers with the
flaws of real ones; none shares code with the twin. The hold starts as a lab's does, with the test
of the actuators. `python -m benchmarks.tuning.laboratories --count 40` examines them, one line of
JSON each; a second call continues where the first ended, and writes the page
docs/measurements/tuning-laboratories.md.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import re
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict
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
from tests.worlds.drawn_laboratories import DrawnLaboratory, draw_laboratory
from tests.worlds.foreign_plant import foreign_bench
from tuning import twin_hold
from tuning.commands.run import run_session
from tuning.options import TuneOptions
from tuning.report import page
from tuning.steps import design, observe, verify
from tuning.twin_hold import TwinHold

FILE = Path("build/laboratories.jsonl")
PAGE = Path("docs/measurements/tuning-laboratories.md")
SETTLE_S, HOLD_S = 180.0, 600.0
# ten minutes with gusts differ from ten others by a fifth
GUSTY_HOLD_S = 1800.0
LIMIT_UM = 10.0
OBEYED_MOST = 2  # refusals of a laboratory; what they ask for is done
_BLEED = re.compile(r"loop\.bleed_fraction larger by (?P<bleed>[\d.]+)")
_LIMIT = re.compile(r"--limit-um (?P<limit>[\d.]+)")
_SLOWER = "halve loop.kp_per_s and double loop.ti_s"


def open_hold(laboratory: DrawnLaboratory, config: Config, weather_seed: int) -> TwinHold:
    """A hold of the laboratory in virtual time."""
    plant = laboratory.plant(weather_seed)
    return TwinHold(config, bench=foreign_bench(plant), figures=laboratory.figures(plant))


def hold_laboratory(laboratory: DrawnLaboratory, config: Config) -> tuple[float, float]:
    """Standard deviation of the true centre, and share of the ticks in the state hold.

    Raises HoldError if the mirror is not held.
    """
    hold = open_hold(laboratory, config, 2)
    until_s = SETTLE_S + (GUSTY_HOLD_S if laboratory.gusts else HOLD_S)
    while hold.rows[-1].mono_s < until_s:
        hold.read_news()
    judged = [row for row in hold.rows if row.mono_s > SETTLE_S]
    true_um = np.array([row.truth_displacement_um for row in judged])
    held = np.array([row.state == State.HOLD for row in judged])
    return float(true_um.std()), float(held.mean())


def with_process_value(config: Config, value: str) -> Config:
    estimator = config.estimator.model_copy(update={"process_value": value})
    return config.model_copy(update={"estimator": estimator})


def examine(seed: int, judged: bool = True) -> dict[str, Any]:
    """Figures of one laboratory; a refusal or an error is a figure as well.

    Parameters
    ----------
    seed : int
    judged : bool
        Whether holds before and after are judged too, or the session alone.
    """
    begun_s = time.process_time()
    laboratory = draw_laboratory(seed)
    found: dict[str, Any] = asdict(laboratory)
    found |= {"text": laboratory.describe(), "obeyed": []}
    config = laboratory.config()
    try:
        if judged:
            config = _examine_defaults(laboratory, config, found)
        _examine_sessions(laboratory, config, found, judged)
    except Exception as error:  # one laboratory that fails must not end the others
        found["crashed"] = f"{type(error).__name__}: {error}"
    found["cpu_s"] = time.process_time() - begun_s
    return found


def _examine_defaults(laboratory: DrawnLaboratory, config: Config, found: dict[str, Any]) -> Config:
    """Hold by the laser and with the defaults; returns the configuration that holds the mirror."""
    for name, value in (("laser", "laser"), ("auto", "auto")):
        chosen = with_process_value(config, value)
        try:
            std_um, held_share = hold_laboratory(laboratory, chosen)
        except HoldError as error:
            found[f"by_{name}_error"] = str(error)
            continue
        found[f"by_{name}_um"] = std_um
        found[f"by_{name}_held"] = held_share
    if _SLOWER in found.get("by_auto_error", ""):
        found["obeyed"].append(found["by_auto_error"])
        slower = {"kp_per_s": config.loop.kp_per_s / 2, "ti_s": 2 * config.loop.ti_s}
        return config.model_copy(update={"loop": config.loop.model_copy(update=slower)})
    return config


def _examine_sessions(
    laboratory: DrawnLaboratory, config: Config, found: dict[str, Any], judged: bool
) -> None:
    """A session, again with what a refusal asks for, and a hold by the laser with what it kept."""
    limit_um = LIMIT_UM
    while True:
        found.pop("refused", None)
        hold = _run_session(laboratory, config, limit_um, found)
        found["limit_um"] = limit_um
        refused = found.get("refused", "")
        bleed, limit = _BLEED.search(refused), _LIMIT.search(refused)
        larger = limit is not None or "a larger --limit-um" in refused
        if not (bleed or larger) or len(found["obeyed"]) >= OBEYED_MOST:
            break
        found["obeyed"].append(refused)
        if bleed:
            opened = config.loop.bleed_fraction + float(bleed["bleed"])
            loop = config.loop.model_copy(update={"bleed_fraction": opened})
            config = config.model_copy(update={"loop": loop})
        else:
            limit_um = float(limit["limit"]) if limit is not None else 1.5 * limit_um
    if hold is None or not judged:
        return
    try:
        tuned = with_process_value(hold, "laser")
        found["tuned_um"], found["tuned_held"] = hold_laboratory(laboratory, tuned)
    except HoldError as error:
        found["tuned_error"] = str(error)


def _run_session(
    laboratory: DrawnLaboratory, config: Config, limit_um: float, found: dict[str, Any]
) -> Config | None:
    """Run a session and note its figures; returns the configuration with its gains, if there are
    any.
    """
    holds: list[TwinHold] = []

    def opened(given: Config) -> TwinHold:
        holds.append(open_hold(laboratory, given, 1))
        return holds[-1]

    tuned: Config | None = None
    output = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as logs,
        patch.object(twin_hold, "TwinHold", opened),
        patch.object(page, "write_report"),  # its pictures take as long as the session
    ):
        try:
            with contextlib.redirect_stderr(output), contextlib.redirect_stdout(output):
                found["exit"] = run_session(_make_options(config, Path(logs), limit_um))
        except CommandError as error:
            found |= {"exit": int(error.exit), "refused": "; ".join(error.lines)}
        except Exception as error:
            found |= {"exit": 1, "crashed": f"{type(error).__name__}: {error}"}
        found["output"] = [line for line in output.getvalue().splitlines() if " left" not in line]
        with contextlib.suppress(CommandError, OSError):
            tuned = _read_session(Path(logs), config, found)
    found |= _judge_motion(holds, laboratory.rate_hz)
    return tuned


def _judge_motion(holds: Sequence[TwinHold], rate_hz: float) -> dict[str, float]:
    """Minutes of the session, and how far it moved the true centre from its setpoint."""
    rows = [row for hold in holds for row in hold.rows if row.state in (State.HOLD, State.TUNE)]
    after = rows[round(60 * rate_hz) :]
    furthest = max(after, key=lambda row: abs(row.truth_displacement_um), default=None)
    return {
        "minutes": len(rows) / rate_hz / 60,
        "excursion_um": 0.0 if furthest is None else abs(furthest.truth_displacement_um),
        "excursion_s": math.nan if furthest is None else furthest.mono_s,
        "excursion_state": math.nan if furthest is None else float(furthest.state),
    }


def _make_options(config: Config, logs: Path, limit_um: float) -> TuneOptions:
    return TuneOptions(
        config=config,
        twin=True,
        where=Where(),
        logs=logs,
        session=None,
        name="laboratory",
        author="benchmark",
        reason="drawn laboratory",
        limit_um=limit_um,
        observe_s=observe.OBSERVE_S,
        verify_s=600.0,
        take_over=False,
        yes=True,
        choose="",
        json=False,
    )


def _read_session(logs: Path, config: Config, found: dict[str, Any]) -> Config | None:
    """Note what the session's folder has; returns the configuration with kept gains."""
    folder = find_newest_session(logs)
    rows, chosen = design.load_candidates(folder)
    present = next(row for row in rows if row.name == "present")
    found["candidate"] = chosen.name
    found["predicted_um"] = chosen.figures.std_um
    found["predicted_present_um"] = present.figures.std_um
    found["load_peak_ratio"] = chosen.load_peak_um / present.load_peak_um
    done = verify.load_verified(folder)
    found |= {"kept": done.kept, "reason": done.reason}
    found["growths"] = [stage.growth for stage in done.stages]
    if not done.kept:
        return None
    return config.model_copy(update={"loop": done.after, "pump": folder.config.pump})


def outcome(row: dict[str, Any]) -> str:
    """How a laboratory's session ended."""
    if "crashed" in row:
        return "crashed"
    first = "refused, then " if row.get("obeyed") else ""
    if row.get("refused"):
        return f"{first}refused"
    if row.get("kept"):
        return f"{first}kept"
    if "kept" in row:
        return f"{first}rolled back"
    return f"{first}present gains stay"


def main() -> None:
    """Examine what is missing in the file, then print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--file", type=Path, default=FILE)
    parser.add_argument("--sessions-only", action="store_true")
    given = parser.parse_args()
    given.file.parent.mkdir(parents=True, exist_ok=True)
    known: set[int] = set()
    if given.file.exists():
        known = {json.loads(line)["seed"] for line in given.file.read_text().splitlines()}
    for seed in range(given.first, given.first + given.count):
        if seed in known:
            continue
        row = examine(seed, judged=not given.sessions_only)
        with given.file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        print(seed, outcome(row), f"{row['cpu_s']:.0f} s", flush=True)


if __name__ == "__main__":
    main()
