"""The tick (and the twin, which stands for devices) before everything else on the machine, where it allows that."""

from __future__ import annotations

import os

# The lowest real-time priority is above every ordinary process; kernel threads that need to be first stay first
_REAL_TIME = 1


def raise_priority() -> str:
    """Give this process a real-time class; the children it starts later do not inherit it.

    A tick takes some 2 % of a core, and the kernel keeps 5 % of each second for the others whatever a real-time
    process does. Without the right to it (root, CAP_SYS_NICE, or `LimitRTPRIO=` of the service) nothing changes.

    Returns
    -------
    str
        "real-time" or "ordinary", for the record.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(_REAL_TIME))
    except (OSError, AttributeError):  # no right to it, or not Linux
        return "ordinary"
    return "real-time"
