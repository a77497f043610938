"""The client of a service's interface for programs: `ctl --host`, and services that follow others.

The other end may be another program, a damaged service or a hostile one: an answer has a bounded
size and time, and every part that is used is checked. It needs no library beyond Python's own.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import socket
import ssl
import threading
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import Path
from typing import Annotated, Any, TypeVar
from urllib.parse import quote, urlsplit

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from membrane_ctrl.config.port import LOCAL_HOSTS
from membrane_ctrl.control_port import answers, message_syntax
from membrane_ctrl.control_port.api_models import (
    CommandAnswer,
    SignalAnswer,
    StateAnswer,
    UserAnswer,
)
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.controller.commands import SAME_AS
from membrane_ctrl.model import errors, files, plain_json, terminal

TOKEN_VARIABLE = "MEMBRANE_CTRL_TOKEN"
ANSWER_S = 10.0
_ANSWER_BYTES_MAX = 1_000_000
_SAFETY_FIELDS = ("text", "why", "viewer")
_COMMAND_FIELDS = (
    "value",
    "text",
    "loop",
    "pump",
    "shape_time_constant_s",
    "why",
    "take_over",
    "expires_in_s",
    "viewer",
)
_REFUSALS = frozenset(
    {
        HTTPStatus.FORBIDDEN,
        HTTPStatus.CONFLICT,
        HTTPStatus.UNPROCESSABLE_ENTITY,
        HTTPStatus.NOT_FOUND,
    }
)
_SIGNALS = TypeAdapter(Annotated[list[SignalAnswer], Field(max_length=1000)])
_EVENTS = TypeAdapter(
    Annotated[list[Annotated[str, Field(max_length=20_000)]], Field(max_length=500)]
)
Model = TypeVar("Model", bound=BaseModel)
Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class ServiceAddress:
    """A hold behind a service.

    Attributes
    ----------
    url : str
        Of the service, such as `https://bench2.lab:7480/`.
    token : str
        Of `membrane-ctrl serve token add`.
    authority : Path or None
        CA of the service's certificate; None: those of the system.
    hold : str
        Name of the hold there; empty for the service's own.
    """

    url: str
    token: str
    authority: Path | None = None
    hold: str = ""


def read_token(file: Path | None) -> str:
    """Return the token in a file, or in the environment variable `MEMBRANE_CTRL_TOKEN` without one.
    Raises InputError.
    """
    if file is None:
        token = os.environ.get(TOKEN_VARIABLE, "")
        source = TOKEN_VARIABLE
    else:
        source = str(file)
        try:
            token = files.read_text(file, follow=True)
        except OSError as error:
            raise errors.InputError(f"{file}: {errors.os_reason(error)}") from None
        except ValueError as error:
            raise errors.InputError(f"{file}: {error}") from None
    token = token.strip()
    if not token or not token.isascii() or not token.isprintable():
        raise errors.InputError(
            f"{source}: no token; make one there with `membrane-ctrl serve token add NAME ROLE`"
        )
    return token


class ServiceClient:
    """Asks one service; each request has a connection of its own.

    Parameters
    ----------
    address : ServiceAddress
        URL, token, the authority of its certificate, and the name of the hold there.
    answer_s : float
        For a whole request, from the connection to the last byte.

    Raises
    ------
    InputError
        The address is none of a service, or would send the token in plain text to another machine.
    """

    def __init__(self, address: ServiceAddress, answer_s: float = ANSWER_S) -> None:
        self._address = address
        self._answer_s = answer_s
        parts = urlsplit(address.url)
        try:
            self._host = parts.hostname or ""
            self._port = parts.port
        except ValueError:
            self._host = ""
        if parts.scheme not in ("http", "https") or not self._host:
            raise errors.InputError(f"{address.url}: write it like https://bench2.lab:7480/")
        if parts.scheme == "http" and self._host not in LOCAL_HOSTS:
            raise errors.InputError(f"{address.url}: the token would cross the network; use https")
        self._is_secure = parts.scheme == "https"
        self._prefix = parts.path.rstrip("/")
        self._where = f"{parts.scheme}://{parts.netloc}{self._prefix}"

    def read_state(self) -> StateAnswer:
        """Return the state of the hold. Raises DeviceError without a sound answer, InputError if
        it is refused.
        """
        status, body = self._request("GET", "/api/state")
        if status != HTTPStatus.OK:
            raise self._make_refusal(status, body)
        message = self._decode(body)
        state = self._validate(message, StateAnswer)
        if state.status:
            try:
                answers.check_message({"status": state.status})
            except message_syntax.AnswerError as error:
                raise self._not_of_a_service(str(error)) from None
        return state

    def read_signals(self) -> dict[str, float | str | None]:
        """Return the values of the published signals by name. Raises as `read_state`."""
        signals = self._read_list("signals", _SIGNALS)
        return {each.name: each.value for each in signals}

    def read_events(self) -> tuple[str, ...]:
        """Return the last events as sentences, oldest first. Raises as `read_state`."""
        return tuple(self._read_list("events", _EVENTS))

    def _read_list(self, what: str, model: TypeAdapter[list[Item]]) -> list[Item]:
        status, body = self._request("GET", f"/api/{what}")
        if status != HTTPStatus.OK:
            raise self._make_refusal(status, body)
        try:
            return model.validate_python(plain_json.loads(body.decode()))
        except ValueError as error:  # a ValidationError is one
            raise self._not_of_a_service(f"{what}: {str(error).splitlines()[0]}") from None

    def read_user(self) -> UserAnswer:
        """Return whose token it is there, with its role. Raises as `read_state`."""
        status, body = self._request("GET", "/api/me")
        if status != HTTPStatus.OK:
            raise self._make_refusal(status, body)
        return self._validate(self._decode(body), UserAnswer)

    def send_command(self, request: dict[str, Any]) -> dict[str, Any]:
        """Send a request of the control socket.

        Returns
        -------
        dict
            The hold's answer.

        Raises
        ------
        DeviceError
            The service or its hold does not answer.
        InputError
            The service or its hold refuses.
        """
        # Safety commands have an address of their own, whose threads serve nothing else
        do = SAME_AS.get(request["do"], request["do"])
        names: tuple[str, ...] = _COMMAND_FIELDS
        path, body = "/api/commands", {"do": do}
        if is_safety_command(do):
            names, path, body = _SAFETY_FIELDS, f"/api/safety/{do}", {}
        body |= {
            name: request[name] for name in names if request.get(name) not in (None, "", False)
        }
        # Both are answers of the hold: it obeyed, or it refused. All else is the service's
        status, answered = self._request("POST", path, body)
        if status in (HTTPStatus.OK, HTTPStatus.CONFLICT):
            answer = self._validate(self._decode(answered), CommandAnswer).answer
            if isinstance(answer.get("ok"), bool):
                return answer
        raise self._make_refusal(status, answered)

    def _request(self, method: str, path: str, body: object = None) -> tuple[int, bytes]:
        """Return status and body of an answer. Raises DeviceError."""
        connection = self._connect()
        # a service that sends a byte a second must not take longer than one that is silent
        is_over = threading.Event()
        timer = threading.Timer(self._answer_s, _hang_up, [connection, is_over])
        timer.daemon = True
        timer.start()
        try:
            connection.request(
                method,
                f"{self._prefix}{path}?hold={quote(self._address.hold)}",
                body=None if body is None else json.dumps(body),
                headers={
                    "Authorization": f"Bearer {self._address.token}",
                    "Content-Type": "application/json",
                },
            )
            answer = connection.getresponse()
            content = answer.read(_ANSWER_BYTES_MAX + 1)
        except ssl.SSLCertVerificationError as error:
            reason = f"the service's certificate is not trusted: {error.verify_message}"
            raise errors.DeviceError(f"{self._where}: {reason}") from None
        except ConnectionRefusedError:
            raise errors.DeviceError(f"{self._where}: no service is listening") from None
        except (TimeoutError, http.client.HTTPException, OSError, ValueError) as error:
            reason = "no HTTP answer"
            if isinstance(error, OSError):
                reason = errors.os_reason(error)
            if is_over.is_set():
                reason = f"no answer within {self._answer_s:g} s"
            raise errors.DeviceError(f"{self._where}: {reason or 'no answer'}") from None
        finally:
            timer.cancel()
            connection.close()
        if len(content) > _ANSWER_BYTES_MAX:
            raise self._not_of_a_service("too long")
        return answer.status, content

    def _connect(self) -> http.client.HTTPConnection:
        if not self._is_secure:
            return http.client.HTTPConnection(self._host, self._port, timeout=self._answer_s)
        try:
            context = ssl.create_default_context(cafile=self._address.authority)
        except OSError as error:
            raise errors.InputError(
                f"{self._address.authority}: not an authority's certificate ({error})"
            ) from None
        return http.client.HTTPSConnection(
            self._host, self._port, timeout=self._answer_s, context=context
        )

    def _decode(self, body: bytes) -> dict[str, Any]:
        try:
            return message_syntax.decode(body)
        except message_syntax.AnswerError as error:
            raise self._not_of_a_service(str(error)) from None

    def _validate(self, message: dict[str, Any], model: type[Model]) -> Model:
        try:
            return model.model_validate(message)
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False, include_context=False)[0]
            field = ".".join(str(part) for part in first["loc"])[:100]
            raise self._not_of_a_service(f"{field}: {first['msg']}") from None

    def _make_refusal(self, status: int, body: bytes) -> errors.CommandError:
        """Return the error for an answer that is no success."""
        reason = ""
        with contextlib.suppress(ValueError):
            message = plain_json.loads(body.decode())
            if isinstance(message, dict):
                reason = str(message.get("detail") or message.get("text") or "")
        shown = terminal.one_line(reason[:300])
        if status == HTTPStatus.UNAUTHORIZED:
            return errors.InputError(f"{self._where}: the token is unknown there, or revoked")
        if status in _REFUSALS:
            return errors.InputError(f"refused: {shown or f'status {status}'}")
        return errors.DeviceError(f"{self._where}: {shown or f'status {status}'}")

    def _not_of_a_service(self, reason: str) -> errors.DeviceError:
        shown = terminal.one_line(reason[:300])
        return errors.DeviceError(f"{self._where}: not an answer of a service ({shown})")


def _hang_up(connection: http.client.HTTPConnection, is_over: threading.Event) -> None:
    """End a connection at its deadline: a thread that waits for it returns, and finds why."""
    is_over.set()
    if connection.sock is not None:
        with contextlib.suppress(OSError):
            connection.sock.shutdown(socket.SHUT_RDWR)
