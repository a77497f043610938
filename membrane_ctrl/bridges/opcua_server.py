"""An OPC UA server whose method calls do not wait for each other, and whose clients may have to log
in.

asyncua answers the messages of a connection one after the other, and the calls within one message
as well. A `latch` would wait for the commands that the same client sent before. Here each call is a
task of its own; reads, writes and everything else stay in order.

Passwords are verified on a thread before asyncua asks for the user, because the hash takes 50 ms,
in which this process could not obey a `stop`.
"""

from __future__ import annotations

import asyncio
import contextvars
import hashlib
import hmac
import secrets
import time
from contextlib import suppress
from typing import Any

from asyncua import Server, ua
from asyncua.common.utils import Buffer
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.address_space import MethodService
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import nodeid_from_binary, struct_from_binary

from membrane_ctrl.bridges.connection_turns import Turns
from membrane_ctrl.service.accounts import KnownUser, known_user

_CALL = ua.NodeId(ua.ObjectIds.CallRequest_Encoding_DefaultBinary)
_ACTIVATE = ua.NodeId(ua.ObjectIds.ActivateSessionRequest_Encoding_DefaultBinary)
_CONNECTIONS_MOST = 200
_MESSAGES_MOST = 5000  # of a connection that arrive at once; asyncua closes it beyond
_MESSAGE_BYTES_MAX = 1 << 20
_PASSWORD_LENGTH = 256
_VERIFYING_MOST = 8  # log-ins that wait for the hash of another

# name of the client whose method call this task answers
caller: contextvars.ContextVar[str] = contextvars.ContextVar("caller", default="")


class AnonymousClients:
    """Every client is a plain user: asyncua's own manager makes an administrator of any client that
    states `admin`.
    """

    def get_user(self, *_: Any, **__: Any) -> User:
        """Return the user of a session."""
        return User(UserRole.User)

    async def verify(self, name: str, password: str, address: str) -> None:
        """Do nothing: a password means nothing here.

        Parameters
        ----------
        name, password, address : str
            As for `NamedClients.verify`; ignored.
        """


class NamedClients:
    """Clients log in with the name and password of a users file.

    Parameters
    ----------
    users : dict of str to KnownUser
        By name.
    """

    def __init__(self, users: dict[str, KnownUser]) -> None:
        self._users = users
        # its password is verified for a name that does not exist, so that both take the same time
        self._nobody = known_user("nobody", "read", secrets.token_hex(8))
        self._secret = secrets.token_bytes(32)
        # a digest of name and password of each user who has logged in, keyed with `_secret`
        self._verified: dict[str, bytes] = {}
        self._turns = Turns(time.monotonic)
        self._one_at_a_time = asyncio.Lock()
        self._verifying = 0

    async def verify(self, name: str, password: str, address: str) -> None:
        """Verify a password for the `get_user` that follows.

        A password that was right before takes no time, so guesses of others cannot keep its owner
        out.

        Parameters
        ----------
        name, password : str
            As the client sent them.
        address : str
            IP address of the client, which limits its attempts per second (`Turns`).
        """
        # Known at once, or refused without the hash: longer than any password is.
        if self._is_verified(name, password) or len(password) > _PASSWORD_LENGTH:
            return
        # A flood of guesses may neither queue without limit nor occupy the threads.
        if self._verifying >= _VERIFYING_MOST or not self._turns.take(address):
            return
        self._verifying += 1
        try:
            async with self._one_at_a_time:
                if await asyncio.to_thread(self._is_password_correct, name, password):
                    self._verified[name] = self._digest(name, password)
        finally:
            self._verifying -= 1

    def get_user(
        self,
        iserver: object,
        username: str | None = None,
        password: str | None = None,
        certificate: object = None,
    ) -> User | None:
        """Return the user of a session (called by asyncua, after `verify`).

        Parameters
        ----------
        iserver : object
            Not used; asyncua passes its server.
        username, password : str or None
            None for a client that sent none.
        certificate : object
            Not used: certificates encrypt here, and identify no user.

        Returns
        -------
        User or None
            None if the password was not verified, which asyncua answers with a refusal.
        """
        if username is None or password is None or not self._is_verified(username, password):
            return None
        return User(UserRole.User, username)

    def _is_verified(self, name: str, password: str) -> bool:
        digest = self._verified.get(name)
        return digest is not None and hmac.compare_digest(digest, self._digest(name, password))

    def _digest(self, name: str, password: str) -> bytes:
        message = f"{name}\0{password}".encode("utf-8", "surrogatepass")
        return hmac.new(self._secret, message, hashlib.sha256).digest()

    def _is_password_correct(self, name: str, password: str) -> bool:
        """Whether the password is that of the user; as slow for a name that does not exist."""
        known = self._users.get(name)
        return (known or self._nobody).has_password(password) and known is not None


