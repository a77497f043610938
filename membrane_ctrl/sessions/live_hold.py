"""A session's access to a running hold: commands through its control port; ticks, events, shapes
from its rings.
"""

import contextlib
import math
import struct
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from pydantic import BaseModel, ValidationError

from membrane_ctrl.config import schema, toml_file
from membrane_ctrl.config.control import KEYS_BESIDE_GAINS
from membrane_ctrl.control_port.client import PortClient
from membrane_ctrl.control_port.ctl import Where, socket_path
from membrane_ctrl.control_port.message_syntax import Message
from membrane_ctrl.control_port.status_lines import lock_lines
from membrane_ctrl.controller.command import Command
from membrane_ctrl.model import errors, event_lines, shape_estimate, telemetry
from membrane_ctrl.model.events import Event
from membrane_ctrl.processes.published_rings import attach_rings

_S = TypeVar("_S", bound=BaseModel)
_NEWS_S = 0.2
_STARTS_S = 120.0  # from its command line to its control port
_POLL_S = 1.0
_SILENT_S = 5.0  # after this long without a tick, the run has ended or hangs


class HoldError(Exception):
    """The hold refused a command, left its state or ended."""


@dataclass(frozen=True, slots=True)
class News:
    """Ticks, events and shapes since the last call, each in order."""

    rows: tuple[telemetry.TelemetryRow, ...]
    events: tuple[Event, ...]
    shapes: tuple[shape_estimate.ShapeEstimate, ...]


class HoldLink(Protocol):
    """A session's view of a hold: commands in, ticks and events out. Twin and control port each
    provide one.
    """

    @property
    def config(self) -> schema.Config:
        """Configuration of the run."""
        ...

    @property
    def name(self) -> str:
        """Source of the data: a run folder, or the twin."""
        ...

    def send_command(self, command: Command) -> None:
        """Hand a command to the next tick. Raises HoldError with the reason if refused."""
        ...

    def read_news(self) -> News:
        """Wait briefly, then return the news. Raises HoldError if the hold has ended."""
        ...

    def close(self) -> None:
        """Hang up."""
        ...


class LiveHold:
    """A `HoldLink` to a run on this machine.

    Parameters
    ----------
    client : PortClient
        Connected to the run.
    run_dir : path
        The run's folder.
    take_over : bool
        Take command from the client that has it: at once with a `session`, else with the
        first command.
    session : str
        Claim command for a session of this name, until `close`; empty: only watch, or command like
        any client.

    Raises
    ------
    InputError
        `run_dir` is not the folder of the client's run or has no rings, or another client has
        command.
    DeviceError
        The peer is not a hold.
    """

    def __init__(
        self, client: PortClient, run_dir: str | Path, take_over: bool = False, session: str = ""
    ) -> None:
        run_dir = Path(run_dir)
        self._client = client
        self._take_over = take_over
        # 1. Is this the run of the client? Its settings are those in use, not those of its folder
        if client.greeting["run"] != run_dir.resolve().name:
            raise errors.InputError(f"{run_dir}: is not running; {client.greeting['run']} is")
        answer = client.status()
        loop = _read_settings(schema.LoopConfig, answer, "loop")
        pump = _read_settings(schema.PumpConfig, answer, "pump")
        config = toml_file.load_toml(run_dir / "config.toml", schema.Config)
        self.config = config.model_copy(update={"loop": loop, "pump": pump})
        self.name = run_dir.name
        self.run_dir = run_dir
        # 2. Command, for as long as the session takes; then the rings, at their newest messages
        if session:
            self._claim_command(session)
        try:
            self._readers = attach_rings(run_dir)
        except (OSError, ValueError) as error:
            raise errors.InputError(
                f"{run_dir}: its rings cannot be read ({error}); is it on this machine?"
            ) from None
        self._last_answer_s = time.monotonic()

    def _claim_command(self, session: str) -> None:
        answer = self._client.ask(
            do="claim", text=session, why="session", take_over=self._take_over
        )
        self._take_over = False
        if not answer["ok"]:
            raise errors.InputError(f"{session}: refused: {answer['refused']}")

    def send_command(self, command: Command) -> None:
        """Send a command through the port, which determines our name. Raises HoldError if it is
        refused, or there is no answer.
        """
        # Only what the command has: the port refuses a key that it does not need
        request: dict[str, object] = {
            "do": command.kind,
            "why": command.why,
            "take_over": self._take_over,
        }
        if math.isfinite(command.value):
            request["value"] = command.value
        for key in ("shape_time_constant_s", "setpoint_step_um"):
            if math.isfinite(getattr(command, key)):
                request[key] = getattr(command, key)
        if command.loop is not None:
            request["loop"] = command.loop.model_dump(exclude=set(KEYS_BESIDE_GAINS))
        if command.pump is not None:
            request["pump"] = command.pump.model_dump()
        if command.experiment is not None:
            request["experiment"] = command.experiment.model_dump()
        try:
            answer = self._client.ask(**request)
        except errors.DeviceError as error:
            raise HoldError(str(error)) from None
        self._take_over = False
        if not answer["ok"]:
            raise HoldError(f"refused: {answer['refused']}")

    def read_news(self) -> News:
        """The news of a fifth of a second."""
        time.sleep(_NEWS_S)
        self._require_command()
        try:
            found = self._read_rings()
        except (struct.error, ValueError) as error:
            raise HoldError(f"the rings of {self.name} are not those of a hold ({error})") from None
        now_s = time.monotonic()
        if found.rows:
            self._last_answer_s = now_s
        elif now_s - self._last_answer_s > _SILENT_S:
            raise HoldError(f"no tick for {_SILENT_S:g} s: has the hold {self.name} ended?")
        return found

    def _require_command(self) -> None:
        """Raises HoldError if another client has taken over command, or the hold has hung up."""
        try:
            self._client.poll()
        except errors.DeviceError as error:
            raise HoldError(str(error)) from None
        if self._client.command_taken:
            raise HoldError(self._client.command_taken)

    def _read_rings(self) -> News:
        messages = {name: reader.drain() for name, reader in self._readers.items()}
        return News(
            rows=tuple(
                telemetry.TelemetryRow.unpack(message) for message in messages.get("telemetry", ())
            ),
            events=tuple(
                event_lines.from_dict(event_lines.parse_event(message))
                for message in messages.get("events", ())
            ),
            shapes=tuple(
                shape_estimate.unpack_estimate(message) for message in messages.get("shapes", ())
            ),
        )

    def close(self) -> None:
        """Release command and disconnect; the hold continues."""
        with contextlib.suppress(errors.DeviceError):  # the hold may have ended first
            self._client.ask(do="release", why="tuning session over")
        self._client.close()
        for reader in self._readers.values():
            reader.close()


