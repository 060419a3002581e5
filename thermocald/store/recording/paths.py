"""Names and paths that came from a file: checked when they are read, wherever they came from.

A recording or a store may have been made by anybody. What it names must stay within its own folder:
no absolute path, no `..`, no link that leads out; a name of a camera or series that becomes part of
a file's name holds no separator and no control character.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from thermocald.errors import ThermocaldError

__all__ = ["FileFolder", "file_name", "relative_path"]

_LONGEST = 4096
_LONGEST_NAME = 120


def relative_path(text: str, what: str, error: type[ThermocaldError]) -> Path:
    """A path that stays within the folder it is relative to; `what` begins the error's message."""
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or "\0" in text or len(text) > _LONGEST:
        raise error(
            f"{what}: {text[:80]!r} leads out of its folder; it must be relative, without `..`"
        )
    return Path(path)


def file_name(text: str, what: str, error: type[ThermocaldError]) -> str:
    """A name of a camera, series or thermometer that may become part of a file's name."""
    if (
        not text.strip()
        or text.startswith(".")
        or "/" in text
        or not text.isprintable()
        or len(text) > _LONGEST_NAME
    ):
        raise error(
            f"{what}: {text[:80]!r} cannot be part of a file's name: it must be 1 to "
            f"{_LONGEST_NAME} printable characters without `/`, and not begin with a point"
        )
    return text


class FileFolder:
    """A folder whose files are looked up by relative paths that must not lead out of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._root = os.path.realpath(folder)
        self._inside: dict[str, bool] = {}  # sub-folders looked at: a year has few of them

    def find(self, relative: str | Path) -> Path | None:
        """The path of a regular file in the folder; None where it is absent or leads out."""
        text = os.fspath(relative)
        if os.path.isabs(text) or ".." in PurePosixPath(text).parts or "\0" in text:
            return None
        path = os.path.join(self.folder, text)
        try:
            mode = os.lstat(path).st_mode
        except OSError:
            return None
        if stat.S_ISLNK(mode):
            return Path(path) if os.path.isfile(path) and self._is_inside(path) else None
        if not stat.S_ISREG(mode):
            return None
        parent = os.path.dirname(path)
        if parent not in self._inside:
            self._inside[parent] = self._is_inside(parent)
        return Path(path) if self._inside[parent] else None

    def _is_inside(self, path: str) -> bool:
        real = os.path.realpath(path)
        return real == self._root or real.startswith(self._root.rstrip("/") + "/")
