"""Files that appear whole or not at all, YAML that people write, one sentence where either fails.

What is written goes into `.<name>.partial` next to the file first, and is removed whatever ends the
writing: an error, an interrupt, a full disk, a folder that became read-only meanwhile. YAML is read
with one clear error, no key twice, and no code run.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from thermocald.errors import ConfigurationError, OutputError, ThermocaldError

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator

# the disk's fault, not the user's: exit status 3
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.ENXIO}
_ADVICE = {
    errno.EACCES: "; choose another folder, or mend its permissions",
    errno.EROFS: "; choose another folder",
    errno.ENOSPC: "; free some space",
    errno.EDQUOT: "; free some space",
    errno.ENOENT: "; its folder does not exist",
    errno.EISDIR: "; give the name of a file in it",
    errno.EEXIST: "; choose another name",
}
_DATABASE = b"SQLite format 3\0"
_WAL_MAGIC = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")
_RECORDED = {"epochs.csv", "observations.csv", "observations.parquet", "readings.csv"}

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
    OSError for a folder, for a file that may not be written, and for what was measured: `-o` where
    `--store` was meant must not cost a store.
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
    if what := is_measured(place):
        raise FileExistsError(errno.EEXIST, f"it is {what}")
    return place, False


def is_measured(path: Path) -> str:
    """Say what of the measurements a file is that nothing else may be written to, "" if none."""
    try:
        with path.open("rb") as file:
            head = file.read(len(_DATABASE))
    except OSError:
        return ""
    if head == _DATABASE:
        return "a store (an SQLite database)"
    return "what was written last to a store" if head.startswith(_WAL_MAGIC) else ""


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
    place = Path(os.path.realpath(path))
    if place.name in _RECORDED and place.exists() and (place.parent / "recording.yaml").exists():
        raise cannot_write(path, FileExistsError(errno.EEXIST, "it is part of a recording"))
    with new_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.writelines(parts)


def make_folder(path: Path) -> None:
    """Make a folder and those above it where there is none; raises OutputError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise cannot_write(path, cause) from cause


_MOST_VALUES = 100_000
_MOST_BYTES = 20_000_000
_DEEPEST = 60

# What PyYAML's constructors let through on hostile scalars (`!!bool x`, `!!int ""`, 2020-99-99).
_CONSTRUCTION = (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, which also refuses a key that is duplicated."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"key {key.value!r} is duplicated", key.start_mark
                    )
                seen.add(key.value)
        mapping: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return mapping


def read_yaml(path: Path, error: type[ThermocaldError] = ConfigurationError) -> dict[str, Any]:
    """The mapping in a YAML file.

    Raises `error`, naming the file and where there is one the line, if the file is missing, is no
    YAML, holds a key twice, or holds something else than a mapping with text keys.
    """
    try:
        if path.exists() and not path.is_file():
            raise error(f"{path}: is not a file")
        if path.exists() and path.stat().st_size > _MOST_BYTES:
            raise error(f"{path}: is larger than {_MOST_BYTES // 1_000_000} MB")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as cause:
        what = cause.strerror if isinstance(cause, OSError) else "is not UTF-8 text"
        raise error(f"{path}: cannot be read: {what}") from cause
    try:
        if _is_too_deep(text):
            raise error(f"{path}: is nested deeper than {_DEEPEST} levels")
        document = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as cause:
        mark = cause.problem_mark
        where = "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"
        raise error(f"{path}{where}: {cause.problem or cause.context}") from cause
    except yaml.YAMLError as cause:
        raise error(f"{path}: is no YAML: {' '.join(str(cause).split())}") from cause
    except RecursionError as cause:
        raise error(f"{path}: is nested too deeply") from cause
    except _CONSTRUCTION as cause:
        raise error(f"{path}: holds a value that is no YAML: {cause}") from cause
    if document is None:
        raise error(f"{path}: is empty")
    if not isinstance(document, dict):
        raise error(f"{path}: must hold `key: value` lines, not a {type(document).__name__}")
    for key in document:
        if not isinstance(key, str):
            raise error(f"{path}: key {key!r} must be text")
    if _is_too_large(document):
        raise error(f"{path}: holds more than {_MOST_VALUES} values, or aliases without end")
    return document


def _is_too_deep(text: str) -> bool:
    """Whether lists and mappings are nested so deep that building them would exhaust the stack."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEEPEST:
                return True
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
    return False


def _is_too_large(document: dict[str, Any]) -> bool:
    """A few aliases (`*a`) can stand for billions of values, or for themselves."""
    left, waiting = _MOST_VALUES, [document]
    while waiting and left > 0:
        value: Any = waiting.pop()
        left -= 1
        if isinstance(value, dict | list):
            waiting.extend(value.values() if isinstance(value, dict) else value)
    return left <= 0


def dump_yaml(document: dict[str, Any]) -> str:
    """YAML text that keeps the order of the keys and writes short mappings on one line."""
    text: str = yaml.safe_dump(
        document, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )
    return text
