"""The whole fault campaign: every fault x every situation x seeds, and the stories; writes
docs/measurements/fault-matrix.md.

python tests/campaign/campaign.py                        # all, 2 processes, and the document
python tests/campaign/campaign.py --only "no light" --situation hold --seed 3    # one run again
python tests/campaign/campaign.py --story pause         # the stories whose names contain this
python tests/campaign/campaign.py --short               # a fixed part, up to the first violation
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from multiprocessing import get_context
from pathlib import Path

import campaign_board_stories
import campaign_interlock_stories
import campaign_sensor_stories
import campaign_stories
from campaign_cases import CASES, SITUATIONS, Case, Situation
from campaign_holds import HOLDS, run_hold_story
from campaign_run import Result, run_case
from campaign_times import RATE_HZ
from process_run import ProcessResult, process_table

from membrane_ctrl.controller.observation import Observation
from membrane_ctrl.controller.safety import TABLE, SafetyTable, Verdict
from membrane_ctrl.model.telemetry import SafeLevel, State

SEEDS = range(1, 5)
_BEGIN, _END = "## With real processes\n", "<!-- end of the part with real processes -->"
DOCUMENT = Path(__file__).parents[2] / "docs" / "measurements" / "fault-matrix.md"
_BY_NAME = {case.name: case for case in CASES}
_AT = {at.name: at for at in SITUATIONS}
STORIES = (
    *campaign_board_stories.STORIES,
    *campaign_interlock_stories.STORIES,
    *campaign_sensor_stories.STORIES,
    *campaign_stories.STORIES,
)
_STORIES = {story.__name__: story for story in STORIES}
_HOLDS = {story.__name__: story for story in HOLDS}
SHORT_SEEDS = (3, 4)  # drawn mirrors; the first may resume, the second may not


@dataclass(frozen=True)
class StoryResult:
    """Result of one story."""

    name: str
    about: str
    violations: tuple[str, ...]
    tripped: tuple[str, ...] = ()


@contextmanager
def listening() -> Iterator[set[str]]:
    """The names of the rules that trip meanwhile, whether or not they are the first cause."""
    tripped: set[str] = set()
    judge = SafetyTable.judge

    def heard(self: SafetyTable, state: State, observation: Observation) -> Verdict:
        verdict = judge(self, state, observation)
        if verdict.rule is not None:
            tripped.add(verdict.rule.name)
        return verdict

    SafetyTable.judge = heard  # type: ignore[method-assign]
    try:
        yield tripped
    finally:
        SafetyTable.judge = judge  # type: ignore[method-assign]


def run_row(
    name: str, seeds: Iterable[int], situations: Iterable[Situation] = SITUATIONS
) -> list[Result]:
    """All runs of one fault."""
    results = []
    for at in situations:
        for seed in seeds:
            with listening() as tripped:
                result = run_case(_BY_NAME[name], at, seed)
            results.append(replace(result, tripped=tuple(sorted(tripped))))
    return results


def run_story(name: str) -> StoryResult:
    """One story; what it raises is a violation."""
    story = _STORIES.get(name) or _HOLDS[name]
    about = (story.__doc__ or "").strip().splitlines()[0]
    with listening() as tripped:
        try:
            found = _STORIES[name]() if name in _STORIES else run_hold_story(_HOLDS[name])
        except Exception as error:
            found = [f"raised {type(error).__name__}: {error}"]
    return StoryResult(name, about, tuple(found), tuple(sorted(tripped)))


def run_all(processes: int) -> tuple[list[Result], list[StoryResult]]:
    """Every fault in every situation with every seed, and every story."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        story_results = pool.map(run_story, [*_STORIES, *_HOLDS])
        rows = pool.map(run_row, _BY_NAME, [tuple(SEEDS)] * len(_BY_NAME))
        return [result for row in rows for result in row], list(story_results)


def run_short(first: str = "") -> Iterator[tuple[str, tuple[str, ...]]]:
    """The stories, and every fault in two situations, `first` first:
    name and violations of each.
    """
    parts = {
        "holds": _tell_short(_HOLDS),
        "board": _tell_short([story.__name__ for story in campaign_board_stories.STORIES]),
        "interlocks": _tell_short([story.__name__ for story in campaign_interlock_stories.STORIES]),
        "orders": _tell_short([story.__name__ for story in campaign_stories.STORIES]),
        "matrix": _run_short_matrix(),
        "sensors": _tell_short([story.__name__ for story in campaign_sensor_stories.STORIES]),
    }
    return chain.from_iterable(
        [part for _, part in sorted(parts.items(), key=lambda item: item[0] != first)]
    )


def _tell_short(names: Iterable[str]) -> Iterator[tuple[str, tuple[str, ...]]]:
    for name in names:
        yield name, run_story(name).violations


