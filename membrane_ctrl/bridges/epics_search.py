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
    """Search for a record. Raises DeviceError if a server has it."""
    server = find_server(record, _search_addresses(ca_port))
    if server:
        raise errors.DeviceError(
            f"epics: another server ({server}) has the record {record}; stop that one, or "
            "choose another bridges.name"
        )


def find_server(record: str, addresses: list[tuple[str, int]]) -> str:
    """Search for a record at these addresses for half a second; returns its server's address, or an
    empty text.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as searching:
        searching.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        searching.settimeout(_REPEAT_S)
        end_s = time.monotonic() + _SEARCH_S
        while time.monotonic() < end_s:
            for address in addresses:
                with suppress(
                    OSError
                ):  # no route, no such host: nobody there is found by clients either
                    searching.sendto(_search_message(record), address)
            with suppress(OSError):
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
    name = record.encode("ascii") + b"\0"
    name += b"\0" * (-len(name) % 8)
    version = _HEADER.pack(_VERSION, 0, 0, _MINOR_VERSION, 0, 0)
    return (
        version + _HEADER.pack(_SEARCH, len(name), _NO_REPLY_IF_ABSENT, _MINOR_VERSION, 1, 1) + name
    )


def _has_search_reply(reply: bytes) -> bool:
    """Whether a datagram holds the reply of a server that has the record."""
    place = 0
    while place + _HEADER.size <= len(reply):
        command, payload_bytes, *_ = _HEADER.unpack_from(reply, place)
        if command == _SEARCH:
            return True
        place += _HEADER.size + payload_bytes
    return False