def _read_settings(kind: type[_S], answer: Message, key: str) -> _S:
    """Settings in an answer. Raises DeviceError if they are not there, or not settings."""
    try:
        return kind.model_validate(answer.get(key))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        raise errors.DeviceError(f"not an answer of a hold ({key}: {first['msg']})") from None


@contextlib.contextmanager
def live_hold(
    where: Where, take_over: bool, needs_operate: str = "", wait: bool = False, session: str = ""
) -> Iterator[LiveHold]:
    """Yield a link to the selected hold.

    Parameters
    ----------
    where : Where
        The hold.
    take_over : bool
        Take command from the client that has it.
    needs_operate : str
        Name of the command that needs the role `operate`; empty if it only reads.
    wait : bool
        Wait for a run that starts, until its mirror is held.
    session : str
        Name under which command is claimed; empty: it is not.

    Raises
    ------
    InputError
        If the role does not suffice.
    DeviceError
        If there is no hold, or it ends before its mirror is held.
    """
    socket = socket_path(where)
    until_s = time.monotonic() + (_STARTS_S if wait else 0.0)
    # A run that starts: first its socket appears, then its mirror is held
    while wait and not socket.exists() and time.monotonic() < until_s:
        time.sleep(_POLL_S)
    client = PortClient.unix(socket, lambda text: print(f"notice: {text}", file=sys.stderr))
    try:
        while wait and client.status()["status"]["state"] != "hold":
            _require_unlocked(client)
            time.sleep(_POLL_S)
        _require_unlocked(client)
        if needs_operate and client.greeting["role"] == "read":
            raise errors.InputError(
                f"{needs_operate} needs the role operate; {client.greeting['you']} has read"
            )
        link = LiveHold(
            client, where.run or socket.parent / str(client.greeting["run"]), take_over, session
        )
    except BaseException:
        client.close()
        raise
    with contextlib.closing(link):
        yield link


def _require_unlocked(client: PortClient) -> None:
    """Raise DeviceError if the mirror is locked: the hold would refuse every experiment."""
    lines = lock_lines(client.status()["status"])
    if lines:
        raise errors.DeviceError(
            f"locked: {'; '.join(lines)}; ask its author, then `membrane-ctrl ctl unlock WORD`"
        )
