"""Links, cookies, origins and the client's address follow from the settings, not from headers of
strangers.
"""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from membrane_ctrl.config.service import ServiceConfig
from membrane_ctrl.service.public_address import (
    PublicAddress,
    host_name,
    normalised_origin,
    public_address,
)

PROXIED = public_address(
    ServiceConfig(public_url="https://Lab.example/mirror/".lower(), users_file="users")
)


def test_without_a_public_address_the_page_is_where_it_listens() -> None:
    address = public_address(ServiceConfig(port=7480))
    assert (address.base_url, address.home, address.prefix) == ("http://127.0.0.1:7480/", "/", "")
    assert address.cookie_attributes == "HttpOnly; SameSite=Strict; Path=/"
    assert public_address(ServiceConfig(host="::1")).base_url == "http://[::1]:7480/"
    assert address.admits_origin("http://127.0.0.1:7480", "127.0.0.1:7480")
    assert not address.admits_origin("http://127.0.0.1:7481", "127.0.0.1:7480")
    assert not address.admits_origin("null", "127.0.0.1:7480")


def test_all_follows_from_the_public_address() -> None:
    assert (PROXIED.base_url, PROXIED.home) == ("https://lab.example/mirror/", "/mirror/")
    assert PROXIED.cookie_attributes == "HttpOnly; SameSite=Strict; Path=/mirror; Secure"
    assert "lab.example" in PROXIED.hosts
    assert "127.0.0.1" in PROXIED.hosts, "the proxy may call it by the address it listens on"


@pytest.mark.parametrize(
    ("origin", "admitted"),
    [
        ("https://lab.example", True),
        ("https://lab.example:443", True),
        ("https://LAB.example", True),
        ("http://127.0.0.1:7480", True),
        ("http://lab.example", False),
        ("https://lab.example:8443", False),
        ("https://lab.example.evil", False),
        ("https://evil.example", False),
        ("https://lab.example@evil.example", False),
        ("null", False),
        ("", False),
        ("https://[::1", False),
    ],
)
def test_only_the_public_origin_and_the_own_one_are_admitted(origin: str, admitted: bool) -> None:
    assert PROXIED.admits_origin(origin, "127.0.0.1:7480") is admitted


@pytest.mark.parametrize(
    ("path", "inside"),
    [
        ("/mirror/", "/"),
        ("/mirror", ""),
        ("/mirror/chart", "/chart"),
        ("/chart", "/chart"),
        ("/", "/"),
        ("/mirrors/x", "/mirrors/x"),
        ("/mirror/mirror/x", "/mirror/x"),
    ],
)
def test_the_prefix_is_removed_once(path: str, inside: str) -> None:
    assert PROXIED.path_inside(path) == inside
    assert PublicAddress(frozenset()).path_inside(path) == path


@pytest.mark.parametrize(
    "url",
    [
        "lab.example/mirror",
        "ftp://lab.example",
        "https://user@lab.example/",
        "https://lab.example/?x=1",
        "https://lab.example/a/../b",
        "https://lab.example//a",
        "https://lab.example/a b",
        "https://lab.example/%2e",
        "https://lab.example:port/",
        "https://lab.example/#a",
        "https:///mirror",
        "javascript:alert(1)",
        "https://lab.example/\r\nX: y",
    ],
)
def test_a_public_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(ValidationError, match="public_url"):
        ServiceConfig(public_url=url, users_file="users")


def test_a_public_address_on_other_machines_needs_tls_and_names() -> None:
    for url, users_file in (("http://lab.example/", "users"), ("https://lab.example/", None)):
        with pytest.raises(ValidationError, match="other machines need TLS and a login"):
            ServiceConfig(public_url=url, users_file=users_file)
    ServiceConfig(public_url="http://localhost:8080/mirror")


def test_a_proxy_that_is_no_address_is_refused() -> None:
    for text in ("proxy", "10.0.0.1/99", ""):
        with pytest.raises(ValidationError, match="trusted_proxies"):
            ServiceConfig(trusted_proxies=(text,))


@pytest.mark.parametrize(
    ("peer", "forwarded", "source"),
    [
        ("198.51.100.7", [], "198.51.100.7"),
        ("198.51.100.7", ["10.9.9.9"], "198.51.100.7"),  # a stranger's header
        ("127.0.0.1", [], "127.0.0.1"),
        ("127.0.0.1", ["198.51.100.7"], "198.51.100.7"),
        (
            "127.0.0.1",
            ["10.9.9.9, 198.51.100.7"],
            "198.51.100.7",
        ),  # the client sent the first, the proxy the second
        ("127.0.0.1", ["10.9.9.9", "198.51.100.7"], "198.51.100.7"),
        ("127.0.0.1", ["198.51.100.7, 192.0.2.5"], "198.51.100.7"),  # two trusted proxies
        ("127.0.0.1", ["10.9.9.9, 198.51.100.7, 192.0.2.5"], "198.51.100.7"),
        ("127.0.0.1", ["127.0.0.1, 192.0.2.5"], "127.0.0.1"),
        ("127.0.0.1", ["nonsense"], "127.0.0.1"),
        ("127.0.0.1", ["198.51.100.7, nonsense"], "127.0.0.1"),
        ("127.0.0.1", ["198.51.100.7:1234"], "127.0.0.1"),
        ("::ffff:127.0.0.1", ["198.51.100.7"], "198.51.100.7"),
        ("2001:db8:1:2:3:4:5:6", [], "2001:db8:1:2::/64"),
        ("2001:db8:1:2:ffff::1", ["x"], "2001:db8:1:2::/64"),
        ("", [], ""),
    ],
)
def test_the_source_is_the_client_if_a_trusted_proxy_names_it(
    peer: str, forwarded: list[str], source: str
) -> None:
    address = public_address(ServiceConfig(trusted_proxies=("127.0.0.1", "192.0.2.0/24")))
    assert address.source_of(peer, forwarded) == source


def test_without_a_trusted_proxy_no_header_counts() -> None:
    assert public_address(ServiceConfig()).source_of("127.0.0.1", ["198.51.100.7"]) == "127.0.0.1"


@pytest.mark.parametrize(
    ("header", "name"),
    [
        ("Lab.Example:7480", "lab.example"),
        ("127.0.0.1", "127.0.0.1"),
        ("[::1]:7480", "::1"),
        ("[::1", None),
        ("a b", None),
        ("", None),
        ("a:b", None),
        ("a:70000", None),
        ("a@b", None),
        ("a/b", None),
        ("\u0663", None),
        ("a:\u0663", None),
    ],
)
def test_the_name_in_a_host_header(header: str, name: str | None) -> None:
    assert host_name(header) == name


def test_an_origin_has_a_port() -> None:
    assert normalised_origin("https://lab.example/mirror") == "https://lab.example:443"
    assert normalised_origin("http://[::1]:80") == "http://::1:80"
    assert normalised_origin("file://x") is None
