"""The sender of a request: who is behind a connection, and what the sender's role allows."""

from __future__ import annotations

from dataclasses import dataclass, field

from membrane_ctrl.control_port.protocol import OnBehalf, RequestName
from membrane_ctrl.control_port.safety_commands import SAFETY
from membrane_ctrl.controller.command import Role
from membrane_ctrl.controller.commands import TABLE

_RANK: dict[str, int] = {"read": 0, "operate": 1, "tune": 2}
# The least role of a request that is no command
_ERRANDS: dict[str, Role] = {
    "status": "read",
    "watch": "read",
    "claim": "operate",
    "release": "operate",
    "quiet": "operate",
}
# These need no command: what makes the mirror safe is always accepted, and the others move nothing
FREE = frozenset({"status", "watch", "unlock", "mark", "release", "quiet"}) | SAFETY


@dataclass(frozen=True, slots=True)
class Peer:
    """The peer of a connection: `unix:NAME`, as given by the system."""

    who: str
    role: Role
    pid: int | None = field(default=None, compare=False)  # of its process, if it is on this machine
    is_own_user: bool = False  # a process of the hold's own user on the socket file

    @property
    def session(self) -> str:
        """What identifies the sender of a lock for people: its process;
        empty if that is unknown.
        """
        if self.pid is None:
            return ""
        return f"process {self.pid}"


@dataclass(frozen=True, slots=True)
class Sender:
    """Who sends a request: the peer itself, or somebody for whom it sends it."""

    who: str  # for people and for the record
    role: Role
    account: str = ""  # login, by which an author is known; empty: none, or not proven
    session: str = ""
    from_person: bool = True  # False: a bridge's


def sender_of(peer: Peer, on_behalf: OnBehalf | None) -> Sender:
    """Return who sends a request, with the lower of the two roles.

    Parameters
    ----------
    peer : Peer
        Of the connection, as the system identifies it.
    on_behalf : OnBehalf or None
        What the request itself states.

    Returns
    -------
    Sender
    """
    if on_behalf is None:
        return Sender(peer.who, peer.role, account=peer.who, session=peer.session)
    role = min(peer.role, on_behalf.role, key=_RANK.__getitem__)
    from_person = on_behalf.via != "bridge"
    # Any program could state this. Only the hold's own user is trusted with a name: its service has
    # verified the login. From others it lowers the role, and proves nothing
    if not peer.is_own_user:
        return Sender(peer.who, role, session=peer.session, from_person=from_person)
    who = f"{on_behalf.via}:{on_behalf.account or on_behalf.name}"
    account = who if from_person and on_behalf.account else ""
    if on_behalf.viewer:
        who = f"{who} for {on_behalf.viewer}"
    return Sender(who, role, account, on_behalf.session, from_person)


def role_includes(role: str, needed: Role) -> bool:
    """Whether a role includes the needed one.

    Parameters
    ----------
    role : str
        May come from another program: an unknown role counts as `read`.
    needed : Role
        `tune` includes `operate`, which includes `read`.
    """
    return _RANK.get(role, 0) >= _RANK[needed]


def explain_missing_role(sender: Peer | Sender, do: RequestName) -> str:
    """Why the sender's role forbids a request; empty if it does not.

    Parameters
    ----------
    sender : Peer or Sender
        Who is behind the connection, with the lower role of the two if it sends for another.
    do : RequestName
        A command of `controller.commands.TABLE`, or a request of the port itself.
    """
    needed = TABLE[do].role if do in TABLE else _ERRANDS[do]
    if role_includes(sender.role, needed):
        return ""
    return f"{do} needs the role {needed}; {sender.who} has {sender.role}"
