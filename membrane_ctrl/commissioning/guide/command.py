"""Starts a commissioning session: in the terminal, or as messages for the page."""

import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

from pydantic import ValidationError

from membrane_ctrl.commissioning.guide.bench_access import BenchAccess
from membrane_ctrl.commissioning.guide.dialogue import SessionDisplay
from membrane_ctrl.commissioning.guide.emulated_bench import EmulatedBench, MakeHold
from membrane_ctrl.commissioning.guide.folder_claim import claim_folder
from membrane_ctrl.commissioning.guide.real_bench import RealBench
from membrane_ctrl.commissioning.guide.session import CommissioningSession
from membrane_ctrl.commissioning.guide.session_messages import (
    BeginMessage,
    MessageDisplay,
    hear_interrupts,
)
from membrane_ctrl.commissioning.guide.text_display import (
    TextDisplay,
    print_line,
    read_terminal_line,
)
from membrane_ctrl.model import errors, files

_BEGIN_MOST = 1000  # characters of the line that names a session


def commission_bench(
    folder: Path, make_virtual_hold: MakeHold | None = None, as_messages: bool = False
) -> int:
    """Run or resume the session of a folder.

    Parameters
    ----------
    folder : Path
        Of the session; is made.
    make_virtual_hold : MakeHold or None
        Makes the hold of the emulated bench; None for the configured devices.
    as_messages : bool
        Exchange messages with a program instead of a terminal.

    Returns
    -------
    int
        The exit code.

    Raises
    ------
    InputError, DeviceError
        The folder cannot be used, or the session failed.
    """
    if not as_messages:
        return _run_session(folder, TextDisplay(read_terminal_line, print_line), make_virtual_hold)
    return _run_as_messages(folder, _make_message_display(), make_virtual_hold)


def commission_named(parent: Path) -> int:
    """Run the session that the first line of the input names, at the bench, as messages.

    systemd starts this program so, with a connection of the service as input and output.

    Raises InputError or DeviceError.
    """
    try:
        begin = BeginMessage.model_validate_json(sys.stdin.readline(_BEGIN_MOST))
    except ValidationError:
        raise errors.InputError("the first line of the input names no session") from None
    folder = parent / begin.session
    if folder.is_symlink():
        raise errors.InputError(f"{folder}: a link, not the folder of a session")
    return _run_as_messages(folder, _make_message_display(), None)


def _run_session(
    folder: Path, display: SessionDisplay, make_virtual_hold: MakeHold | None
) -> errors.Exit:
    with errors.convert_write_errors(folder, errors.DeviceError):
        files.make_folder(folder)
    access: BenchAccess = RealBench()
    if make_virtual_hold is not None:
        access = EmulatedBench(make_virtual_hold)
    with claim_folder(folder):
        return CommissioningSession(folder, access, display).run()


def _run_as_messages(
    folder: Path, display: MessageDisplay, make_virtual_hold: MakeHold | None
) -> errors.Exit:
    """Run a session whose last message states how it ended."""
    try:
        code = _run_session(folder, display, make_virtual_hold)
    except errors.CommandError as error:
        with suppress(OSError):
            display.show_end(error.exit, error.lines[0])
        raise
    with suppress(OSError):
        display.show_end(code)
    return code


def _make_message_display() -> MessageDisplay:
    """Messages on the standard output; whatever else prints there goes to the standard error."""
    hear_interrupts()
    target = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)

    return MessageDisplay(sys.stdin, target, interrupt)
