"""Host names and addresses: which are this machine's own, and which secrets they hold.

A name that merely begins like an address (127.0.0.1.evil.example) counts as a name: a foreign site
uses such a name to make a browser ask this machine (DNS rebinding).
"""

from __future__ import annotations

import base64
import ipaddress
import json
import logging
import re
from typing import TYPE_CHECKING
from urllib.parse import quote, quote_plus, unquote, urlsplit

if TYPE_CHECKING:
    from collections.abc import Iterable

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


_ADDRESS = re.compile(
    r"(?P<scheme>\b[a-zA-Z][a-zA-Z0-9+.-]*(?::|%3[Aa])(?:/|%2[Ff]){1,2})(?P<rest>[^\s'\"<>]{0,2000})"
)
_PLAIN_USER = re.compile(
    r"(?<![^\s'\"(=<])(?://)?(?!mailto:)[^\s:@/'\"(=<]+(?::|%3[Aa])[^\s:@/'\"]+(?:@|%40)(?=[\w\[])"
)
_KEYS = (
    r"(?:passw(?:or)?[dt]|passphrase|pwd|token|secret|credentials?"
    r"|(?:api|access|private|shared|account)[_-]?key)"
)
_KEY = re.compile(_KEYS, re.IGNORECASE)
_SHORT_KEYS = (  # only with `=`: without it they are words of other things too
    r"(?:(?<![^\W_])(?:pass|passcode|psk|otp|jwt|bearer)|session[_-]?id|signature"
    r"|(?:secret|client)[_-]key)"
)
_BEFORE = re.compile(  # a key of a query, of an option or a mapping, or a word before its value
    rf"(?i)([?&#](?:[\w-]*(?:{_KEYS}|signature)|sig|key|auth)=)"
    rf"|(?:{_KEYS}s?\\*['\"]?(?:(\s*[=-]?=>?\s*|\s*->\s*)|\s*:\s*|%3[AaDd](?:%20)?|>"
    r"|\s+(?:is\s+|was\s+)?(?=\\*['\"][^'\"]{3}|[a-z]\S*\d|\d\S*[a-z]))"
    rf"|{_SHORT_KEYS}\\*['\"]?=)|--?[\w-]*{_KEYS}\s+"
)
_GROUP = re.compile(r"(?s)[\[({]\s*[bru]?\\*['\"][^\])}]*")
_QUOTED = re.compile(r"(?is)[bru]?(\\*(['\"])(?:\2\2)?)(?:(?!\1)(?:\\.|[^\\]))*(?:\1|\Z|\\\Z)")
_OF_QUERY = re.compile(r"[^\s&'\"]*")
# without quotes a value ends with its line, at the next option, and where a sentence goes on
_PHRASE = re.compile(
    r"(?:(?!\s+[\w-]+\s*=|[,;:.)}\]]*(?:\s*[\r\n]|\s*\Z|\s[({])|[,;:]\s)(?s:\\.|[^&'\"]))*"
)
_WORD = re.compile(  # this program's own messages about a key go on in small letters
    r"(?=\S*[^a-z\d\s.,;:()…-]|\d\S*[a-z]|[a-z]\S*\d)\S+?(?=[,;:.)]*(?:\s|\Z))"
    r"|(?!(?:unknown|missing|is|must|holds|needs)\b)[^\s,;:()…]+(?=[,;:.)]*(?:\Z|[\r\n,;:]))"
)
_HEADER = re.compile(
    r"(?i)(authorization\\*['\"]?\s*[:=]\s*(?:[bru](?=\\*['\"]))?\\*['\"]?)"
    r"(?:(?:digest|aws4-\S+|oauth)\s[^\r\n]*|(?:[a-z]+\s+)?[^\s'\"\\]+)"
    r"|(\bbearer\s+|\bbasic\s+(?=\S*[\d=+/]))[\w.~+/=-]{6,}"
    r"|(\bcookie\\*['\"]?\s*[:=]\s*\\*['\"]?)[^\r\n'\"\\]+"
)
_HOOK = re.compile(  # a webhook's address is its secret
    r"(?i)((?:hooks\.slack\.com/services|api\.telegram\.org/bot|discord(?:app)?\.com/api/webhooks"
    r"|webhook\.office\.com/\w+|maker\.ifttt\.com/\S+/key)/?)[^\s'\"<>?]+"
)
_PEM = re.compile(r"(?s)(-----BEGIN [\w ]*PRIVATE KEY-----).*?(?=-----END|\Z)")
_HOST = re.compile(r"(\[[^]]*:[^]]*\]|[^][:]*)(?::([0-9]*))?")
_SHORTEST = 4  # a shorter secret is part of too many words
_known: set[str] = set()


def hide(value: str | None) -> None:
    """Hide a secret in all later messages, as it is and as libraries write it."""
    if value is None or len(value) < _SHORTEST:
        return
    written = {value, value.strip(), " ".join(value.split())}
    for _ in range(2):  # twice: one message may quote another
        written |= {w for text in written for w in _quotations(text)}
    written |= {w for text in list(written) for w in (text.lower(), text.upper()) if "%" in text}
    _known.update(text for text in written if len(text) >= _SHORTEST)


