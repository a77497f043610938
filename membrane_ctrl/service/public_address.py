"""The address by which browsers open the page, and what follows from it.

Behind a reverse proxy the page cannot know its own address: the proxy may take off a prefix of the
path, put its own name into `Host`, and end TLS. Headers such as `X-Forwarded-Prefix` may come from
anybody. So the address is one setting (`public_url`), from which links, redirects, the cookie
and the allowed origins are made.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import urlsplit

from membrane_ctrl.config.port import LOCAL_HOSTS
from membrane_ctrl.config.service import ServiceConfig

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
_HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:(?P<port>[0-9]{1,5}))?")
_DEFAULT_PORTS = {"http": 80, "https": 443}
_IPV6_PREFIX_BITS = 64  # one customer has at least this network, and each of its addresses


@dataclass(frozen=True, slots=True)
class PublicAddress:
    """Where browsers find the page.

    `hosts` are the names by which requests may call it, `origin` the origin of a configured public
    address (empty without one), `prefix` its path without the last slash, `proxies` the networks of
    the trusted reverse proxies.
    """

    hosts: frozenset[str]
    base_url: str = "/"
    origin: str = ""
    prefix: str = ""
    secure: bool = False
    proxies: tuple[Network, ...] = ()

    @property
    def home(self) -> str:
        """Path of the page's first view, as browsers see it."""
        return f"{self.prefix}/"

    @property
    def cookie_attributes(self) -> str:
        """Attributes of every cookie: sent to this page only, by this page only, and over TLS if it
        has TLS.
        """
        secure = "; Secure" if self.secure else ""
        return f"HttpOnly; SameSite=Strict; Path={self.prefix or '/'}{secure}"

    def admits_origin(self, origin: str, host: str) -> bool:
        """Return whether a request comes from the page itself.

        Parameters
        ----------
        origin : str
            Its `Origin` header.
        host : str
            Its `Host` header.
        """
        if self.origin and normalised_origin(origin) == self.origin:
            return True
        return origin.partition("://")[2] == host

    def path_inside(self, path: str) -> str:
        """Return a path without the prefix, whether or not the proxy has removed it already."""
        if self.prefix and (path == self.prefix or path.startswith(f"{self.prefix}/")):
            return path[len(self.prefix) :]
        return path

    def source_of(self, peer: str, forwarded: Sequence[str]) -> str:
        """Return the network address of a client.

        Parameters
        ----------
        peer
            Address of the other end of the connection.
        forwarded
            Values of all `X-Forwarded-For` headers, in their order. They count only if the
            connection comes from a trusted proxy; each proxy appends the address it was called
            from, so they are read from the right.

        Returns
        -------
        str
            An IPv4 address, the /64 network of an IPv6 address, or the text of a peer that is
            neither.
        """
        source = _address(peer)
        hops = [hop.strip() for value in forwarded for hop in value.split(",")]
        while source is not None and hops and self._trusts(source):
            hop = _address(hops.pop())
            if hop is None:
                break
            source = hop
        if isinstance(source, ipaddress.IPv6Address):
            return str(ipaddress.ip_network((source, _IPV6_PREFIX_BITS), strict=False))
        return peer if source is None else str(source)

    def _trusts(self, address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
        return any(address in network for network in self.proxies)


def public_address(page: ServiceConfig) -> PublicAddress:
    """Return what follows from the page's configuration."""
    hosts = {*LOCAL_HOSTS, page.host.lower(), *(name.lower() for name in page.names)}
    proxies = tuple(ipaddress.ip_network(each) for each in page.trusted_proxies)
    # Without a proxy in front, the page is reached where it listens.
    if not page.public_url:
        scheme = "https" if page.secure else "http"
        host = f"[{page.host}]" if ":" in page.host else page.host
        base_url = f"{scheme}://{host}:{page.port}/"
        return PublicAddress(frozenset(hosts), base_url, secure=page.secure, proxies=proxies)
    # Behind a proxy the address, and perhaps a prefix of all paths, are the proxy's.
    url = urlsplit(page.public_url)
    prefix = url.path.rstrip("/")
    secure = page.secure or url.scheme == "https"
    return PublicAddress(
        hosts=frozenset({*hosts, url.hostname or ""}),
        base_url=f"{url.scheme}://{url.netloc}{prefix}/",
        origin=normalised_origin(page.public_url) or "",
        prefix=prefix,
        secure=secure,
        proxies=proxies,
    )


def host_name(header: str) -> str | None:
    """Return the lower-case name in a `Host` header, an IPv6 address without brackets; None if it
    is malformed.
    """
    match = _HOST.fullmatch(header)
    if match is None or int(match["port"] or 0) > 65535:
        return None
    return match["name"].strip("[]").lower()


def normalised_origin(url: str) -> str | None:
    """Return scheme, host and port of a URL, the port always written; None if it is malformed."""
    scheme, _, rest = url.partition("://")
    authority = rest.partition("/")[0]
    name = host_name(authority)
    if scheme not in _DEFAULT_PORTS or name is None:
        return None
    match = _HOST.fullmatch(authority)
    assert match is not None
    port = int(match["port"] or _DEFAULT_PORTS[scheme])
    return f"{scheme}://{name}:{port}"


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return an IP address, an IPv4 one that is written as IPv6 included; None for another text."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address
