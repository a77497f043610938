"""Sends a viewer's command to a hold, and shows what became of it."""

from __future__ import annotations

from typing import Any

from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.service.feed import HoldFeed
from membrane_ctrl.service.work_pool import PoolFullError
from membrane_ctrl.service.work_pools import pool_of_command
from membrane_ctrl.web.messages import show_message


async def send_and_show(feed: HoldFeed, asked: dict[str, Any]) -> None:
    """Send a request on the pool of its kind, and show the outcome."""
    try:
        outcome = await pool_of_command(asked["do"]).run(feed.ask, asked)
    except PoolFullError as error:
        outcome = Outcome.failed(asked["do"], f"not sent: {error}")
    show_message(outcome.text, outcome.done)
