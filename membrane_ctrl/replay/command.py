"""`replay RUN`: runs the recorded inputs through today's control code and reports the differences.

`--to-test` turns a part of the run into an incident: `tests/incidents/<name>/` holds the run's
configuration and inputs, and `incident.toml` the expected decisions. If the controller decided
wrongly, edit those to the decisions it should have made: the test then fails until it makes them.
"""

import math
import re
import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from membrane_ctrl.config import toml_file
from membrane_ctrl.config.schema import Config
from membrane_ctrl.controller.snapshot import UnknownSnapshotError
from membrane_ctrl.controller.tick_assembler import TickBatch
from membrane_ctrl.controller.tick_checksum import ColumnChoice
from membrane_ctrl.controller.tick_codec import Records
from membrane_ctrl.metrology.film.hencky_bowl import zernike_projection
from membrane_ctrl.model import (
    file_checksums,
    files,
    plain_json,
    run_events,
    shape_estimate,
    telemetry,
)
from membrane_ctrl.model.arithmetic import describe_arithmetic
from membrane_ctrl.model.errors import Exit, InputError
from membrane_ctrl.model.program import file_origin
from membrane_ctrl.model.state_tree import describe_tree, to_plain
from membrane_ctrl.replay import replay as replays
from membrane_ctrl.replay.numbers import NUMBERS_WITHIN, RecordedRows
from membrane_ctrl.run_files import event_log, inputs_file, run_config, table_fields
from membrane_ctrl.run_files.run import open_run
from membrane_ctrl.run_files.run_tables import RunTables, as_recorded

# The parts of a run folder that a replay needs: configuration, inputs, recorded decisions, recorded
# rows.

_FIELDS_SHOWN = 10  # of a state that differs; `--json` has all
# An event is stamped when it is reported, at the end of its tick.
DECISION_SLACK_S = 0.5
SCHEMA = "membrane-incident/1"
INCIDENTS = Path("tests/incidents")
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
# An incident is kept in the repository, which must not hold more than this.
_BYTES_MAX = 4_000_000


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """A run folder, opened for a replay."""

    folder: Path
    config: Config
    inputs: inputs_file.InputsReader
    decisions: list[replays.Decision]
    log_end_s: float  # end of the event log, if a crash truncated it
    config_damage: str = ""  # why this is not the run's configuration

    @property
    def foreign_arithmetic(self) -> str:
        """Where its outputs were computed, if not on this processor with these libraries; else
        empty.
        """
        recorded = self.inputs.arithmetic
        if recorded == describe_arithmetic():
            return ""
        return recorded or "an unknown processor"

    def recorded_rows(self, from_s: float) -> RecordedRows | None:
        """Its rows, if those of this program can have other bits without being others;
        else None.
        """
        names = [name for name in self.inputs.columns if name in telemetry.COLUMN]
        if not self.foreign_arithmetic and len(names) == len(self.inputs.columns):
            return None
        return RecordedRows(open_run(self.folder).tick_blocks(["tick", *names], from_s))

    def find_differences(
        self, row: telemetry.TelemetryRow
    ) -> dict[str, tuple[float, float]] | None:
        """Return the fields in which a row differs from the recorded one; None without such a
        row.
        """
        after_s = math.nextafter(row.mono_s, math.inf)
        recorded = next(
            open_run(self.folder).tick_blocks(telemetry.FIELDS, row.mono_s, after_s), None
        )
        if recorded is None:
            return None
        then = telemetry.TelemetryRow(*(float(recorded[name][0]) for name in telemetry.FIELDS))
        return replays.differing_fields(as_recorded(row), then)


def open_recorded(folder: Path) -> RecordedRun:
    """Open a run. Raises InputError, naming the folder and what is missing."""
    if not (folder / "config.toml").is_file():
        raise InputError(f"{folder}: not a run folder (no config.toml)")
    inputs = inputs_file.InputsReader(folder)
    if not inputs.exists:
        raise InputError(f"{folder}: no recorded inputs (no table `inputs`)")
    log = event_log.read_events(folder, [])
    cut = not any(isinstance(each.event, run_events.Ended) for each in log)
    decisions = replays.decisions_of((each.mono_s, each.event) for each in log)
    log_end_s = math.inf
    if cut:
        log_end_s = max((each.mono_s for each in log), default=0.0)
    config = run_config.read_exact_config(folder)
    right = file_checksums.is_comment_checksum_correct(files.read_text(folder / "config.toml"))
    damage = "config.toml: checksum mismatch (damaged or edited)"
    if right:
        damage = ""
    return RecordedRun(folder, config, inputs, decisions, log_end_s, damage)


