"""The page's host names: what a foreign site can make a browser send is refused."""

from __future__ import annotations

import pytest

from thermocald.addresses import HostNames, is_loopback


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "127.0.0.1:8437", "127.1.2.3:80", "localhost", "LOCALHOST:8437", "localhost.",
     "localhost.:8437", "[::1]", "[::1]:8437", "[::ffff:127.0.0.1]:1", "127.0.0.1.",
     "192.168.1.5:8437", "Pi.Local:8437", "pi.local.", "[fe80::1]:80", "127.0.0.1:"],
)  # fmt: skip
def test_ours(host):
    assert HostNames("192.168.1.5", ["pi.local", "fe80::1"]).allow_host(host)


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1.evil.com", "127.evil.com", "127.0.0.1.evil.com:8437", "localhost.evil.com", "",
     "evil.com", "evil.com:127", "127.0.0.1@evil.com", "[::1].evil.com", "[::1", "::1", ":8437",
     "[127.0.0.1]", "127.0.0.1:99999", "127.0.0.1:80:80", "127.0.0.1:8O", "2130706433", "127.1",
     "0x7f.0.0.1", "0.0.0.0", "192.168.1.50", "pi.local.evil.com", "127.0.0.1..",
     "localhost,evil.com",
     "127.0.0.1 evil.com", "127.0.0.1\t", "１２７.0.0.1", "[::ffff:8.8.8.8]", "[::1]8437"],
)  # fmt: skip
def test_foreign(host):
    assert not HostNames("192.168.1.5", ["pi.local"]).allow_host(host)


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [("http://127.0.0.1:8437", True), ("https://localhost", True), ("http://[::1]:1", True),
     ("null", False), ("http://127.0.0.1.evil.com", False), ("file://", False), ("", False),
     ("http://evil.com", False), ("http://[", False), ("ftp://localhost", False)],
)  # fmt: skip
def test_origins(origin, allowed):
    assert HostNames("127.0.0.1").allow_origin(origin) is allowed


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("127.0.0.1", True), ("127.9.9.9", True), ("localhost", True), ("::1", True),
     ("127.0.0.1.evil.com", False), ("127.evil.com", False), ("0.0.0.0", False), ("::", False)],
)  # fmt: skip
def test_what_reaches_this_machine_alone(host, loopback):
    assert is_loopback(host) is loopback
