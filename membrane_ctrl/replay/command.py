"""`replay RUN`: the run's recorded inputs through today's control code, and what is not the same."""

import json
import math
import sys
import time
from pathlib import Path
from typing import Any

from membrane_ctrl.controller.memory import UnknownMemoryError
from membrane_ctrl.metrology.optics.hencky import zernike_projection
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.replay.incident import RecordedRun, open_run, write_incident
from membrane_ctrl.replay.replay import (
    Replay,
    differing_fields,
    recorded_ticks,
    replay,
    tick_to_begin_with,
    unmatched,
)

# An event is stamped when it is told, at the end of its tick.
DECISION_SLACK_S = 0.5


def replay_command(folder: Path, from_s: float, to_s: float, to_test: str | None, as_json: bool) -> int:
    """Replay and report; exit 3 if anything is not the same, 0 if all is.

    Raises
    ------
    InputError
        Not a run that can be replayed, a part that it does not have, or (with `to_test`) a name that is taken.
    """
    if from_s >= to_s:
        raise InputError(f"--from {from_s:g}s is not before --to {to_s:g}s")
    run = open_run(folder)
    started_s = time.perf_counter()
    begin, found = _replayed(run, from_s, to_s)
    took_s = time.perf_counter() - started_s
    if not found.ticks:
        part = "" if math.isinf(to_s) else f" up to {to_s:g} s"
        why = "; ".join((*run.inputs.damage, *(gap.reason for gap in found.gaps[:1])))
        raise InputError(f"{folder}: no tick to replay{part}{why and ': '}{why}")
    if found.last_s < from_s:
        raise InputError(f"{folder}: --from {from_s:g}s: the record ends at {found.last_s:.1f} s")
    report = _report(run, found, begin, to_s)
    if as_json:
        print(json.dumps(report))
    else:
        print("\n".join(_lines(report)))
    rate = found.ticks / took_s if took_s else math.inf
    print(f"{found.ticks} ticks in {took_s:.1f} s ({rate:.0f} a second)", file=sys.stderr)
    if to_test is not None:
        if found.gaps:
            raise InputError(
                f"--to-test: ticks are missing at {found.gaps[0].time_s:.1f} s, so that what the controller should "
                "have decided is not known; choose a part without a gap with --from and --to"
            )
        target = write_incident(run, found, to_test, begin, to_s)
        print(f"written: {target}; say in its incident.toml what happened", file=sys.stderr)
    return int(Exit.DONE if report["verdict"] == "identical" else Exit.REJECTED)


def _replayed(run: RecordedRun, from_s: float, to_s: float) -> tuple[int, Replay]:
    """Begin at the last memory before `from_s`; with the run, if there is none or it is not of today's layout."""
    inputs = run.inputs.since(from_s)
    begin = tick_to_begin_with(inputs, from_s)
    if begin > 1:
        try:
            return begin, replay(run.config, recorded_ticks(inputs, begin), zernike_projection(), from_s, to_s)
        except UnknownMemoryError as error:
            print(f"from the run's start: {error}", file=sys.stderr)
        finally:
            run.inputs.program = inputs.program
    try:
        return 1, replay(run.config, recorded_ticks(run.inputs), zernike_projection(), from_s, to_s)
    except UnknownMemoryError as error:  # one behind a gap
        print(f"without recorded memories: {error}", file=sys.stderr)
        run.inputs.damage.clear()  # it is told again
        ticks = recorded_ticks(run.inputs, memories=False)
        return 1, replay(run.config, ticks, zernike_projection(), from_s, to_s)


def _report(run: RecordedRun, found: Replay, begin: int, to_s: float) -> dict[str, Any]:
    # where the log or the inputs end early, nothing is said of what came then
    end_s = min(to_s, run.told_until_s, found.last_s)
    today = [decision for decision in found.decisions if decision.time_s <= end_s]
    recorded = [d for d in run.decisions if found.begin_s <= d.time_s <= end_s + DECISION_SLACK_S]
    in_time = sum(decision.time_s <= end_s for decision in recorded)
    decisions = unmatched(recorded[: max(in_time, len(today))], today, DECISION_SLACK_S)
    first = found.first_different
    fields: dict[str, tuple[float, float]] | None = None
    if first is not None and (row := run.row_at(first.mono_s)) is not None:
        fields = differing_fields(first, row)
    return {
        "verdict": _verdict(found, bool(decisions), bool(run.inputs.damage)),
        "recorded_by": run.inputs.program,
        "begin_s": found.begin_s,
        "from_memory": begin > 1,
        "ticks": found.ticks,
        "compared": found.compared,
        "different": found.different,
        "first_different": None if first is None else {"tick": int(first.tick), "time_s": first.mono_s},
        "fields": fields,
        "decisions": decisions,
        "gaps": [
            {"after_tick": g.after_tick, "time_s": g.time_s, "ticks": g.ticks, "why": g.reason} for g in found.gaps
        ],
        "damage": [*filter(None, (run.config_damage,)), *run.inputs.damage],
    }


def _verdict(found: Replay, decisions_differ: bool, damaged: bool) -> str:
    """Identical only if everything was compared; behind a gap another decision says nothing of the code."""
    if found.different or (decisions_differ and not found.gaps):
        return "different"
    return "gaps" if found.gaps or damaged or not found.compared else "identical"


def _lines(report: dict[str, Any]) -> list[str]:
    """What a person wants to read."""
    lines = [f"verdict    {report['verdict']}: {report['compared']} of {report['ticks']} ticks compared bit by bit"]
    lines.append(f"recorded   by {report['recorded_by'] or 'an unknown program'}")
    if report["from_memory"]:
        lines.append(f"begins     at {report['begin_s']:.2f} s, with the controller's recorded memory")
    first = report["first_different"]
    if first is not None:
        lines.append(
            f"different  {report['different']} ticks, the first is tick {first['tick']} at {first['time_s']:.3f} s"
        )
        if report["fields"] is None:
            lines.append("           what was recorded there is not in the *.rrd files")
        elif not report["fields"]:
            lines.append("           its row is the same: events or answers to commands differ")
        for name, (then, now) in (report["fields"] or {}).items():
            lines.append(f"           {name}: recorded {then!r}, today {now!r}")
    lines += [f"decision   {sentence}" for sentence in report["decisions"]]
    for gap in report["gaps"]:
        lines.append(
            f"gap        {gap['ticks']} ticks after tick {gap['after_tick']} at {gap['time_s']:.2f} s: {gap['why']}; "
            "decisions only up to the next recorded memory"
        )
    lines += [f"damage     {sentence}" for sentence in report["damage"]]
    return lines