def replay_command(
    folder: Path,
    from_s: float,
    to_s: float,
    to_test: str | None,
    as_json: bool,
    state: bool = False,
) -> int:
    """Replay a run or a part of it, and print whether the controller decides as recorded.

    Parameters
    ----------
    folder : Path
        Folder of the run.
    from_s, to_s : float
        Part of the run to report, in its seconds; infinite for no limit. The replay begins at the
        last snapshot before `from_s`.
    to_test : str or None
        Name of an incident to make of the part, which the tests then replay; None: none.
    as_json : bool
        Print one JSON object instead of text.
    state : bool
        Print what the controller remembers after the part, too.

    Returns
    -------
    int
        `Exit.DONE` if all rows and decisions are the same, `Exit.REJECTED` (3) if one differs.

    Raises
    ------
    InputError
        The run cannot be replayed, has no such part, or the name of the incident is taken.
    """
    if from_s >= to_s:
        raise InputError(f"--from {from_s:g}s is not before --to {to_s:g}s")
    # Replay the part.
    run = open_recorded(folder)
    started_s = time.perf_counter()
    begin, found = _replay_part(run, from_s, to_s)
    took_s = time.perf_counter() - started_s
    if not found.ticks:
        part = "" if math.isinf(to_s) else f" up to {to_s:g} s"
        reasons = [*run.inputs.damage, *(gap.reason for gap in found.gaps[:1])]
        why = f": {'; '.join(reasons)}" if reasons else ""
        raise InputError(f"{folder}: no tick to replay{part}{why}")
    if found.last_s < from_s:
        raise InputError(f"{folder}: --from {from_s:g}s: the record ends at {found.last_s:.1f} s")
    # Report it.
    report = _make_report(run, found, begin, to_s)
    remembered = found.state if state else None
    if as_json:
        printed = dict(report)
        if remembered is not None:
            printed["state"] = to_plain(remembered)
        print(plain_json.dumps(printed))
    else:
        print("\n".join(_format_report(report)))
        if remembered is not None:
            print(f"state      after the tick at {found.last_s:.3f} s:")
            print("\n".join(describe_tree(remembered)))
    # Make a test of it, if asked for.
    rate = found.ticks / took_s if took_s else math.inf
    print(f"{found.ticks} ticks in {took_s:.1f} s ({rate:.0f} a second)", file=sys.stderr)
    if to_test is not None:
        if found.gaps:
            raise InputError(
                f"--to-test: ticks are missing at {found.gaps[0].time_s:.1f} s, so the right "
                "decisions are "
                "unknown; choose a part without a gap with --from and --to"
            )
        target = write_incident(run, found, to_test, begin, to_s)
        print(f"written: {target}; describe the incident in its incident.toml", file=sys.stderr)
    return int(Exit.DONE if report["verdict"] in ("identical", "same numbers") else Exit.REJECTED)


def _replay_part(run: RecordedRun, from_s: float, to_s: float) -> tuple[int, replays.Replay]:
    """Start at the last snapshot before `from_s`, or at the run's start without a snapshot of
    today's layout.
    """
    inputs = run.inputs.start_at_snapshot(from_s)
    begin = replays.find_first_tick(inputs, from_s)
    if begin > 1:
        try:
            return begin, _replay_ticks(run, replays.recorded_ticks(inputs, begin), from_s, to_s)
        except UnknownSnapshotError as error:
            print(f"from the run's start: {error}", file=sys.stderr)
    try:
        return 1, _replay_ticks(run, replays.recorded_ticks(run.inputs), from_s, to_s)
    except UnknownSnapshotError as error:  # a snapshot after a gap
        print(f"without snapshots: {error}", file=sys.stderr)
        run.inputs.damage.clear()  # the second pass reports it again
        return 1, _replay_ticks(
            run, replays.recorded_ticks(run.inputs, snapshots=False), from_s, to_s
        )


def _replay_ticks(
    run: RecordedRun,
    ticks: Iterator[replays.RecordedTick | replays.Gap],
    from_s: float,
    to_s: float,
) -> replays.Replay:
    comparison = replays.Comparison(ColumnChoice(run.inputs.columns), run.recorded_rows(from_s))
    return replays.replay_record(run.config, ticks, zernike_projection(), from_s, to_s, comparison)


