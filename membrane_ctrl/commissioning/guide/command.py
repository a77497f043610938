"""Starts a commissioning session: in the terminal, or as messages for the page."""

import os
import signal
import sys
from pathlib import Path

from membrane_ctrl.commissioning.guide.bench_access import BenchAccess
from membrane_ctrl.commissioning.guide.dialogue import SessionDisplay
from membrane_ctrl.commissioning.guide.emulated_bench import EmulatedBench, MakeHold
from membrane_ctrl.commissioning.guide.folder_claim import claim_folder
from membrane_ctrl.commissioning.guide.real_bench import RealBench
from membrane_ctrl.commissioning.guide.session import CommissioningSession
from membrane_ctrl.commissioning.guide.session_messages import MessageDisplay, hear_interrupts
from membrane_ctrl.commissioning.guide.text_display import (
    TextDisplay,
    print_line,
    read_terminal_line,
)
from membrane_ctrl.model import errors, files


def commission_bench(
    folder: Path, make_virtual_hold: MakeHold | None = None, as_messages: bool = False
) -> int:
    """Run or resume the session of a folder, on the emulated bench if its hold is given.

    Raises InputError or DeviceError.
    """
    with errors.convert_write_errors(folder, errors.DeviceError):
        files.make_folder(folder)
    access: BenchAccess = RealBench()
    if make_virtual_hold is not None:
        access = EmulatedBench(make_virtual_hold)
    display: SessionDisplay = TextDisplay(read_terminal_line, print_line)
    if as_messages:
        display = _make_message_display()
    with claim_folder(folder):
        return CommissioningSession(folder, access, display).run()


def _make_message_display() -> MessageDisplay:
    """Messages on the standard output; whatever else prints there goes to the standard error."""
    hear_interrupts()
    target = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    return MessageDisplay(sys.stdin, target, interrupt)
