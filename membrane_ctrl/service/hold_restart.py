"""Restarts a hold with a configuration: stops the running one, and starts the next."""

from __future__ import annotations

import asyncio
import time
from typing import Any

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.model import errors
from membrane_ctrl.model.telemetry import State
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.hold_starter import HoldStarter, StartOptions
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import RUN_LISTS, pool_of_command

# A pump that does not obey takes 15 s, and the recording closes within 30 s
_ENDS_S = 120.0
_LOOK_S = 0.5
_EXPERIMENT = State.TUNE.name.lower()

_under_way: set[asyncio.Task[Outcome]] = set()


async def begin_restart(
    feed: HoldFeed, starter: HoldStarter, name: str, who: str, stop: dict[str, Any]
) -> asyncio.Task[Outcome]:
    """Begin to stop the hold, to wait for its end, and to start one.

    Parameters
    ----------
    feed : HoldFeed
        Of the running hold; without one, the next is started at once.
    starter : HoldStarter
        Of the folder of that hold.
    name : str
        Of the configuration to start with.
    who : str
        For the service's log.
    stop : dict
        The request that stops the hold.

    Returns
    -------
    Task of Outcome
        It continues without the viewer who asked. A failure is also in `starter.failure`, and so is
        that of the start, which continues after it.

    Raises
    ------
    InputError
        The hold must not be stopped, or could not be started again: nothing is done.
    PoolFullError
        Too many requests wait: nothing is done.
    """
    if feed.logs != starter.logs:
        raise errors.InputError("the service starts no holds in the folder of this one")
    if not feed.seen.silent and feed.seen.state_name == _EXPERIMENT:
        raise errors.InputError(
            "the hold is in an experiment; wait for its end, or stop the hold first"
        )
    await RUN_LISTS.run(starter.find_configuration, name)
    if _under_way:
        raise errors.InputError("a restart is under way already")
    task = asyncio.create_task(_restart(feed, starter, name, who, stop), name="restart of a hold")
    _under_way.add(task)
    task.add_done_callback(_under_way.discard)
    return task


async def _restart(
    feed: HoldFeed, starter: HoldStarter, name: str, who: str, stop: dict[str, Any]
) -> Outcome:
    try:
        reason = await _stop_and_start(feed, starter, name, who, stop)
    except PoolFullError as error:
        reason = str(error)
    except errors.CommandError as error:
        reason = "; ".join(error.lines)
    if not reason:
        return Outcome.succeeded("restart")
    starter.note_failure(f"restart: {reason}")
    return Outcome.failed("restart", reason)


async def _stop_and_start(
    feed: HoldFeed, starter: HoldStarter, name: str, who: str, stop: dict[str, Any]
) -> str:
    """Stop the hold if one runs, wait for its end, and begin the start; returns why it was not
    started. Raises InputError, PoolFullError.
    """
    # 1. Stop, if a hold runs; a refused stop leaves it running
    if not starter.can_start():
        stopped = await pool_of_command("stop").run(feed.ask, stop)
        if not stopped.done:
            return stopped.text
    # 2. An accepted stop is not the end: the pump must be seen off, and the recording is closed.
    #    The next hold could not claim the devices before
    give_up_s = time.monotonic() + _ENDS_S
    while not starter.can_start():
        if time.monotonic() > give_up_s:
            return f"stopped, but the hold has not ended within {_ENDS_S:.0f} s; start it by hand"
        await asyncio.sleep(_LOOK_S)
    await RUN_LISTS.run(starter.start_hold, name, who, StartOptions())
    return ""
