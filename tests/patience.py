"""Patience with devices that stop whenever the machine does: for tests whose emulators or bench are
processes.

`slow_machine` is as patient as a configuration may be: a hold survives a pause of 1.9 s. `check`
gets more: the configuration is judged as it is written, and only then its devices are given 20 s
for an answer. Run as a program, this is the command line with that `check`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from membrane_ctrl.cli import run
from membrane_ctrl.commissioning import check
from membrane_ctrl.commissioning.check import DeviceProbe
from membrane_ctrl.config.schema import DevicesConfig

ANSWER_S = 20.0


def slow_machine(board: str = "tcp://127.0.0.1:1") -> str:
    """The tables of such a configuration; with `--twin`,
    the twin's address replaces the board's.
    """
    return (
        f'[devices]\nboard = "{board}"\ntimeout_s = 1.9\nwatchdog_s = 2.0\n'
        "[limits]\nstale_s = 2.0\nlateness_max_ms = 1900.0\n"
    )


@contextmanager
def patient_check(answer_s: float = ANSWER_S) -> Iterator[None]:
    """`check` waits that long; drivers of other packages check their time-outs, which are at most 5
    s.
    """
    probes = check._make_probes

    async def patient(devices: DevicesConfig, laser: bool) -> list[DeviceProbe]:
        waits = {
            role: table.model_copy(update={"timeout_s": answer_s})
            for role, table in devices.roles().items()
        }
        return await probes(devices.model_copy(update={"timeout_s": answer_s, **waits}), laser)

    with patch("membrane_ctrl.commissioning.check._make_probes", patient):
        yield


if __name__ == "__main__":
    with patient_check():
        sys.exit(run(sys.argv[1:]))
