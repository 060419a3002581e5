"""Where a server's store is: a libpq address, and which station, camera and series of it is meant.

    postgresql://reader@db.example/thermocald?camera=gauge-7&series=M1&sslmode=verify-full

`station`, `camera` and `series` are ours; everything else goes to libpq as it stands.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self
from urllib.parse import parse_qsl, quote, urlencode, urlsplit, urlunsplit

from thermocald.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["ServerAddress", "is_server"]

_SCHEME = re.compile(r"^postgres(ql)?:/+")
_OURS = ("station", "camera", "series")


def is_server(source: Path | str) -> bool:
    """Whether a source on the command line is a server's address and not a file or folder."""
    return bool(_SCHEME.match(str(source)))


@dataclass(frozen=True, slots=True)
class ServerAddress:
    """An address as parsed: `url` for SQLAlchemy, and a selection, None for all."""

    url: str
    station: str | None = None
    camera: str | None = None
    series: str | None = None

    @classmethod
    def parse(cls, source: Path | str) -> Self:
        """From text or from a path, in which `//` has become `/`. UsageError where it is wrong."""
        if not is_server(source):
            raise UsageError(f"{source}: is not the address of a server (postgresql://…)")
        text = _SCHEME.sub("postgresql://", str(source))
        try:
            parts = urlsplit(text)
            _ = parts.port
            query = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
        except ValueError as error:
            raise UsageError(f"{source}: is not a valid address: {error}") from error
        selection = {name: value for name, value in query if name in _OURS}
        rest = urlencode([(n, v) for n, v in query if n not in _OURS], quote_via=quote)
        url = urlunsplit(("postgresql+psycopg", parts.netloc, parts.path, rest, ""))
        return cls(url, **selection)

    @staticmethod
    def narrowed(source: Path, station: str, camera: str, series: str) -> Path:
        """The same address, selecting one series, as a path in the place of the given one."""
        from pathlib import Path

        parts = urlsplit(_SCHEME.sub("postgresql://", str(source)))
        rest = [(n, v) for n, v in parse_qsl(parts.query) if n not in _OURS]
        chosen = [("station", station), ("camera", camera), ("series", series)]
        query = urlencode([*rest, *chosen], quote_via=quote, safe="")
        return Path(urlunsplit((parts.scheme, parts.netloc, parts.path, query, "")))

    def __str__(self) -> str:
        """The address for messages: without a password."""
        parts = urlsplit(self.url)
        place = parts.netloc.rsplit("@", 1)
        user = place[0].split(":", 1)[0] + "@" if len(place) == 2 else ""
        return f"postgresql://{user}{place[-1]}{parts.path}"
