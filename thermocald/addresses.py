"""Host names and addresses: what reaches this machine alone, how a page may be called, secrets.

A name that merely begins like an address (127.0.0.1.evil.example) is a name like any other: with it
a foreign site makes a browser ask this machine (DNS rebinding).
"""

from __future__ import annotations

import ipaddress
import logging
import re
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

if TYPE_CHECKING:
    from collections.abc import Iterable

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


_ADDRESS = re.compile(r"(?P<scheme>\b[a-zA-Z][a-zA-Z0-9+.-]*:/{1,2})(?P<rest>[^\s'\"<>]*)")
_KEY = r"(?:passw(?:or)?d|passphrase|pwd|token|secret|api[_-]?key)"
_VALUE = r"(?:'[^']*'|\"[^\"]*\"|[^\s&'\"]*)"
# `key=value` of a query or of libpq, 'key': 'value' of a mapping that a library printed, a header
_PAIR = re.compile(rf"(?i)({_KEY}\s*=\s*){_VALUE}|({_KEY}['\"]\s*:\s*){_VALUE}")
_HEADER = re.compile(
    r"(?i)(authorization['\"]?\s*[:=]\s*['\"]?(?:basic|bearer|digest)?)\s*[^\s'\"]+"
)
_PLAIN_USER = re.compile(
    r"(?<![^\s'\"(=<])(?://)?(?!mailto:)[^\s:@/'\"(=<]+:[^\s:@/'\"]+@(?=[\w\[])"
)


def without_secrets(text: str) -> str:
    """A text without the user information and the passwords of the addresses in it."""
    text = _PLAIN_USER.sub("", _ADDRESS.sub(_without_user, text))
    return _PAIR.sub(r"\1\2…", _HEADER.sub(r"\1 …", text))


def _without_user(found: re.Match[str]) -> str:
    """One address; a password that holds a `/` ends what a parser takes for the host."""
    place, slash, path = found["rest"].partition("/")
    if "@" in place:
        return found["scheme"] + place.rpartition("@")[2] + slash + path
    port = place.rpartition(":")[2] if ":" in place else "0"
    if "@" in path and not port.isdigit():
        return found["scheme"] + path.rpartition("@")[2]
    return found[0]


class CleanFormatter(logging.Formatter):
    """Leaves out the passwords of addresses, in tracebacks too: libraries quote what they got."""

    def format(self, record: logging.LogRecord) -> str:
        return without_secrets(super().format(record))


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
