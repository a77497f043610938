"""Sends the console's requests to the control port without waiting for the answer."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.outcome import Outcome
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.model import errors

Request = dict[str, Any]
Send = Callable[[Request], "Future[str]"]


def request_sender(socket: Path, run: str) -> Send:
    """Return a function that sends requests to a run without waiting for the answer.

    They are sent one after the other, but safety commands do not wait for the others.

    Parameters
    ----------
    socket : Path
        The run's control port.
    run : str
        Name of the run: a later hold at the same socket gets nothing.

    Returns
    -------
    callable
        Takes a request; returns a future of the line for the operator.
    """
    worker, safety_worker = ThreadPoolExecutor(1), ThreadPoolExecutor(1)

    def send(request: Request) -> Future[str]:
        chosen = safety_worker if is_safety_command(request["do"]) else worker
        return chosen.submit(send_request, socket, run, request)

    return send


def send_request(socket: Path, run: str, request: Request) -> str:
    """Send a request to a run and wait for its answer; on a worker of `request_sender`.

    Parameters
    ----------
    socket : Path
        The run's control port.
    run : str
        Name of the run: another one at the same socket gets nothing.
    request : dict
        `do`, and what the command needs.

    Returns
    -------
    str
        What became of it, in one line; also if no hold answers.
    """
    what = request["do"]
    try:
        with PortClient.unix(socket, notice=lambda _: None) as client:
            if client.greeting.get("run") != run:
                return Outcome.failed(what, f"{socket}: another run listens there").text
            answer = client.ask(**request, why="key")
    except errors.DeviceError as error:
        return Outcome.failed(what, str(error)).text
    return Outcome.from_answer(what, answer).text
