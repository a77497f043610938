"""`check` with links that wait 20 s for an answer, for tests whose emulators stand still whenever the machine does.

The configuration is judged as it is written; only then its devices are given more time. Run as a program, it is the
command line.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

from membrane_ctrl import check
from membrane_ctrl.cli import run
from membrane_ctrl.device_config import DevicesConfig
from membrane_ctrl.probe import Probe

ANSWER_S = 20.0


@contextmanager
def patient_check() -> Iterator[None]:
    """`check` waits that long."""
    probes = check._probes

    async def patient(devices: DevicesConfig) -> list[Probe]:
        waits = {role: table.model_copy(update={"timeout_s": ANSWER_S}) for role, table in devices.roles().items()}
        return await probes(devices.model_copy(update={"timeout_s": ANSWER_S, **waits}))

    with patch("membrane_ctrl.check._probes", patient):
        yield


if __name__ == "__main__":
    with patient_check():
        sys.exit(run(sys.argv[1:]))
