"""Files that appear whole or not at all, and one sentence where that cannot be.

What is written goes into `.<name>.partial` next to the file first, and is removed whatever ends the
writing: an error, an interrupt, a full disk, a folder that became read-only meanwhile.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from contextlib import contextmanager
from typing import TYPE_CHECKING

from thermocald.errors import OutputError, ThermocaldError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

__all__ = ["cannot_write", "make_folder", "new_file", "write_parts", "write_text"]

# the disk's fault, not the user's: exit status 3
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.ENXIO}
_ADVICE = {
    errno.EACCES: "; choose another folder, or mend its permissions",
    errno.EROFS: "; choose another folder",
    errno.ENOSPC: "; free some space",
    errno.EDQUOT: "; free some space",
    errno.ENOENT: "; its folder does not exist",
}


def cannot_write(path: Path | str, cause: OSError) -> OutputError:
    """The error for what could not be written: what, why, and what to do."""
    why = cause.strerror or str(cause)
    advice = _ADVICE.get(cause.errno or 0, "")
    status = 3 if cause.errno in _DISK else 2
    return OutputError(f"{path}: cannot be written: {why}{advice}", status)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield the path to write to; afterwards it stands at `path`, or nothing is left of it.

    The folders above it are made. Raises OutputError for every OSError within.
    """
    make_folder(path.absolute().parent)
    partial = path.with_name(f".{path.name}.partial")
    try:
        yield partial
        os.replace(partial, path)
    except OSError as cause:
        if isinstance(cause, ThermocaldError):  # a device's
            raise
        raise cannot_write(path, cause) from cause
    finally:
        with contextlib.suppress(OSError):
            if partial.is_dir():
                shutil.rmtree(partial, ignore_errors=True)
            else:
                partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all; raises OutputError."""
    write_parts(path, (text,))


def write_parts(path: Path, parts: Iterable[str]) -> None:
    """Write a text file that comes in parts, whole or not at all; raises OutputError."""
    with new_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.writelines(parts)


def make_folder(path: Path) -> None:
    """Make a folder and those above it where there is none; raises OutputError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise cannot_write(path, cause) from cause
