"""The commands as data: names, usage, help, arguments and options, read from the program itself.

Manual pages and shell completions are written from these data, so that they agree with `--help`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import typer

from thermocald.cli import application

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["Command", "Entry", "program"]

NAME = "thermocald"


@dataclass(frozen=True)
class Entry:
    """One line of a help page: an argument or option as it is typed, and its help."""

    term: str
    text: str
    takes_value: bool  # an option with a value

    @property
    def flags(self) -> list[str]:
        """The flags, such as ["-o", "--out"]; empty for an argument."""
        words = re.sub(r"<[^>]*>|\[[^]]*\]", " ", self.term).replace(",", " ").split()
        return [word for word in words if word.startswith("-")]

    @property
    def choices(self) -> list[str]:
        """The values, if the help lists them, as in `<csv|parquet>`."""
        found = re.search(r"[<\[]([\w.-]+(?:\|[\w.-]+)+)[>\]]", self.term)
        return found[1].split("|") if found else []


@dataclass(frozen=True)
class Command:
    """A command or a group of commands; path: ("thermocald", "testfield", "print")."""

    path: tuple[str, ...]
    source: Any

    @cached_property
    def _context(self) -> Any:
        return typer.Context(self.source, info_name=" ".join(self.path))

    @property
    def usage(self) -> str:
        """The usage, such as `thermocald export [OPTIONS] RECORDING_OR_STORE`."""
        return " ".join(str(self.source.get_usage(self._context)).split()).removeprefix("Usage: ")

    @property
    def paragraphs(self) -> list[str]:
        """The paragraphs of the help; the first one is the summary."""
        return [" ".join(part.split()) for part in str(self.source.help or "").split("\n\n")]

    @property
    def summary(self) -> str:
        """Return the first paragraph without its full stop."""
        return self.paragraphs[0].rstrip(".")

    def _entries(self, kind: str) -> list[Entry]:
        found = [
            (parameter.get_help_record(self._context), not getattr(parameter, "is_flag", True))
            for parameter in self.source.get_params(self._context)
            if parameter.param_type_name == kind
        ]
        return [Entry(_one_line(r[0]), _one_line(r[1]), value) for r, value in found if r]

    @cached_property
    def arguments(self) -> list[Entry]:
        """The positional arguments."""
        return self._entries("argument")

    @cached_property
    def options(self) -> list[Entry]:
        """The options."""
        return self._entries("option")

    @cached_property
    def children(self) -> list[Command]:
        """Return the commands of a group, in the order of `--help`."""
        inner = getattr(self.source, "commands", {})
        return [Command((*self.path, n), c) for n, c in inner.items() if not c.hidden]

    def walk(self) -> Iterator[Command]:
        """Yield this command and all commands below it."""
        yield self
        for child in self.children:
            yield from child.walk()


def _one_line(text: str) -> str:
    # typer up to 0.15 escapes the bracket of a default for rich, which is not used here
    return " ".join(text.split()).replace("\\[", "[")


def program() -> Command:
    """Return the program with all its commands."""
    return Command((NAME,), typer.main.get_command(application()))
