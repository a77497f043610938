"""Is a record served already? A search by Channel Access, in the bytes of its protocol.

Two servers of one record make its clients choose either at random. A lock of this machine keeps two
bridges from that; this search finds servers on other machines, and other programs.

Source: EPICS Channel Access Protocol Specification, messages CA_PROTO_VERSION and CA_PROTO_SEARCH.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from contextlib import suppress

from membrane_ctrl.model import errors

_SEARCH_S = 0.5
_REPEAT_S = 0.1  # a datagram may be lost
_HEADER = struct.Struct(">HHHHII")  # command, payload bytes, data type, count, two parameters
_VERSION, _SEARCH = 0, 6
_MINOR_VERSION = 13
_NO_REPLY_IF_ABSENT = 5
_DATAGRAM_BYTES = 65536
_DEFAULT_PORT = 5064


def require_unserved(record: str, ca_port: int) -> None:
    """Search for a record where its clients would.

    Parameters
    ----------
    record : str
        Full name, such as `bench2:state`; ASCII.
    ca_port : int
        UDP port of Channel Access that this bridge will use; the standard's 5064 is searched, too.

    Raises
    ------
    DeviceError
        A server has the record.
    """
    server = find_server(record, _search_addresses(ca_port))
    if server:
        raise errors.DeviceError(
            f"epics: another server ({server}) has the record {record}; stop that one, or "
            "choose another bridges.name"
        )


def find_server(record: str, addresses: list[tuple[str, int]]) -> str:
    """Search for a record for half a second; datagrams may be lost, so every address is asked every
    0.1 s.

    Parameters
    ----------
    record : str
        Full name; ASCII.
    addresses : list of (str, int)
        Host or broadcast address, and UDP port. One that cannot be reached is left out.

    Returns
    -------
    str
        Address of the first server that replies; empty if none does.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as searching:
        searching.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        searching.settimeout(_REPEAT_S)
        end_s = time.monotonic() + _SEARCH_S
        while time.monotonic() < end_s:
            for address in addresses:
                # no route, no such host: clients find no server there either
                with suppress(OSError):
                    searching.sendto(_search_message(record), address)
            with suppress(OSError):  # no reply within `_REPEAT_S`
                reply, (host, _) = searching.recvfrom(_DATAGRAM_BYTES)
                if _has_search_reply(reply):
                    return str(host)
    return ""


def _search_addresses(ca_port: int) -> list[tuple[str, int]]:
    """Where clients would search: this machine, its network,
    and the hosts in EPICS' own variable.
    """
    hosts = ["127.0.0.1", "255.255.255.255", *os.environ.get("EPICS_CA_ADDR_LIST", "").split()]
    found = []
    for each in hosts:
        host, _, port = each.partition(":")
        if port.isdigit():
            ports = [int(port)]
        else:
            ports = sorted({ca_port, _DEFAULT_PORT})
        found += [(host, each_port) for each_port in ports]
    return found


def _search_message(record: str) -> bytes:
    """A datagram with two messages: the version of the protocol, and the search for one record."""
    # The payload is the name with its terminator, padded to a multiple of eight bytes.
    name = record.encode("ascii") + b"\0"
    name += b"\0" * (-len(name) % 8)
    version = _HEADER.pack(_VERSION, 0, 0, _MINOR_VERSION, 0, 0)
    return (
        version + _HEADER.pack(_SEARCH, len(name), _NO_REPLY_IF_ABSENT, _MINOR_VERSION, 1, 1) + name
    )


def _has_search_reply(reply: bytes) -> bool:
    """Whether a datagram holds the reply of a server that has the record."""
    # A datagram may hold several messages one after the other; only a server that has the record
    # replies to a search.
    place = 0
    while place + _HEADER.size <= len(reply):
        command, payload_bytes, *_ = _HEADER.unpack_from(reply, place)
        if command == _SEARCH:
            return True
        place += _HEADER.size + payload_bytes
    return False