def _run_short_matrix() -> Iterator[tuple[str, tuple[str, ...]]]:
    for number, case in enumerate(CASES):
        for at, seed in zip(
            (_AT["hold"], SITUATIONS[number % len(SITUATIONS)]), SHORT_SEEDS, strict=True
        ):
            yield f"{case.name} in {at.name}", run_case(case, at, seed).violations


def document(results: list[Result], story_results: list[StoryResult]) -> str:
    """The matrix as Markdown."""
    violations = [
        (f"{r.case}, {r.situation}, seed {r.seed}", v) for r in results for v in r.violations
    ]
    violations += [(t.name, v) for t in story_results for v in t.violations]
    by_cell: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for result in results:
        by_cell[result.case, result.situation].append(result)
    lines = [
        "# Fault matrix",
        "",
        "Generated by `make campaign` (`tests/campaign`): every fault in every situation, seeds "
        f"{SEEDS.start} to {SEEDS.stop - 1}, in virtual time at {RATE_HZ:g} Hz; and the "
        "stories below. The seed "
        "draws the weather and the moment of the fault. With odd seeds `resume.faults` lists "
        "every fault. Seeds 1 "
        "and 2 hold the twin's mirror, the others one with another pump, leak, film and hose "
        "(`tests/campaign/campaign_world.py`). Each run is monitored for 45 s after the "
        "fault, in which every safe "
        "level times out, and then through a stop.",
        "",
        f"**{len(results)} runs and {len(story_results)} stories, "
        f"{len(violations)} violations of an "
        "invariant.**",
        "",
        "A cell shows the deepest safe level, the first cause that was named, and the "
        "longest time from the fault "
        "to the first safe level; `-` where nothing tripped. In `fault` the first cause is "
        "another one (late ticks) "
        "and stays. A stopped process has no ticks: there the board must stop the pump "
        "within its watchdog period "
        "(0.5 s).",
        "",
        "To run a cell again: `python tests/campaign/campaign.py --only FAULT --situation "
        "SITUATION --seed SEED`.",
        "",
        "| fault | " + " | ".join(at.name for at in SITUATIONS) + " |",
        "|---|" + "---|" * len(SITUATIONS),
    ]
    lines += [
        f"| {case.name} | "
        + " | ".join(_cell(by_cell[case.name, at.name]) for at in SITUATIONS)
        + " |"
        for case in CASES
    ]
    lines += [
        "",
        "## Invariants, checked from outside in every period to the end of a run",
        "",
        *_INVARIANTS,
    ]
    lines += ["", "## Stories", "", "| story | what must happen |", "|---|---|"]
    lines += [
        f"| {t.name.replace('_', ' ')} | {t.about}{' **bad**' if t.violations else ''} |"
        for t in story_results
    ]
    lines += [
        "",
        "## Rules of the safety table",
        "",
        *_rules(results, story_results),
        "",
        *_processes(),
    ]
    if violations:
        lines += ["## Violations", ""]
        lines += [f"- {where}: {what}" for where, what in violations] + [""]
    return "\n".join(lines)


_INVARIANTS = (
    "- The true sag and pressure stay within the limits as long as their sensor reads true. "
    "Without a laser the "
    "bowl goes no further than 40 µm. The pressure always stays below the board's own limit. "
    "After a run has "
    "ended, only the board bounds a pump that runs on although its read-back says 0.",
    "- The drive of the pump's motor is 0 in standby and on the way down, at and below "
    "PUMP_OFF, 14 s after the "
    "last laser reading (8 s of mean flow, 6 s of ramp), after the vent was opened, and "
    "after the end of the run; "
    "during the ramp it falls at least as fast as the ramp does.",
    "- A lasting fault leads to its safe level within its time and is called by its name. It "
    "has stopped the pump "
    "and opened the vent once the levels between have timed out; both stay so to the end.",
    "- Only the resume rule leads out of `fault`: where it lists the cause, once the cause "
    "has been absent for "
    "its time, at most twice a day, and never after a vent was open, the board's included.",
    "- The mean flow of HOLD_FLOW is steady. Code that raises leaves the pump off in the "
    "same tick.",
    "- A safe level is left only from HOLD_FLOW; it always has a cause; the first cause stays.",
    "- A harmless event trips nothing, and the mirror ends at its setpoint.",
    "- Without ticks the board stops the pump within its watchdog period, also while others read.",
    "- A stop ends. If the pump does not obey, the stop does not succeed, and opens the vent.",
    "- Every event can be recorded.",
)


