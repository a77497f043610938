"""Job control of a command: whether it may use the terminal, and how it ends by a signal."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # commands without a table need not load it
    pass


def in_foreground(handle: int) -> bool:
    """Whether this process may use an open terminal now; job control covers only the controlling
    one.
    """
    try:
        return os.tcgetpgrp(handle) == os.getpgrp()
    except OSError:
        return True


@contextlib.contextmanager
def ends_as_by_ctrl_c() -> Iterator[None]:
    """SIGTERM and SIGHUP raise KeyboardInterrupt inside, so that the command cleans up.

    An ignored SIGHUP stays ignored: `nohup` means to continue without the terminal.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    for number, handler in before.items():
        if handler != signal.SIG_IGN:
            signal.signal(number, _raise_interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _raise_interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt
