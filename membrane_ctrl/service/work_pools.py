"""Bounded pools of threads: one kind of work never waits behind another kind.

The page does its slow work on threads: password hashes, charts, reports, commands to a hold. In one
common pool, a few slow tasks of one kind would delay all others. So each kind has its own pool,
with a bound on the tasks that wait; a task beyond that bound is refused at once. Commands that end
in the safe state have a pool for themselves.
"""

from __future__ import annotations

from membrane_ctrl.service.work_pool import WorkPool

_SAFETY = frozenset({"stop", "vent", "lower", "latch"})


# A password hash takes 16 MB and 50 ms of a core. Devices that have logged in before do not queue
# behind strangers.
STRANGERS_PASSWORDS = WorkPool("strangers' passwords", workers=1, waiting_max=8, niceness=5)
KNOWN_PASSWORDS = WorkPool("known devices' passwords", workers=1, waiting_max=8, niceness=5)
# Charts of the last hour come from memory, longer ones from the files of many runs.
LIVE_CHARTS = WorkPool("live charts", workers=2, waiting_max=100)
LONG_CHARTS = WorkPool("long charts", workers=1, waiting_max=100, niceness=5)
FIGURES = WorkPool("figures", workers=1, waiting_max=100)
SESSIONS = WorkPool("tuning sessions", workers=1, waiting_max=100)
ANSWERS = WorkPool("answers to tuning sessions", workers=2, waiting_max=16)
RUN_LISTS = WorkPool("lists of runs", workers=1, waiting_max=20, niceness=5)
REPORTS = WorkPool("reports", workers=1, waiting_max=8, niceness=5)
REPORT_FILES = WorkPool("report files", workers=1, waiting_max=20, niceness=5)
GAINS = WorkPool("curves of gains", workers=2, waiting_max=20, niceness=5)
CONFIGURATIONS = WorkPool("configurations", workers=1, waiting_max=8, niceness=5)
COMMANDS = WorkPool("commands", workers=4, waiting_max=32)
SAFETY_COMMANDS = WorkPool("safety commands", workers=8, waiting_max=32)


def pool_of_command(do: str) -> WorkPool:
    """Return the pool for a command to a hold; commands that end in
    the safe state have their own.
    """
    return SAFETY_COMMANDS if do in _SAFETY else COMMANDS