def _rules(results: list[Result], story_results: list[StoryResult]) -> list[str]:
    """In how many runs each rule has tripped, and in which stories."""
    lines = ["| rule | trips in | and in these stories |", "|---|---|---|"]
    for rule in sorted(TABLE, key=lambda rule: rule.code):
        runs = sum(rule.name in result.tripped for result in results)
        stories = [t.name.replace("_", " ") for t in story_results if rule.name in t.tripped]
        more = f" and {len(stories) - 2} more" if len(stories) > 2 else ""
        nowhere = "" if runs or stories else "**nowhere**"
        lines.append(
            f"| {rule.code} `{rule.name}` | {runs} runs | {nowhere}{', '.join(stories[:2])}{more} |"
        )
    return lines


def _processes() -> list[str]:
    """The part about real processes, as last written."""
    found = DOCUMENT.read_text(encoding="utf-8").partition(_BEGIN)[2].partition(_END)[0]
    return [_BEGIN + found + _END, ""]


def write_processes(results: list[ProcessResult]) -> None:
    """Put the results with real processes into the document."""
    violations = sum(len(result.violations) for result in results)
    lines = [
        f"**{len(results)} runs with real processes and sockets, {violations} violations.** "
        "A hold in its own "
        "process drives the emulated board (watchdog 0.5 s), in real time at 50 Hz; the "
        "fault begins while the "
        "mirror is inflated. Checked: exit, first cause and latched-fault file, the board's "
        "own output, sag and "
        "pressure, every tick in the tables once, UTC of all events, no process left behind.",
        "",
        *process_table(results),
        "",
        "Disk full: a small file system that is filled to the last byte. Files that may not "
        "grow: `RLIMIT_FSIZE` of "
        "the recorder's process. Wall clock: a library preloaded into all processes of the "
        "hold. Event loop: a "
        "signal handler that sleeps. To run one again: "
        "`python -m pytest -m campaign tests/campaign/test_campaign_processes.py -k NAME`.",
    ]
    before, _, rest = DOCUMENT.read_text(encoding="utf-8").partition(_BEGIN)
    DOCUMENT.write_text(
        before + "\n".join([_BEGIN, *lines, "", ""]) + _END + rest.partition(_END)[2], "utf-8"
    )


def _cell(results: list[Result]) -> str:
    deepest = max((r.safe_level for r in results), default=SafeLevel.NONE)
    if deepest == SafeLevel.NONE:
        return "-"
    cause = ", ".join(sorted({r.cause for r in results if r.cause}))
    slowest_s = max(
        (r.reaction_s for r in results if not math.isnan(r.reaction_s)), default=math.nan
    )
    bad = sum(bool(r.violations) for r in results)
    return f"{deepest.name} {cause} {slowest_s:.2f} s" + (f" **{bad} bad**" if bad else "")


def _chosen(
    only: str, situation: str | None, seed: int | None
) -> Iterator[tuple[Case, Situation, int]]:
    for at in SITUATIONS if situation is None else [_AT[situation]]:
        for number in SEEDS if seed is None else [seed]:
            yield _BY_NAME[only], at, number


def main(arguments: list[str] | None = None) -> int:
    """Run the campaign, or one part of it; 1 if an invariant was violated."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=sorted(_BY_NAME), metavar="FAULT")
    parser.add_argument("--situation", choices=sorted(_AT))
    parser.add_argument("--seed", type=int)
    parser.add_argument("--story", metavar="WORD")
    parser.add_argument("--short", action="store_true")
    parser.add_argument(
        "--first", default="", help="with --short: holds, board, orders, matrix or sensors"
    )
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args(arguments)
    if options.short:
        return _main_short(options.first)
    results: list[Result] = []
    story_results: list[StoryResult] = []
    if options.story:
        story_results = [
            run_story(name) for name in chain(_STORIES, _HOLDS) if options.story in name
        ]
    elif options.only:
        results = [
            run_case(*cell) for cell in _chosen(options.only, options.situation, options.seed)
        ]
    else:
        results, story_results = run_all(options.processes)
        DOCUMENT.write_text(document(results, story_results), encoding="utf-8")
    for result in results:
        came_of = result.violations or (
            (f"{result.safe_level.name} {result.cause}",) if options.only else ()
        )
        for what in came_of:
            print(f"{result.case} in {result.situation}, seed {result.seed}: {what}")
    for story in story_results:
        for what in story.violations or (("nothing wrong",) if options.story else ()):
            print(f"{story.name}: {what}")
    wrong = sum(len(found.violations) for found in (*results, *story_results))
    print(f"{len(results)} runs and {len(story_results)} stories, {wrong} violations")
    return int(wrong > 0)


def _main_short(first: str) -> int:
    for name, violations in run_short(first):
        if violations:
            print(f"{name}: {violations[0]}")
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
