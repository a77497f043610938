"""The port as the run sees it: receives every tick's outputs, and hands commands to the next tick.

It shares one thread and one event loop with the ticks, so everything is bounded: connections,
messages, their rate, unsent data. A failed endpoint reopens (`endpoint.Endpoint`): the hold
continues, and signals still stop it.
"""

import asyncio
import contextlib
import itertools
import math
import socket
from collections.abc import AsyncIterator, Callable
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from membrane_ctrl.config import port, schema, toml_file
from membrane_ctrl.control.experiments.spec import ExperimentSpec
from membrane_ctrl.control_port import protocol, sockets
from membrane_ctrl.control_port.commander import Commander, CommandSession
from membrane_ctrl.control_port.endpoint import Endpoint
from membrane_ctrl.control_port.line_connection import LineConnection
from membrane_ctrl.control_port.refusal_record import Refusals
from membrane_ctrl.control_port.request_intake import ReadingTurns
from membrane_ctrl.control_port.safety_commands import is_safety_command
from membrane_ctrl.control_port.sender import FREE, Peer, Sender, explain_missing_role, sender_of
from membrane_ctrl.control_port.session import PortSession
from membrane_ctrl.control_port.status import status_table
from membrane_ctrl.controller import commands, cross_check_plant, tick
from membrane_ctrl.controller.command import Command
from membrane_ctrl.instruments.lock_store import draw_word
from membrane_ctrl.model import errors, events, port_events
from membrane_ctrl.model.lock import Lock
from membrane_ctrl.model.run_status import RunStatus

# Beyond these, the longest silent connection is dropped: one user's terminals cannot lock out
# another's `stop`
_SESSIONS_MOST, _SESSIONS_EACH = 16, 4
_ANSWER_S = 5.0
_STORE_S = 0.7  # for the disk to confirm a lock: a safety command is answered within a second
_OVER = "the run is over"


@dataclass(frozen=True, slots=True)
class RunHooks:
    """What the port needs from the run."""

    queue_command: Callable[[Command], None]  # for the next tick
    record_event: Callable[[events.Event], None]
    now: Callable[[], float]  # the run's clock
    loop: Callable[[], schema.LoopConfig]  # present loop settings
    pump: Callable[[], schema.PumpConfig]  # present settings of the pump
    # of a request that set or removed a lock: why it is not on the disk, empty if it is; None: it
    # changed no lock
    lock_outcome: Callable[[int], Future[str] | None] = lambda number: None


