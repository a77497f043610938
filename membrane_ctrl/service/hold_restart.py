"""Restarts a hold with a configuration: stops the running one, and starts the next."""

from __future__ import annotations

import asyncio
from typing import Any

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.model import errors
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_starter import HoldStarter, StartOptions
from membrane_ctrl.service.work_pools import PoolFullError, pool_of_command

# A pump that does not obey takes 15 s, and the recording closes within 30 s
_ENDS_S = 120.0
_LOOK_S = 0.5


async def restart_hold(
    feed: HoldFeed, starter: HoldStarter, name: str, who: str, stop: dict[str, Any]
) -> Outcome:
    """Stop the hold, wait for its end, and start one.

    Parameters
    ----------
    feed : HoldFeed
        Of the running hold; without one, the next is started at once.
    starter : HoldStarter
    name : str
        Of the configuration to start with.
    who : str
        For the service's log.
    stop : dict
        The request that stops the hold.

    Returns
    -------
    Outcome
        What became of it; the start itself goes on, and its failure is in `starter.failure`.
    """
    if starter.can_start():
        return _start(starter, name, who)
    try:
        stopped = await pool_of_command("stop").run(feed.ask, stop)
    except PoolFullError as error:
        return Outcome.failed("restart", f"not stopped: {error}")
    if not stopped.done:
        return Outcome.failed("restart", stopped.text)
    for _ in range(round(_ENDS_S / _LOOK_S)):
        if starter.can_start():
            return _start(starter, name, who)
        await asyncio.sleep(_LOOK_S)
    return Outcome.failed(
        "restart", f"stopped, but the hold has not ended within {_ENDS_S:.0f} s; start it by hand"
    )


def _start(starter: HoldStarter, name: str, who: str) -> Outcome:
    try:
        starter.start_hold(name, who, StartOptions())
    except errors.CommandError as error:
        return Outcome.failed("restart", "; ".join(error.lines))
    return Outcome.succeeded("restart")
