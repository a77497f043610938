"""Modbus devices by URL, so that those on one serial bus share it."""

from urllib.parse import urlsplit

from firmware_iface.links import modbus_rtu, modbus_rules, modbus_tcp

DEFAULT_PORT = 502


class ModbusLinks:
    """Makes links; one per bench, because a serial bus has one owner."""

    def __init__(self) -> None:
        self._buses: dict[str, modbus_rtu.RtuBus] = {}

    def link(self, url: str, unit_id: int, timeout_s: float, fence: bool = True) -> modbus_rules.ModbusLink:
        """The device `unit_id` at `tcp://HOST[:PORT]` or `rtu://PORT[?baud=..&parity=..]`, not yet connected.

        `fence`: see `links.exchange`; of no meaning for TCP. Raises ValueError for a URL that is neither.
        """
        if not url.startswith("rtu:"):
            host, port = parse_tcp_url(url)
            return modbus_tcp.GuardedModbusTcp(host, port, unit_id, timeout_s)
        if url not in self._buses:
            self._buses[url] = modbus_rtu.RtuBus.from_url(url)
        return self._buses[url].device(unit_id, timeout_s, fence)


def parse_tcp_url(url: str) -> tuple[str, int]:
    """Host and port of `tcp://HOST[:PORT]`. Raises ValueError."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:  # a port that is no number, or above 65535
        raise ValueError(f"{url}: {error}") from error
    if parts.scheme != "tcp" or not host or parts.path or parts.query or parts.fragment or parts.username:
        raise ValueError(f"{url}: wanted tcp://HOST:PORT")
    return host, DEFAULT_PORT if port is None else port