class Port:
    """Takes commands, sends answers and status; `run` is the name of the run folder."""

    def __init__(
        self, config: port.PortConfig, listeners: sockets.Listeners, run: str, hooks: RunHooks
    ) -> None:
        self._listeners = listeners
        self._run = run
        self._hooks = hooks
        self._record_event = hooks.record_event
        self._now = hooks.now
        self._commander = Commander(config.commander_lapses_s)
        self._refusals = Refusals(hooks.record_event, hooks.now)
        self._status = RunStatus()
        self._numbers = itertools.count(1)
        self._waiting: dict[int, asyncio.Future[str]] = {}
        self._changed: dict[
            int, dict[str, str]
        ] = {}  # by number of the request: the lock that it set or removed
        self._sessions: list[PortSession] = []
        self._turns = ReadingTurns()
        self._over = False

    def handle_tick(self, outputs: tick.TickOutputs) -> None:
        """Note a tick's outputs, and answer the clients whose commands it took."""
        # 1. The status, and the events for those who watch. A lock's word is known only now: it
        #    belongs to the answer of the request that set it
        self._status = self._status.after_row(outputs.row)
        for event in outputs.events:
            self._status = self._status.after_event(event, outputs.row.mono_s)
            if (
                isinstance(event, events.LockSet | events.LockRemoved)
                and event.number in self._waiting
            ):
                self._changed[event.number] = {
                    "word": event.word,
                    "text": event.text,
                    "author": event.author,
                }
            for session in self._sessions:
                session.event(event)
        # 2. The answers: `_await_outcome` continues after this tick. One whose client has given up
        #    is no longer there
        for number, refusal in outputs.answers:
            future = self._waiting.get(number)
            if future is not None and not future.done():
                future.set_result(refusal)

    def note_report(self, event: events.Event) -> None:
        """Note a child process's report."""
        self._status = self._status.after_event(event)
        for session in self._sessions:
            session.event(event)

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncIterator[None]:
        """Accept clients for the duration of a `with` block."""
        listeners = self._listeners
        endpoint: Endpoint | None = None
        if listeners.unix is not None:
            endpoint = Endpoint(
                "unix",
                listeners.unix.socket,
                self._welcome_unix,
                self._record_event,
                self._turned_away,
            )
            endpoint.open()
            self._record_event(port_events.PortAddresses(str(listeners.path)))
        try:
            yield
        finally:
            self._over = True
            for future in self._waiting.values():
                if not future.done():
                    future.set_result(_OVER)
            while self._waiting:  # noqa: ASYNC110  an answer is sent in the same step that takes it from here
                await asyncio.sleep(0.0)
            if endpoint is not None:
                await endpoint.close()

    def status(self) -> dict[str, Any]:
        """The status for `status` and `watch`."""
        session = self._commander.session
        return {
            "run": self._run,
            **status_table(self._status),
            "gains": self._hooks.loop().model_dump(include={"kp_per_s", "ti_s", "td_s"}),
            "commander": self._commander.holder(self._now()) or None,
            "command_session": None if session is None else session.to_dict(),
            "clients": len(self._sessions),
        }

    def _turned_away(self, who: str, reason: str) -> None:
        self._refusals.record(who, "", reason)

    async def _welcome_unix(self, connection: socket.socket) -> None:
        assert self._listeners.unix is not None
        peer = self._listeners.unix.peer(connection)
        await self._serve(await LineConnection.on(connection), peer)

    async def _serve(self, connection: LineConnection, peer: Peer) -> None:
        """Serve one client until it leaves; a session of command ends with its connection."""
        self._make_room(peer)
        session = PortSession(connection, peer, self.status, self._turns)
        self._sessions.append(session)
        greeting = {
            "membrane_ctrl": protocol.VERSION,
            "run": self._run,
            "you": peer.who,
            "role": peer.role,
            "commander": self._commander.holder(self._now()) or None,
            "now_s": self._now(),
        }
        try:
            await session.run(greeting, self._answer, self._refusals.record)
        finally:
            self._sessions.remove(session)
            if (ended := self._commander.end_session(session.id)) is not None:
                self._record_event(
                    port_events.CommanderChanged(None, ended.describe(), "its connection is closed")
                )

    def _turn_out(self, session: PortSession, reason: str) -> None:
        self._refusals.record(session.peer.who, "", reason)
        session.drop(reason)

    def _make_room(self, peer: Peer) -> None:
        """Drop the connection that has been silent longest if there are too many."""
        own = [session for session in self._sessions if session.peer.who == peer.who]
        if len(own) >= _SESSIONS_EACH:
            crowd = own
        elif len(self._sessions) >= _SESSIONS_MOST:
            crowd = self._sessions
        else:
            crowd = []
        # a session that has command is silent while its experiment runs; there is one at most
        in_command = self._commander.session
        idle = [each for each in crowd if in_command is None or each.id != in_command.id]
        if idle:
            silent_longest = min(idle, key=lambda session: session.heard_s)
            self._turn_out(silent_longest, "too many connections: silent longest")

    async def _answer(self, session: PortSession, request: protocol.Request) -> dict[str, Any]:
        """Execute a request or answer why not; the controller records its own refusals."""
        # 1. Role, age, and the right to command, in this order
        peer = session.peer
        sender = sender_of(peer, request.on_behalf)
        refusal = (
            explain_missing_role(sender, request.do)
            or self._explain_expiry(request)
            or self._claim_command(session, request)
        )
        # 2. A safety command overtakes what waits on all connections
        if not refusal and is_safety_command(request.do):
            for other in self._sessions:
                other.refuse_waiting(request.do)
        if not refusal and request.do not in commands.TABLE:
            return self._run_errand(session, sender, request)
        # 3. The next tick executes the command, or refuses it
        try:
            command = self._make_command(sender, request) if not refusal else None
        except errors.InputError as error:
            refusal, command = str(error), None
        if command is None:
            self._refusals.record(sender.who, request.do, refusal, request.why)
            return {"ok": False, "refused": refusal}
        refusal = await self._await_outcome(command)
        if refusal:
            return {"ok": False, "refused": refusal}
        answer = {"ok": True, "state": status_table(self._status)["state"]}
        if request.do in ("latch", "unlock"):
            answer |= await self._lock_answer(command)
        return answer

    async def _lock_answer(self, command: Command) -> dict[str, Any]:
        """The part of the answer that confirms a lock or its removal: only what is synced to the
        disk is stored.
        """
        changed = self._changed.pop(command.number, None)
        found = {} if changed is None else {"lock": changed}
        future = self._hooks.lock_outcome(command.number)
        if future is None:
            return found
        try:
            async with asyncio.timeout(_STORE_S):
                problem = await asyncio.wrap_future(future)
        except TimeoutError:
            problem = f"the disk has not confirmed it within {_STORE_S:g} s"
        return found | {"stored": not problem, "problem": problem}

    def _explain_expiry(self, request: protocol.Request) -> str:
        """Why the request is too old to be obeyed; empty if it is not.
        Safety commands never are.
        """
        if (
            request.expires_s is None
            or is_safety_command(request.do)
            or self._now() <= request.expires_s
        ):
            return ""
        return (
            f"{request.do} came {self._now() - request.expires_s:.1f} s after its time limit; "
            "send again"
        )

    def _claim_command(self, session: PortSession, request: protocol.Request) -> str:
        """Give command to a client that needs it; returns why not, or an empty text."""
        if request.do in FREE:
            return ""
        # 1. A claim begins a session of command; any other request takes command while it is free
        who = session.peer.who
        now_s = self._now()
        former = self._commander.holder(now_s)
        former_session = self._commander.session
        take_over = request.take_over
        if request.do == "claim":
            since_utc = datetime.now(UTC).isoformat(timespec="seconds")
            begun = CommandSession(session.id, who, request.text, session.peer.pid, since_utc)
            refusal = self._commander.begin_session(begun, take_over, now_s)
        else:
            refusal = self._commander.claim(who, take_over, now_s, session.id)
        present = self._commander.session
        if refusal or (former == who and former_session is present):
            return refusal
        # 2. Command has changed: record it, and notify those who have lost it
        name = who if present is None else present.describe()
        if former_session is None:
            former_name = former
        else:
            former_name = former_session.describe()
        self._record_event(port_events.CommanderChanged(name, former_name or None, request.why))
        reason = f": {request.why}" if request.why else ""
        for other in self._sessions:
            of_session = former_session is not None and other.id == former_session.id
            of_name = former_session is None and former != who and other.peer.who == former
            if of_session or of_name:
                other.command_taken(f"{name} has taken over command{reason}")
        return ""

    def _run_errand(
        self, session: PortSession, sender: Sender, request: protocol.Request
    ) -> dict[str, Any]:
        """Execute a request that needs no tick; the answer has status and settings."""
        match request.do:
            case "watch":
                session.watch(request.period_s)
            case "release":
                self._release_command(session, request.why)
            case "quiet":
                self._record_event(port_events.AlarmsAcknowledged(sender.who, request.why))
        return {
            "ok": True,
            "status": self.status(),
            "loop": self._hooks.loop().model_dump(),
            "pump": self._hooks.pump().model_dump(),
        }

    def _release_command(self, session: PortSession, why: str) -> None:
        who, in_command = session.peer.who, self._commander.session
        if in_command is not None and in_command.id != session.id:
            return  # another session's
        self._commander.release(who, session.id)
        former = who if in_command is None else in_command.describe()
        self._record_event(port_events.CommanderChanged(None, former, why))

    def _make_command(self, sender: Sender, request: protocol.Request) -> Command:
        """The command of a request. Raises InputError for invalid
        gains or an invalid experiment.
        """
        # All of it is checked here, so that the tick gets only values that may be: a refusal costs
        # it nothing
        kind = next(kind for kind in commands.TABLE if kind == request.do)
        loop = None if request.loop is None else self._new_loop(request.loop)
        experiment = None
        if request.experiment is not None:
            experiment = toml_file.parse_tables(request.experiment, ExperimentSpec, "tune")
        pump = None
        if request.pump is not None:
            pump = toml_file.parse_tables(request.pump, schema.PumpConfig, "gains: pump")
        lock = None
        if kind == "latch":
            lock = self._new_lock(sender, request)
        account = ""
        if kind == "unlock":
            account = sender.account
        return Command(
            kind,
            sender.who,
            request.why,
            _nan_for_none(request.value),
            request.text,
            loop,
            experiment,
            next(self._numbers),
            _nan_for_none(request.shape_time_constant_s),
            pump,
            _nan_for_none(request.setpoint_step_um),
            lock=lock,
            account=account,
            from_person=sender.from_person,
        )

    def _new_lock(self, sender: Sender, request: protocol.Request) -> Lock:
        """The lock that a request sets. Word and time are drawn here, so that the tick gets them as
        inputs.
        """
        word = draw_word({lock.word for lock in self._status.locks})
        set_utc = datetime.now(UTC).isoformat(timespec="seconds")
        return Lock(word, request.text, sender.who, sender.account, sender.session, set_utc)

    def _new_loop(self, changes: dict[str, bool | float]) -> schema.LoopConfig:
        if "setpoint_um" in changes:
            raise errors.InputError("gains: setpoint_um: use the command setpoint")
        loop = toml_file.parse_tables(
            {**self._hooks.loop().model_dump(), **changes}, schema.LoopConfig, "gains"
        )
        weak = cross_check_plant.weak_gains(loop)
        if weak is not None and weak[0] == "error":
            raise errors.InputError(f"gains: kp_per_s = {loop.kp_per_s:g}: {weak[1]}")
        return loop

    async def _await_outcome(self, command: Command) -> str:
        """Why the tick refused the command; empty if it executed it."""
        if self._over:
            return _OVER
        # Waits before the command is queued, so that the very next tick finds who waits for it
        future: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._waiting[command.number] = future
        self._hooks.queue_command(command)
        try:
            async with asyncio.timeout(_ANSWER_S):
                return await future
        except TimeoutError:
            return f"no tick took it within {_ANSWER_S:g} s; it may still be executed"
        finally:
            self._waiting.pop(command.number, None)


def _nan_for_none(value: float | None) -> float:
    return math.nan if value is None else value