class BridgeServer(Server):  # type: ignore[misc]  # asyncua has no types for others
    """asyncua's server with the rules of this module; `clients` decides who may have a session."""

    def __init__(self, clients: AnonymousClients | NamedClients) -> None:
        super().__init__(user_manager=clients)
        self.iserver.method_service = _ConcurrentMethods(self.iserver.aspace)
        self.iserver.max_connections = _CONNECTIONS_MOST
        self.iserver.max_pending_messages_per_connection = _MESSAGES_MOST
        self.limits.max_message_size = _MESSAGE_BYTES_MAX

    async def start(self) -> None:
        """Start to listen. Raises OSError if the address is in use."""
        await self._setup_server_nodes()
        await self.iserver.start()
        host, port = self._get_bind_socket_info()
        self.bserver = _BridgeListener(self.iserver, host, port, self.limits)
        self.bserver.set_policies(self._policies)
        try:
            await self.bserver.start()
        except OSError:
            await self.iserver.stop()
            raise


class _ConcurrentMethods(MethodService):  # type: ignore[misc]  # asyncua has no types for others
    """The calls of one message run at the same time."""

    async def call(self, methods: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        return list(await asyncio.gather(*(self._call(method) for method in methods)))


class _BridgeListener(BinaryServer):  # type: ignore[misc]  # asyncua has no types for others
    def _make_protocol(self) -> OPCUAProtocol:
        return _BridgeProtocol(
            self.iserver, self._policies, self.clients, self.closing_tasks, self.limits
        )


class _BridgeProtocol(OPCUAProtocol):  # type: ignore[misc]  # asyncua has no types for others
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if self.transport is not None:  # else the connection was refused
            self.processor = _BridgeProcessor(self.iserver, transport, self.limits)
            self.processor.set_policies(self.policies)


class _BridgeProcessor(UaProcessor):  # type: ignore[misc]  # asyncua has no types for others
    """Answers the messages of one connection."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._calls: set[asyncio.Task[None]] = set()

    async def process_message(self, seqhdr: Any, body: Buffer) -> Any:
        # A call becomes a task and counts as processed at once, so that the next message of this
        # connection is read meanwhile.
        kind = nodeid_from_binary(body.copy())
        if kind == _CALL:
            task = asyncio.create_task(self._process_call(seqhdr, body), name="opcua call")
            self._calls.add(task)
            task.add_done_callback(self._calls.discard)
            return True
        if kind == _ACTIVATE:
            await self._verify_password(body.copy())
        return await super().process_message(seqhdr, body)

    async def _process_call(self, seqhdr: Any, body: Buffer) -> None:
        if self.session is not None:
            caller.set(self.session.user.name or "")
        if not await super().process_message(seqhdr, body):
            self._transport.close()

    async def _verify_password(self, body: Buffer) -> None:
        """Verify the password of an ActivateSession message; asyncua refuses a malformed one."""
        with suppress(Exception):
            nodeid_from_binary(body)
            struct_from_binary(ua.RequestHeader, body)
            token = struct_from_binary(ua.ActivateSessionParameters, body).UserIdentityToken
            if isinstance(token, ua.UserNameIdentityToken) and self.session is not None:
                name, password = self.iserver.decrypt_user_token(self.session, token)
                await self.iserver.user_manager.verify(name, password, str(self.name[0]))
