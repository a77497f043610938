"""Sends a viewer's command to a hold, and shows what became of it."""

from __future__ import annotations

from typing import Any

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import pool_of_command
from membrane_ctrl.web.messages import show_message


async def send_and_show(feed: HoldFeed, asked: dict[str, Any]) -> None:
    """Send a request on the pool of its kind, and show the outcome.

    Commands for safety have a pool of their own, so that STOP does not wait behind others.

    Parameters
    ----------
    feed : HoldFeed
        Of the hold that is to obey.
    asked : dict
        A request of the control port: its command is `do`.
    """
    try:
        outcome = await pool_of_command(asked["do"]).run(feed.ask, asked)
    except PoolFullError as error:
        outcome = Outcome.failed(asked["do"], f"not sent: {error}")
    show_message(outcome.text, outcome.done)
