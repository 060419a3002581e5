"""Files that are written whole or not at all, and YAML files written by hand.

A file is written as `.<name>.partial` beside its place first. The partial file is removed if an
error, an interrupt, a full disk or a folder that became read-only ends the writing. A YAML file
that cannot be read raises one error that names the place; no key may occur twice, and no code is
run.

A number with a unit is written by hand as `3.04` or `{value: 3.04, sd: 0.01, unit: mm}`. A bare
number has the unit that the documentation states, which a written unit must equal.
"""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import re
import shutil
import stat
import time
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import yaml

from thermocald.errors import ConfigurationError, OutputError, ThermocaldError

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Iterator, Mapping

# faults of the disk and not of the user: exit status 3
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG, errno.ENXIO}
_ADVICE = {
    errno.EACCES: "; choose another folder, or mend its permissions",
    errno.EROFS: "; choose another folder",
    errno.ENOSPC: "; free some space",
    errno.EDQUOT: "; free some space",
    errno.ENOENT: "; its folder does not exist: make it, or mount its disk",
    errno.EISDIR: "; give the name of a file in it",
    errno.EEXIST: "; choose another name",
}
_DATABASE = b"SQLite format 3\0"
_KERNEL = (("/", "proc"), ("/", "sys"))
_WAL_MAGIC = (b"\x37\x7f\x06\x82", b"\x37\x7f\x06\x83")
_RECORDED = {
    "recording.yaml", "epochs.csv", "observations.csv", "observations.parquet", "readings.csv",
}  # fmt: skip

_LONGEST_NAME, _LONGEST_SHOWN = 60, 400

Output = Literal["file", "folder", "recording", "either"]
"""What a command writes: "recording" is a new folder, "either" a folder if it exists, else a file.
"""


def cannot_write(path: Path | str, cause: OSError) -> OutputError:
    """Return the error for a file that could not be written: which, why, and what to do."""
    why = cause.strerror or str(cause)
    advice = _ADVICE.get(cause.errno or 0, "")
    status = 3 if cause.errno in _DISK else 2
    # no file of too long a name can be read either
    what = "used" if cause.errno == errno.ENAMETOOLONG else "written"
    return OutputError(f"{shown(path)}: cannot be {what}: {why}{advice}", status)


@contextmanager
def reading(path: Path, error: type[ThermocaldError]) -> Iterator[None]:
    """Raise `error`, which names the file and the reason, for an OSError of the block."""
    try:
        yield
    except OSError as cause:
        raise error(f"{shown(path)}: cannot be read: {cause.strerror or cause}") from cause


def shown(path: Path | str) -> str:
    """Return a path for a message, which an absurdly long one must not fill."""
    text, half = str(path), _LONGEST_SHOWN // 2
    return text if len(text) <= _LONGEST_SHOWN else f"{text[:half]}…{text[-half:]}"


def check_output(path: Path, kind: Output = "file") -> None:
    """Raise OutputError, before an output is computed, if it could not be written.

    `output_place` decides which files may be replaced; a new recording replaces nothing. The
    nearest existing folder must accept files; missing folders are made when the output is written.
    """
    try:
        place = _followed(path)
        if kind == "either":
            kind = "folder" if place.is_dir() else "file"
        if kind == "file" and output_place(path)[1]:
            return  # a device or a pipe
        within = place.parent if kind == "file" else place
        folder = next(one for one in (within, *within.parents) if one.exists())
        if folder.parts[:2] in _KERNEL:
            raise OSError(errno.EROFS, "the folder belongs to the kernel")
        if not folder.is_dir():
            raise OSError(
                errno.ENOTDIR, "it is a file" if folder == place else f"{folder} is a file"
            )
        if not os.access(folder, os.W_OK | os.X_OK):
            code = errno.EROFS if os.statvfs(folder).f_flag & os.ST_RDONLY else errno.EACCES
            raise OSError(code, os.strerror(code))
        if kind == "recording" and folder == place and any(place.iterdir()):
            raise OSError(errno.EEXIST, "it exists already")
    except OSError as cause:
        raise cannot_write(path, cause) from cause