def _quotations(text: str) -> set[str]:
    plain = text.encode(errors="replace")
    return {
        repr(text)[1:-1], ascii(text)[1:-1], repr(plain)[2:-1], json.dumps(text)[1:-1],
        json.dumps(text, ensure_ascii=False)[1:-1], text.replace("\\", "\\\\").replace("'", "\\'"),
        quote(plain), quote_plus(plain), quote(plain, safe=""),
        base64.b64encode(plain).decode().strip("="),
    }  # fmt: skip


def hide_secrets(document: object, key: str = "") -> None:
    """Hide a configuration's values of keys such as `password`, and the passwords in addresses."""
    if isinstance(document, dict):
        for name, value in document.items():
            hide_secrets(value, str(name))
    elif isinstance(document, list | tuple):
        for value in document:
            hide_secrets(value, key)
    elif is_secret(key) and not isinstance(document, bool) and document is not None:
        hide(str(document))
    elif isinstance(document, str) and "@" in document and ":" in document:
        user, _, _ = document.partition("://")[2].rpartition("@")
        for word in {user.partition(":")[2], unquote(user.partition(":")[2])}:
            hide(word)


def is_secret(key: str) -> bool:
    """Return whether the value of a key is a secret; the name of a file that holds one is not."""
    return _KEY.search(key) is not None and not re.search(r"(?i)file|path|name$", key)


def without_secrets(text: str) -> str:
    """Return a text without hidden secrets, users in addresses, passwords and keys."""
    for value in sorted(_known, key=len, reverse=True):
        text = text.replace(value, "…")
    text = _PLAIN_USER.sub("", _without_users(text))
    text = _HOOK.sub(r"\1…", _HEADER.sub(r"\1\2\3…", _PEM.sub(r"\1…", text)))
    return _without_values(text)


def _without_users(text: str) -> str:
    """Remove users and passwords from addresses, also from one in another's query.

    A password may hold a `/`.
    """
    parts, at = [], 0
    while found := _ADDRESS.search(text, at):
        rest = found["rest"]
        cut = re.search(r"/|%2[Ff]", rest)
        end = len(rest) if cut is None else cut.start()
        host = re.split(r"@|%40", rest[:end])[-1]
        port = host.rpartition(":")[2] if ":" in host else "0"
        behind = re.split(r"@|%40", rest[end:])
        if len(host) == end and not port.isdigit() and len(behind) > 1:
            host, end = behind[-1], len(rest)
        parts += [text[at : found.start()], found["scheme"], host]
        at = found.start("rest") + end
    return "".join([*parts, text[at:]])


def _without_values(text: str) -> str:
    """Replace the values of keys such as `password` by …."""
    parts, at = [], 0
    for key in _BEFORE.finditer(text):
        if key.start() < at:
            continue
        end = key.end()
        kinds = (_QUOTED, _GROUP, _OF_QUERY if key[1] else _PHRASE if key[2] else _WORD)
        value = next((found for kind in kinds if (found := kind.match(text, end))), None)
        if value is not None and value[0].strip("…"):
            parts += [text[at:end], "…"]
            at = value.end()
    return "".join([*parts, text[at:]])


class CleanFormatter(logging.Formatter):
    """A formatter that hides secrets, in tracebacks too: libraries quote what they were given."""

    def format(self, record: logging.LogRecord) -> str:
        return without_secrets(super().format(record))


def is_loopback(host: str) -> bool:
    """Return whether a server that binds to a name or address is reached from this machine only."""
    address = _address(_plain(host))
    if address is None:
        return _plain(host) == "localhost"
    return (getattr(address, "ipv4_mapped", None) or address).is_loopback


class HostNames:
    """The host names under which a page may be requested: this machine's own and configured ones.

    host: the name or address that the server binds to; more: further names.
    """

    def __init__(self, host: str, more: Iterable[str] = ()) -> None:
        names = map(_plain, ("localhost", host, *more))
        self._known = {_address(name) or name for name in names}

    def allow_host(self, header: str) -> bool:
        """Return whether a `Host` header names this page: `name`, `name:port`, `[address]:port`."""
        found = _HOST.fullmatch(header)
        if found is None or int(found[2] or 0) > 65535:
            return False
        name = _plain(found[1])
        return is_loopback(found[1]) or (_address(name) or name) in self._known

    def allow_origin(self, header: str) -> bool:
        """Return whether an `Origin` header names this page."""
        try:
            parts = urlsplit(header)
        except ValueError:
            return False
        return parts.scheme in ("http", "https") and self.allow_host(parts.netloc)


def _plain(name: str) -> str:
    """Return a name in lower case, without a final full stop or brackets, for comparison."""
    return name.lower().removesuffix(".").removeprefix("[").removesuffix("]")


def _address(text: str) -> Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None