def _make_report(
    run: RecordedRun, found: replays.Replay, begin: int, to_s: float
) -> dict[str, Any]:
    """The result of a replay as plain data, for the text and for `--json`."""
    # 1. Decisions. No claim is made about the time after the log or the inputs end. A recorded
    #    decision just behind the end may be one that the replay took just before it: it counts only
    #    if the replay has as many
    end_s = min(to_s, run.log_end_s, found.last_s)
    today = [decision for decision in found.decisions if decision.time_s <= end_s]
    recorded = [d for d in run.decisions if found.begin_s <= d.time_s <= end_s + DECISION_SLACK_S]
    in_time = sum(decision.time_s <= end_s for decision in recorded)
    decisions = replays.find_unmatched(
        recorded[: max(in_time, len(today))], today, DECISION_SLACK_S
    )
    # 2. Rows and states: the first that differs, and in which fields
    first = found.first_different
    first_different = None
    fields = None
    if first is not None:
        first_different = {"tick": int(first.tick), "time_s": first.mono_s}
        fields = run.find_differences(first)
    state_differences = None
    if found.state_differences is not None:
        state_differences = asdict(found.state_differences)
    return {
        "verdict": _make_verdict(found, bool(decisions), bool(run.inputs.damage)),
        "recorded_by": run.inputs.program,
        "begin_s": found.begin_s,
        "from_snapshot": begin > 1,
        "ticks": found.ticks,
        "compared": found.compared,
        "computed_on": run.foreign_arithmetic or None,
        "unknown_columns": list(ColumnChoice(run.inputs.columns).unknown),
        "near": found.near,
        "different": found.different,
        "first_different": first_different,
        "fields": fields,
        "decisions": decisions,
        "state_differences": state_differences,
        "gaps": [
            {"after_tick": g.after_tick, "time_s": g.time_s, "ticks": g.ticks, "why": g.reason}
            for g in found.gaps
        ],
        "damage": [*filter(None, (run.config_damage,)), *run.inputs.damage],
    }


def _make_verdict(found: replays.Replay, decisions_differ: bool, damaged: bool) -> str:
    """The verdict: identical only if all was compared; decisions after a gap prove nothing about
    the code.
    """
    other_numbers = found.near and found.state_differences is not None
    if found.different or other_numbers or (decisions_differ and not found.gaps):
        return "different"
    if found.gaps or damaged or not found.compared:
        return "gaps"
    if found.near:
        return "same numbers"
    return "identical"


def _format_report(report: dict[str, Any]) -> list[str]:
    """The report as lines of text."""
    # What was compared, and with what the run was recorded.
    lines = [
        f"verdict    {report['verdict']}: {report['compared']} of {report['ticks']} ticks "
        "compared bit by bit"
    ]
    lines.append(f"recorded   by {report['recorded_by'] or 'an unknown program'}")
    if report["computed_on"]:
        lines.append(
            f"           on another processor, or with other libraries: {report['computed_on']}"
        )
    if report["unknown_columns"]:
        lines.append(
            "           with columns that this program does not have: "
            f"{', '.join(report['unknown_columns'])}"
        )
    # Differences that another processor explains.
    if report["near"]:
        lines.append(
            f"numbers    {report['near']} ticks have other last bits; decisions are the "
            "same, and numbers within "
            f"{NUMBERS_WITHIN:g}, or the single precision of the record"
        )
    if report["from_snapshot"]:
        lines.append(f"begins     at {report['begin_s']:.2f} s, from a snapshot of the controller")
    # Real differences: the first tick with one, and its values then and now.
    first = report["first_different"]
    if first is not None:
        lines.append(
            f"different  {report['different']} ticks, the first is tick {first['tick']} at "
            f"{first['time_s']:.3f} s"
        )
        if report["fields"] is None:
            lines.append("           the recorded values there cannot be read")
        elif not report["fields"]:
            lines.append(
                "           its row is as recorded: a smaller difference, an event, or an "
                "answer to a command"
            )
        for name, (then, now) in (report["fields"] or {}).items():
            lines.append(f"           {name}: recorded {then!r}, today {now!r}")
    lines += [f"decision   {sentence}" for sentence in report["decisions"]]
    # A snapshot has the whole state of the controller, more than a tick's row.
    if (state := report["state_differences"]) is not None:
        lines.append(
            f"state      differs from the snapshot at {state['time_s']:.2f} s in "
            f"{len(state['fields'])} fields:"
        )
        lines += [f"           {each}" for each in state["fields"][:_FIELDS_SHOWN]]
    # What could not be compared.
    for gap in report["gaps"]:
        lines.append(
            f"gap        {gap['ticks']} ticks after tick {gap['after_tick']} at "
            f"{gap['time_s']:.2f} s: {gap['why']}; "
            "decisions only up to the next snapshot"
        )
    lines += [f"damage     {sentence}" for sentence in report["damage"]]
    return lines