def output_place(path: Path) -> tuple[Path, bool]:
    """Return where an output is written: (the file that links lead to, whether directly).

    A device, a pipe or a descriptor of this process is written directly and not replaced. Raises
    OSError for a folder, a disk, a file without write permission, and a file with measurements:
    `-o` in place of `--store` must not cost a store.
    """
    place = _followed(path)
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return place, False  # no file yet, or a link that leads to none yet
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not os.access(path, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    if stat.S_ISBLK(mode):
        raise FileExistsError(errno.EEXIST, "it is a disk")
    if stat.S_ISSOCK(mode):
        raise OSError(errno.ENXIO, "it is a socket")
    if not is_ordinary(path):
        return path, True
    what = "a store (an SQLite database)" if is_database(place) else ""
    if _beginning(place).startswith(_WAL_MAGIC):
        what = "the write-ahead log of a store"
    if place.name in _RECORDED and (place.parent / "recording.yaml").exists():
        what = "part of a recording"
    if what:
        raise FileExistsError(errno.EEXIST, f"it is {what}")
    return place, False


def _followed(path: Path) -> Path:
    """Return the place that links lead to. Raises OSError for a name that no file can have."""
    if "\0" in str(path):
        raise OSError(errno.EINVAL, "the name holds a NUL character")
    return Path(os.path.realpath(path))


def mount_point(path: Path) -> Path:
    """Return the mount point of the disk that holds a path, or would hold it."""
    folder = Path(os.path.realpath(path))
    return next(one for one in (folder, *folder.parents) if os.path.ismount(one))


def is_unmounted(path: Path, mount: Path) -> bool:
    """Return whether the disk that was mounted at `mount`, as `mount_point` returned, is gone."""
    now = mount_point(path)
    return now != mount and mount.is_relative_to(now)


def is_ordinary(path: Path) -> bool:
    """Return whether a path leads to a file on a disk, not to a device, a pipe or the kernel."""
    return os.path.isfile(path) and Path(os.path.realpath(path)).parts[:2] not in _KERNEL


def is_database(path: Path) -> bool:
    """Return whether a file is an SQLite database."""
    return is_ordinary(path) and _beginning(path) == _DATABASE


def _beginning(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(len(_DATABASE))
    except (OSError, ValueError):  # ValueError: a NUL character in the path
        return b""


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Yield a partial file to write to; move it to `path` afterwards, or remove it after an error.

    Links are followed; a device or a pipe is written directly; a folder is refused. Missing folders
    are made; a replaced file's permissions are kept. Raises OutputError for every OSError.
    """
    make_folder(path.absolute().parent)
    partial = None
    try:
        place, directly = output_place(path)
        if directly:
            yield path
            return
        # shortened: a long name leaves no room for the suffix
        partial = place.with_name(f".{place.name[:_LONGEST_NAME]}.partial")
        _remove(partial)  # so that nothing is written through a link of this name
        partial.touch()  # raises with the system's reason, not with a library's
        yield partial
        if place.exists():
            with contextlib.suppress(OSError):
                partial.chmod(stat.S_IMODE(place.stat().st_mode))
        os.replace(partial, place)
    except OSError as cause:
        if isinstance(cause, ThermocaldError):  # a device's error is an OSError too
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
    """Write a text file from its parts, whole or not at all; raises OutputError."""
    with new_file(path) as partial, partial.open("w", encoding="utf-8") as file:
        file.writelines(parts)


def utc_stamp() -> str:
    """Return the time as part of a file's name."""
    return time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())


def make_folder(path: Path) -> None:
    """Make a folder and its parents unless it exists; raises OutputError."""
    try:
        _followed(path)
        path.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise cannot_write(path, cause) from cause


_ATTEMPTS, _PAUSE_S = 10, 0.01


def read_json(path: Path) -> dict[str, Any]:
    """Return the mapping in a JSON file that another process writes; empty if there is none.

    `overwrite_json` may have written half of it: it is whole if read twice alike.
    """
    for _ in range(_ATTEMPTS):
        try:
            data = path.read_bytes()
            document = json.loads(data)
            if path.read_bytes() == data:
                return document if isinstance(document, dict) else {}
        except OSError:
            return {}
        except ValueError:
            pass
        time.sleep(_PAUSE_S)
    return {}


def overwrite_json(path: Path, data: bytes) -> bool:
    """Write a document over a file in place, which takes no disk space; return whether it fits.

    The file is no valid JSON until all of it is written.
    """
    try:
        with path.open("r+b", buffering=0) as file:
            room, document = os.fstat(file.fileno()).st_size, data.rstrip()
            if len(document) > room:
                return False
            os.pwrite(file.fileno(), b"\0", 0)
            written = os.pwrite(file.fileno(), document[1:].ljust(room - 1), 1)
            return written == room - 1 and os.pwrite(file.fileno(), document[:1], 0) == 1
    except OSError:
        return False


_MOST_VALUES = 100_000
_MOST_BYTES = 20_000_000
_DEEPEST = 60

# PyYAML's words → ours
_FAULTS = {
    "cannot start any token": (
        "a line or a value begins with a tab or a sign of YAML's: indent with spaces, quote texts"
    ),
    "determine a constructor": "holds a tag, `!…`: write the value without it, or quote it",
    "mapping values": "`: ` must not stand here: indent lines alike, quote a text that holds it",
    "did not find expected": "something before is not closed or not indented like its neighbours",
    "expected ':'": "a line before is no `key: value`",
    "unexpected end": "a quote before is not closed",
    "undefined alias": "`*…` refers to nothing: quote a text that begins with *",
}
# raised by PyYAML's constructors for hostile scalars (`!!bool x`, `!!int ""`, 2020-99-99)
_CONSTRUCTION = (ValueError, KeyError, IndexError, AttributeError, TypeError, OverflowError)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, which also refuses duplicate keys, `010` and `1:30`.

    YAML 1.1 reads them as the octal number 8, and as 90 in base 60.
    """

    def construct_whole(self, node: yaml.ScalarNode) -> int:
        if re.fullmatch(r"[+-]?0[0-9_]+", node.value):
            raise yaml.constructor.ConstructorError(
                None, None, f"{node.value} is octal in YAML: write no 0 before it, a point for a "
                "decimal comma, or quote a text", node.start_mark,
            )  # fmt: skip
        number = int(self.construct_yaml_int(node))
        if ":" in node.value:
            raise yaml.constructor.ConstructorError(
                None, None, f"{node.value} is {number} in YAML: write that, or quote a text",
                node.start_mark,
            )  # fmt: skip
        return number

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


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_whole)


def read_yaml(path: Path, error: type[ThermocaldError] = ConfigurationError) -> dict[str, Any]:
    """Return the mapping in a YAML file.

    Raises `error`, which names the file and if possible the line, if the file is missing, is no
    YAML, holds a key twice, or holds something other than a mapping with text keys.
    """
    if os.path.exists(path):  # False, too, in a closed folder
        if not os.path.isfile(path):
            raise error(f"{path}: is not a file")
        if path.stat().st_size > _MOST_BYTES:
            raise error(f"{path}: is larger than {_MOST_BYTES // 1_000_000} MB")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as cause:
        what = "is not UTF-8 text" if isinstance(cause, UnicodeDecodeError) else cause
        raise error(f"{shown(path)}: cannot be read: {getattr(cause, 'strerror', what)}") from cause
    return parse_yaml(text, path, error)


def parse_yaml(
    text: str, path: Path | str, error: type[ThermocaldError] = ConfigurationError
) -> dict[str, Any]:
    """Return the mapping in a YAML text; path: named by the errors, which are as in `read_yaml`."""
    try:
        if _is_too_deep(text):
            raise error(f"{path}: is nested deeper than {_DEEPEST} levels")
        document = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as cause:
        mark = cause.problem_mark
        where = "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"
        told = cause.problem or cause.context or ""
        wrong = next((ours for theirs, ours in _FAULTS.items() if theirs in told), told)
        raise error(f"{path}{where}: {wrong}") from cause
    except (yaml.YAMLError, *_CONSTRUCTION) as cause:
        raise error(f"{path}: holds what is no YAML: {' '.join(str(cause).split())}") from cause
    if document is None:
        raise error(f"{path}: is empty")
    if not isinstance(document, dict):
        raise error(f"{path}: must hold `key: value` lines, but holds something else")
    for key in document:
        if not isinstance(key, str):
            raise error(f"{path}: key {key!r} must be text")
    if wrong := _fault(document):
        raise error(f"{path}: {wrong}")
    return document


def _is_too_deep(text: str) -> bool:
    """Return whether lists and mappings are nested so deeply that the stack might not suffice."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            return True
    return False


def _fault(document: dict[str, Any]) -> str:
    """Return what is wrong with the values: too many, or a text with NUL, which no path may hold.

    A few aliases (`*a`) can stand for billions of values.
    """
    left, waiting = _MOST_VALUES, [document]
    while waiting and left > 0:
        value: Any = waiting.pop()
        left -= 1
        if isinstance(value, str) and "\0" in value:
            return f"{value[:40]!r} holds a NUL character; remove it"
        if isinstance(value, dict | list):
            waiting.extend(value.values() if isinstance(value, dict) else value)
    return "" if left > 0 else f"holds more than {_MOST_VALUES} values, or aliases without end"


class _Dumper(yaml.SafeDumper):
    """The safe dumper, which escapes lone surrogates (from file names): no file can hold them."""


_Dumper.add_representer(
    str, lambda dumper, text: dumper.represent_str(text.encode(errors="backslashreplace").decode())
)


def dump_yaml(document: dict[str, Any]) -> str:
    """Return YAML text with the keys in their order and short mappings on one line."""
    text: str = yaml.dump(
        document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None,
        width=100,
    )  # fmt: skip
    return text


def write_quantity(value: float, unit: str, sd: float | None = None) -> dict[str, Any]:
    """Return the mapping that a file holds for a number with a unit."""
    document: dict[str, Any] = {"value": float(value)}
    if sd is not None and math.isfinite(sd):
        document["sd"] = float(sd)
    return {**document, "unit": unit}


class QuantityReader:
    """A reader of one mapping of a file, whose errors name the file and the dotted key."""

    error: ClassVar[type[ThermocaldError]] = ConfigurationError

    def __init__(self, path: Path | str, mapping: Any, prefix: str = "") -> None:
        self._path = path
        self._prefix = prefix
        if not isinstance(mapping, dict):
            what = "is missing" if mapping is None else "must hold `key: value` pairs"
            raise self.error(f"{path}, {prefix.rstrip('.') or 'the file'}: {what}")
        self.mapping: Mapping[str, Any] = mapping

    def fail(self, key: str, message: str) -> ThermocaldError:
        """Return an error about a key, for the caller to raise."""
        return self.error(f"{self._path}, key {self._prefix}{key}: {message}")

    def require_format(self, wanted: str, said: str = "this program reads") -> None:
        """Refuse a file of another format."""
        given = self.text("format")
        if given != wanted:
            raise self.fail("format", f"is {given[:60]!r}; {said} {wanted!r}")

    def only(self, known: Iterable[str]) -> None:
        """Refuse unknown keys."""
        names = list(known)
        for key in self.mapping:
            if key not in names:
                near = get_close_matches(str(key), names, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(names)}"
                raise self.fail(str(key), f"is unknown; {hint}")

    def text(self, key: str, default: str | None = None) -> str:
        """Read text; a number counts as its digits."""
        value = self.mapping.get(key, default)
        if value is None:
            raise self.fail(key, "is missing")
        if isinstance(value, bool) or not isinstance(value, str | int | float):
            raise self.fail(key, "must be text")
        return str(value)

    def number(
        self, key: str, unit: str, default: float | None = None,
        low: float = -math.inf, above: float = -math.inf, high: float = math.inf,
    ) -> float:  # fmt: skip
        """Read the value of a quantity: at least `low`, more than `above`, at most `high`."""
        value, _ = self.quantity(key, unit, default)
        given = f"is {value:g} {unit}".removesuffix(" 1")
        if value <= above:
            raise self.fail(key, f"{given}; it must be above {above:g}")
        if value < low:
            raise self.fail(key, f"{given}; it must be at least {low:g}")
        if value > high:
            raise self.fail(key, f"{given}; it is at most {high:g}")
        return value

    def share(self, key: str, default: float) -> float:
        """Read a share, at least 0 and below 1."""
        value = self.number(key, "1", default, low=0.0)
        if value >= 1:
            raise self.fail(key, f"is {value:g}; it is a share below 1")
        return value

    def quantity(
        self, key: str, unit: str, default: float | None = None
    ) -> tuple[float, float | None]:
        """Read a number in `unit` and its standard deviation, None if none is given.

        Raises `error` if it is missing, is no number, or has another unit.
        """
        raw = self.mapping.get(key, default)
        if raw is None:
            raise self.fail(key, f"is missing; it is a number in {unit}".removesuffix(" in 1"))
        sd: float | None = None
        if isinstance(raw, dict):
            inner = type(self)(self._path, raw, f"{self._prefix}{key}.")
            inner.only(("value", "sd", "unit"))
            written = inner.text("unit", unit)
            if written != unit:
                raise inner.fail("unit", f"is {written!r}; it must be {unit!r}: convert the value")
            if "value" not in raw:
                raise inner.fail("value", "is missing")
            if raw.get("sd") is not None:
                sd = inner.finite("sd", raw["sd"])
                if sd < 0:
                    raise inner.fail("sd", f"is {sd:g}; a standard deviation is not negative")
            raw = raw["value"]
        return self.finite(key, raw), sd

    def finite(self, key: str, raw: Any) -> float:
        """Return a value at a key as a finite number."""
        try:
            # PyYAML reads 1e-3 as text, since YAML 1.1 demands a decimal point
            value = float(raw) if isinstance(raw, str | int | float) else math.nan
        except (ValueError, OverflowError):
            value = math.nan
        if isinstance(raw, bool) or not math.isfinite(value):
            raise self.fail(key, f"{str(raw)[:40]!r} is not a finite number")
        return value

    def whole(self, key: str, unit: str, high: float = math.inf) -> int:
        """Read a whole number, at least 1."""
        value = self.number(key, unit, low=1, high=high)
        if value != int(value):
            given = f"is {value:g} {unit}".removesuffix(" 1")
            raise self.fail(key, f"{given}; it must be a whole number")
        return int(value)

    def inner(self, key: str) -> Self:
        """Return the reader of the mapping at a key."""
        if self.mapping.get(key) is None:
            raise self.fail(key, "is missing")
        return type(self)(self._path, self.mapping[key], f"{self._prefix}{key}.")

    def items(self, key: str) -> Iterator[Self]:
        """Yield the readers of a list's mappings at a key; none if the key is absent."""
        values = self.mapping.get(key) or []
        if not isinstance(values, list):
            raise self.fail(key, "must be a list (lines that begin with `-`)")
        for number, value in enumerate(values, start=1):
            yield type(self)(self._path, value, f"{self._prefix}{key}[{number}].")
