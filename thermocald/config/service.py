"""Where the daemon keeps, shows, sends and logs what it has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator

from thermocald.addresses import is_loopback
from thermocald.config.section import Name, Positive, Section, relative_to_file, wrong


class StoreConfig(Section):
    """Where results go. durable: what is stored survives a power cut, at the price of a sync."""

    path: Path = Field(default=Path("thermocald.db"), validate_default=True)
    """The SQLite file."""
    durable: bool = True
    """What is stored survives a power cut; false: only the end of the process, but faster."""

    _path = field_validator("path")(relative_to_file)


class FramesConfig(Section):
    """Which frames are kept, where, and for how long; None: no limit."""

    keep: Literal["all", "every_n", "events", "none"] = "every_n"
    """Which frames are kept; events: knock, slip, failed epochs."""
    every_n: Annotated[int, Field(ge=1, le=1_000_000)] = 360
    """With every_n: one of so many."""
    folder: Path = Field(default=Path("frames"), validate_default=True)
    """Where they are kept."""
    max_age_days: Positive | None = 90.0
    """Older frames are deleted, which is logged; null: no limit."""
    max_size_gb: Positive | None = 8.0
    """Beyond it the oldest frames go first; null: no limit."""
    min_free_gb: Annotated[float, Field(ge=0.0, le=1e6)] = 0.5
    """With less room on the disk no frame is kept."""

    _folder = field_validator("folder")(relative_to_file)


class DashboardConfig(Section):
    """The web page; elsewhere than on this machine it needs a token."""

    enabled: bool = False
    """Whether the daemon shows the page."""
    host: str = "127.0.0.1"
    """Elsewhere than on this machine a token_file is needed."""
    port: Annotated[int, Field(ge=1, le=65535)] = 8437
    """Of the page."""
    token_file: Path | None = None
    """A file that holds the token; others must not be able to read it."""
    names: tuple[Annotated[str, Field(min_length=1, max_length=253)], ...] = ()
    """Further names by which the page may be asked for, such as that of a proxy."""

    _token_file = field_validator("token_file")(relative_to_file)

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        if not is_loopback(self.host) and self.token_file is None:
            raise wrong(f"host {self.host} is open to others; name a token_file too")
        return self


class ForwardConfig(Section):
    """Where the store's rows are sent, by a process of its own: `thermocald forward`."""

    to: Annotated[str, Field(pattern=r"^postgres(ql)?://")] | None = None
    """The server, postgresql://USER@HOST/DATABASE; null: nothing is sent."""
    station: Name | None = None
    """This station's name there; null: the host's."""
    frames: Literal["none", "events", "every_n", "all"] = "none"
    """Which of the kept frames are sent too; events: epochs without a result, and movements."""
    every_n: Annotated[int, Field(ge=1, le=1_000_000)] = 360
    """With frames: every_n, those whose number it divides."""
    frames_mb_per_day: Positive = 200.0
    """Frames beyond it wait for the next day."""

    @field_validator("to")
    @classmethod
    def _without_password(cls, value: str | None) -> str | None:
        try:
            parts = urlsplit(value or "")
            _ = parts.port
        except ValueError:
            raise wrong("is not a valid address: postgresql://USER@HOST/DATABASE") from None
        if parts.password is not None or "password=" in parts.query:
            raise wrong("holds a password; write it to the service's ~/.pgpass, or use passfile=")
        return value


class LoggingConfig(Section):
    """What goes to the journal."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """From which on messages go to the journal."""