def write_incident(
    run: RecordedRun,
    found: replays.Replay,
    name: str,
    begin: int,
    to_s: float,
    incidents: Path = INCIDENTS,
) -> Path:
    """Make a test from a replay: a part of the run's inputs, with the decisions found as
    expectations.

    Parameters
    ----------
    run : RecordedRun
        The run.
    found : Replay
        Its replay.
    name : str
        Name of the test: small letters, digits, `-` and `_`.
    begin : int
        Tick at which it starts: the run's first, or one with a snapshot of the controller.
    to_s : float
        End of the part, in s of the run.
    incidents : Path
        Folder of these tests.

    Returns
    -------
    Path
        Folder of the test.

    Raises
    ------
    InputError
        The name is invalid or taken, the folder is missing, or the test is too large for a
        repository.
    """
    # A name of its own in the project's folder.
    if not _NAME.fullmatch(name):
        raise InputError(f"--to-test {name!r}: use small letters, digits, '-' and '_'")
    if not incidents.is_dir():
        raise InputError(f"{incidents}: no such folder; run this in the project folder")
    folder = incidents / name
    if folder.exists():
        raise InputError(f"{folder}: already exists; choose another name")
    folder.mkdir()
    # Its inputs, as a run of the part alone.
    kept = RunTables(folder)
    for frame in _select_between(run.inputs.start_at_snapshot(found.begin_s), begin, to_s):
        kept.add_ticks(
            TickBatch(frame.records, _make_input_rows(frame.records), frame.tails, frame.snapshots)
        )
        for estimate in frame.estimates.values():
            kept.add_shape(estimate)
        kept.sync_tables()
    kept.close()
    # What it is, and the decisions that it must reproduce.
    about = {
        **file_origin(SCHEMA),
        "what": f"replay of {run.folder.resolve().name}",
        "recorded_by": run.inputs.program,
        "decisions": [
            {"time_s": round(d.time_s, 3), "what": d.description}
            for d in replays.drop_repeats(found.decisions)
        ],
    }
    (folder / "incident.toml").write_text(tomli_w.dumps(about), encoding="utf-8")
    (folder / "config.toml").write_text(toml_file.dump_toml(run.config), encoding="utf-8")
    # Too large for a repository?
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    if size > _BYTES_MAX:
        shutil.rmtree(folder)
        raise InputError(
            f"--to-test: {size / 1e6:.0f} MB is too large for a test; narrow it with --from "
            "and --to"
        )
    return folder


def _make_input_rows(records: Records) -> telemetry.Rows:
    """Telemetry rows holding only the fields that repeat the ticks' inputs, NaN elsewhere."""
    rows = np.full((len(records), len(telemetry.FIELDS)), np.nan)
    for name, column in table_fields.ROW_COLUMNS.items():
        rows[:, telemetry.COLUMN[column]] = records[name]
    return rows


def _select_between(
    frames: inputs_file.InputsReader, begin: int, to_s: float
) -> Iterator[inputs_file.InputsFrame]:
    """Yield the inputs from a tick up to a time, with every figure that they refer to."""
    # Whole frames up to the end, of which only the wanted ticks are kept. A figure may be recorded
    # a frame before the tick that used it
    before: dict[float, shape_estimate.ShapeEstimate] = {}
    for frame in frames:
        if len(frame.records) and frame.records["now_s"][0] > to_s:
            return
        wanted = (frame.records["now_s"] <= to_s) & (frame.records["tick"] >= begin)
        ticks = set(frame.records["tick"][wanted].tolist())
        tails = {tick: tail for tick, tail in frame.tails.items() if tick in ticks}
        snapshots = {tick: snapshot for tick, snapshot in frame.snapshots.items() if tick == begin}
        if ticks:
            yield inputs_file.InputsFrame(
                frame.records[wanted], tails, snapshots, before | frame.estimates
            )
        before = {} if ticks else frame.estimates
