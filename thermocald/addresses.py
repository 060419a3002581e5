"""Host names and addresses: what reaches this machine alone, and how a page may be called.

A name that merely begins like an address (127.0.0.1.evil.example) is a name like any other: with it
a foreign site makes a browser ask this machine (DNS rebinding).
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from collections.abc import Iterable

__all__ = ["HostNames", "is_loopback"]

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


def is_loopback(host: str) -> bool:
    """Whether a name or address that a server binds to is reached from this machine only."""
    address = _address(_plain(host))
    return _plain(host) == "localhost" if address is None else _is_loopback(address)


class HostNames:
    """The names by which a page may be asked for: this machine's own, where it listens, and more.

    host: the name or address the server is bound to; more: further names, as configured.
    """

    def __init__(self, host: str, more: Iterable[str] = ()) -> None:
        names = {_plain(name) for name in ("localhost", host, *more)}
        self._addresses = {a for name in names if (a := _address(name)) is not None}
        self._names = {name for name in names if _address(name) is None}

    def allow_host(self, header: str) -> bool:
        """Whether a `Host` header, `name`, `name:port` or `[address]:port`, names us."""
        text, port = header, ""
        if header.startswith("["):
            text, closed, rest = header[1:].partition("]")
            if not closed or (rest and not rest.startswith(":")) or ":" not in text:
                return False
            port = rest[1:]
        elif ":" in header:
            text, _, port = header.rpartition(":")
            if ":" in text:
                return False
        if port and not (port.isascii() and port.isdigit() and int(port) < 65536):
            return False
        return self._allow(_plain(text))

    def allow_origin(self, header: str) -> bool:
        """Whether the value of an `Origin` header names a page of ours."""
        try:
            parts = urlsplit(header)
        except ValueError:
            return False
        return parts.scheme in ("http", "https") and self.allow_host(parts.netloc)

    def _allow(self, name: str) -> bool:
        address = _address(name)
        if address is None:
            return name in self._names
        return _is_loopback(address) or address in self._addresses


def _plain(name: str) -> str:
    """As names are compared: lower case, without the point at the end, without brackets."""
    return name.lower().removesuffix(".").removeprefix("[").removesuffix("]")


def _address(text: str) -> Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _is_loopback(address: Address) -> bool:
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback
