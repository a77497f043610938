"""What a run prints at its end: the fault in which it ends, then its figures and its folder."""

from __future__ import annotations

import json
import math
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from membrane_ctrl.config.schema import RecordingConfig
from membrane_ctrl.control_port.link_code import draw_link_code
from membrane_ctrl.controller.tick import TickOutputs
from membrane_ctrl.model import errors, events
from membrane_ctrl.model.standing_fault import standing_fault_after
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.run_files.held_error import HeldError

_UNKNOWN_PUMP = (
    "DEVICE FAILED: the board did not answer while the run stopped, so that the state of the "
    "pump is unknown",
    "  to do:    look whether the pump runs, and switch off its supply; then find out why "
    "the link failed",
)
_NO_FAULT = (
    "SAFETY TRIP: the control program failed in the fault state",
    "  to do:    see the last lines of events.jsonl in the run folder, and report them",
)
_COUNTS = {
    "cycles": "shape cycles",
    "missed_ticks": "missed ticks",
    "fault_count": "faults during the run",
}


@dataclass(slots=True)
class RunEnd:
    """How a run ends, from the memory of its own process: no disk is needed.

    Attributes
    ----------
    exit : Exit or None
        The exit code; None until the run has ended.
    fault : Fault or None
        The fault that stands; None if there is none.
    fault_s : float
        When it tripped, on the run's clock.
    state : State or None
        Of the last tick before the run ended.
    has_held : bool
        Whether the run has reached the state `hold`.
    """

    exit: errors.Exit | None = None
    fault: events.Fault | None = None
    fault_s: float = math.nan
    state: State | None = None
    has_held: bool = False

    def handle_tick(self, outputs: TickOutputs) -> None:
        """Note a tick's state and events."""
        state = State(int(outputs.row.state))
        # When the duration is over, the pump is taken off: the state before is what counts
        if outputs.finished is None and state is not State.LOWER:
            self.state = state
            self.has_held |= state is State.HOLD
        for event in outputs.events:
            if isinstance(event, events.Fault):
                self.fault_s = outputs.row.mono_s
            self.fault = standing_fault_after(self.fault, event)

    def judge_exit(self, finished: errors.Exit, is_standby: bool) -> errors.Exit:
        """Return the exit code of a run that has ended.

        A run whose duration is over before it has held has not done what it was started for, unless
        it was to wait in standby.

        Parameters
        ----------
        finished : Exit
            What the last tick gave.
        is_standby : bool
            Whether the run was to wait in standby.
        """
        if finished is errors.Exit.DONE and not self.has_held and not is_standby:
            return errors.Exit.REJECTED
        return finished


def make_closing_lines(closing: RunEnd) -> list[str]:
    """The lines about a fault, or about a run that has never held: what was seen, what to do;
    nothing for a run that ended well.
    """
    if closing.exit is errors.Exit.REJECTED:
        state = "starting"
        if closing.state is not None:
            state = closing.state.name.lower()
        return [
            f"NEVER HELD: the duration was over in the state {state}",
            "  to do:    give a longer --duration; what it waited for is in events.jsonl",
        ]
    # Without a fault, such an end is one of the program or of a device: the pump's state is open
    if closing.exit not in (errors.Exit.SAFETY_TRIP, errors.Exit.DEVICE_FAILED):
        return []
    fault = closing.fault
    if fault is None:
        return list(_UNKNOWN_PUMP if closing.exit == errors.Exit.DEVICE_FAILED else _NO_FAULT)
    limit = f" (limit: {fault.limit})" if fault.limit else ""
    return [
        f"FAULT {fault.code} {fault.name}: {fault.cause}",
        f"  seen:     {fault.seen}{limit}, {closing.fault_s:.1f} s after the start",
        f"  to do:    {fault.remedy}",
    ]


@dataclass(frozen=True, slots=True)
class PageAtEnd:
    """The page after a hold: its link, or why there is none; neither if none was wanted."""

    link: str = ""
    problem: str = ""


def print_closing_report(
    run_dir: Path, as_json: bool, closing: RunEnd | None = None, page: PageAtEnd | None = None
) -> None:
    """Print how the run ended, a fault first, then its result, its folder and the page's link.

    Parameters
    ----------
    run_dir : path
        Folder of the run, whose summary has the figures.
    as_json : bool
        Print one JSON object to stdout instead of lines.
    closing : RunEnd or None
        None if the ticks never ran.
    page : PageAtEnd or None
        The link of the page, or why there is none; None: not mentioned.
    """
    if closing is not None:
        for line in make_closing_lines(closing):
            print(line, file=sys.stderr)
    summary_path = run_dir / "summary.json"
    if as_json:
        print(summary_path.read_text(encoding="utf-8") if summary_path.exists() else "{}")
        return
    if not run_dir.exists():
        print(f"{run_dir}: removed or moved during the run; no data left", file=sys.stderr)
        return
    if summary_path.exists():
        summary = json.loads(summary_path.read_text(encoding="utf-8"))
        for line in _list_headlines(summary):
            print(line, file=sys.stderr)
        replaced_s = summary["recorder"].get("folder_replaced_s")
        if replaced_s is not None:
            print(
                f"the run folder was removed or moved; the new one starts at {replaced_s:.1f} s",
                file=sys.stderr,
            )
    else:
        print("summary.json is missing; the recorded data are readable", file=sys.stderr)
    print(f"run folder: {run_dir}", file=sys.stderr)
    if any(run_dir.glob("ticks/*")):
        # where `review` looks for `last`
        newest = run_dir.parent == Path(RecordingConfig().logs_dir)
        print(
            f"open it:    membrane-ctrl review {'last' if newest else shlex.quote(str(run_dir))}",
            file=sys.stderr,
        )
    if page is None:
        return
    if page.problem:
        print(f"no page:    {page.problem}", file=sys.stderr)
    elif page.link:
        print(f"page:       {page.link}", file=sys.stderr)
        print(draw_link_code(page.link), end="", file=sys.stderr)


def _list_headlines(summary: dict[str, Any]) -> Iterator[str]:
    """The lines of a run's figures."""
    held = HeldError.from_table(summary.get("held") or {})
    if held.seconds:
        yield _format_headline(f"{held.name}, 1 s means", held.figures_text)
        yield _format_headline("1 s means inside the band", held.in_band_text)
    else:
        yield _format_headline("held", "not for one second")
    for key, label in _COUNTS.items():
        value = summary.get(key)
        if isinstance(value, (int, float)) and math.isfinite(value):
            yield _format_headline(label, f"{value:.0f}")
    rate_hz = summary.get("cycles_per_s")
    if isinstance(rate_hz, (int, float)) and math.isfinite(rate_hz):
        yield _format_headline("figures per second", f"{rate_hz:.3g}")


def _format_headline(label: str, text: str) -> str:
    return f"{label + ':':34}{text}"
