"""Files that appear whole or not at all, and one sentence where that cannot be.

What is written goes into `.<name>.partial` next to the file first, and is removed whatever ends the
writing: an error, an interrupt, a full disk, a folder that became read-only meanwhile.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from thermocald.errors import OutputError, ThermocaldError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

# the disk's fault, not the user's: exit status 3
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.ENXIO}
_ADVICE = {
    errno.EACCES: "; choose another folder, or mend its permissions",
    errno.EROFS: "; choose another folder",
    errno.ENOSPC: "; free some space",
    errno.EDQUOT: "; free some space",
    errno.ENOENT: "; its folder does not exist",
    errno.EISDIR: "; give the name of a file in it",
}

_LONGEST_NAME = 60


def cannot_write(path: Path | str, cause: OSError) -> OutputError:
    """The error for what could not be written: what, why, and what to do."""
    why = cause.strerror or str(cause)
    advice = _ADVICE.get(cause.errno or 0, "")
    status = 3 if cause.errno in _DISK else 2
    return OutputError(f"{path}: cannot be written: {why}{advice}", status)


def output_place(path: Path) -> tuple[Path, bool]:
    """Where an output goes: (the file that links lead to, whether it is written straight).

    Straight is what must stay what it is: a device, a pipe, a descriptor of this process. Raises
    OSError for a folder and for a file that may not be written.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        found = None
    place = Path(os.path.realpath(path))
    if found is None:
        return place, False  # nothing there yet, or a link that leads nowhere yet
    if stat.S_ISDIR(found.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    if not stat.S_ISREG(found.st_mode) or place.is_relative_to("/proc"):
        return path, True
    return place, False


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield the path to write to; afterwards it stands at `path`, or nothing is left of it.

    Links are followed; a device or a pipe is written straight, a folder refused. The folders above
    are made; a file that was there hands on its permissions. Raises OutputError for every OSError.
    """
    make_folder(path.absolute().parent)
    partial = None
    try:
        place, straight = output_place(path)
        if straight:
            yield path
            return
        # a long name leaves no room for more
        partial = place.with_name(f".{place.name[:_LONGEST_NAME]}.partial")
        _remove(partial)  # never through a link that somebody left under this name
        yield partial
        if place.exists():
            with contextlib.suppress(OSError):
                partial.chmod(stat.S_IMODE(place.stat().st_mode))
        os.replace(partial, place)
    except OSError as cause:
        if isinstance(cause, ThermocaldError):  # a device's
            raise
        raise cannot_write(path, cause) from cause
    finally:
        if partial is not None:
            with contextlib.suppress(OSError):
                _remove(partial)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


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
