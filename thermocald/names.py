"""Names, paths and arguments from outside the program, checked where they enter it.

Channels are named by devices, users and files and become columns of tables. A channel with the name
of one of this program's columns would replace it, and a character that separates columns would
shift them; both are refused.
A recording or a store may come from anybody. The paths in it must stay within its own folder: no
absolute path, no `..`, no link that leads out. The name of a camera or series that becomes part of
a file's name holds no separator and no control character.
"""

from __future__ import annotations

import functools
import inspect
import math
import os
import stat
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import chain, repeat, zip_longest
from numbers import Integral, Real
from pathlib import Path, PurePosixPath
from types import FunctionType, NoneType, UnionType
from typing import TYPE_CHECKING, Any, TypeVar, Union, cast, get_args, get_origin

from thermocald.errors import UsageError

if TYPE_CHECKING:
    from thermocald.errors import ThermocaldError

Public = TypeVar("Public", bound=Callable[..., Any])

WITH_VALUES = ("ok", "predicted", "resected", "last_pose")
"""Statuses of epochs without a fault: calibrated, or predicted and posed with a thermal model."""
UNEVENTFUL = (*WITH_VALUES, "repeated_frame", "not_calibrated")
"""Statuses of epochs whose frame need not be kept: it is nothing special, or kept already."""

PAGE_OF = "THERMOCALD_PAGE_OF"
"""Environment variable: the process id of the daemon that started a page, which ends with it."""

_PARAMETERS = (
    "c", "x0", "y0", "A1", "A2", "A3", "B1", "B2", "C1", "C2", "omega", "phi", "kappa", "X0", "Y0",
    "Z0",
)  # fmt: skip
OUR_COLUMNS = frozenset(
    (
        *_PARAMETERS,
        "epoch", "number", "frame", "frame_time", "temperature_time", "time", "clock_trusted",
        "status", "reason", "sigma0", "redundancy", "n_observations", "n_rejected", "revision",
        "device", "series", "state", "stored", "lost", "online",
        "pixel_pitch", "skew_s", "fingerprint", "event", "innovation_chi2", "innovation_bound",
        "drift_px_per_min", "mount_px", "series_epochs", "series_restarted",
        *(f"drift_{name}_px" for name in ("c", "x0", "y0")),
        *(f"{of}_{name}" for of in ("series", "level_sd") for name in ("c", "x0", "y0")),
        "reading_age_s", "unknown_past_px", "outside_K", "opencv",
        "blur_px", "blur_trend_x", "blur_trend_y", "blur_curvature", "contrast", "grey", "noise",
        "saturation", "epochs", "per_point", "channels", "target",
    )
)  # fmt: skip
"""The columns of this program's tables, outputs and pages."""
_OUR_PREFIXES = ("sd_", "online_")
_SEPARATORS = ",;=\"'\\"
_LONGEST = 64


def tell_apart(names: Sequence[str], sources: Sequence[str]) -> list[str]:
    """Return the names of series, those that several have with where they are: `M1 in day2`."""
    told = []
    for name, source in zip(names, sources, strict=True):
        same = [Path(s).parts[::-1] for n, s in zip(names, sources, strict=True) if n == name]
        # the last part of their paths in which all differ; a short path has none there
        levels = zip_longest(*same, fillvalue="")
        level = next((k for k, parts in enumerate(levels) if len({*parts}) == len(same)), None)
        place = source if level is None else "".join(Path(source).parts[::-1][level : level + 1])
        told.append(name if len(same) == 1 or place in ("", name) else f"{name} in {place}")
    return told


def channel_fault(name: object) -> str:
    """Return why a channel cannot have a name; empty if it can."""
    if not isinstance(name, str) or not name or name != name.strip() or len(name) > _LONGEST:
        return f"must be text of 1 to {_LONGEST} characters, without spaces around it"
    if not name.isprintable():
        return "holds a control character"
    if marks := [mark for mark in _SEPARATORS if mark in name]:
        return f"holds {marks[0]!r}, which separates columns"
    if name in OUR_COLUMNS or name.startswith(_OUR_PREFIXES):
        return "is the name of a column of this program"
    return ""


def require_channels(names: Iterable[object], where: str, error: type[Exception]) -> None:
    """Raise `error` for a name that a channel cannot have; its message begins with `where`."""
    known: set[object] = set()
    for name in names:
        fault = channel_fault(name)
        if not fault and name in known:
            fault = "is the name of two channels"
        if fault:
            shown = repr(name)[:80]
            raise error(f"{where}: a temperature channel cannot be called {shown}: it {fault}")
        known.add(name)


_LONGEST_PATH = 4096
LONGEST_NAME = 120


def relative_path(text: str, what: str, error: type[ThermocaldError]) -> Path:
    """Return a relative path that stays in its folder; the error's message begins with `what`."""
    path = PurePosixPath(text)
    if path.is_absolute() or ".." in path.parts or "\0" in text or len(text) > _LONGEST_PATH:
        raise error(
            f"{what}: {text[:80]!r} leads out of its folder; it must be relative, without `..`"
        )
    return Path(path)


def file_name(text: str, what: str, error: type[ThermocaldError]) -> str:
    """Return a camera's, series' or thermometer's name if it can be part of a file's name."""
    if (
        not text.strip()
        or text.startswith(".")
        or "/" in text
        or not text.isprintable()
        or len(text) > LONGEST_NAME
    ):
        raise error(
            f"{what}: {text[:80]!r} cannot be part of a file's name: it must be 1 to "
            f"{LONGEST_NAME} printable characters without `/`, and not begin with a full stop"
        )
    return text


class FileFolder:
    """A folder whose files are found by relative paths that must not lead out of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._root = os.path.realpath(folder)
        # by sub-folder, of which a year of frames has few
        self._is_inside = functools.cache(self._leads_inside)

    def find(self, relative: str | Path) -> Path | None:
        """Return the path of a regular file in the folder, None if it is absent or leads out."""
        text = os.fspath(relative)
        if os.path.isabs(text) or ".." in PurePosixPath(text).parts or "\0" in text:
            return None
        path = os.path.join(self.folder, text)
        try:
            mode = os.lstat(path).st_mode
        except OSError:
            return None
        if stat.S_ISLNK(mode):
            return Path(path) if os.path.isfile(path) and self._leads_inside(path) else None
        if not stat.S_ISREG(mode):
            return None
        return Path(path) if self._is_inside(os.path.dirname(path)) else None

    def _leads_inside(self, path: str) -> bool:
        real = os.path.realpath(path)
        return real == self._root or real.startswith(self._root.rstrip("/") + "/")


# of an annotation: the type that a value must have, and what a message calls it
_KINDS: dict[Any, tuple[Any, str]] = {
    str: (str, "text"),
    Path: (os.PathLike, "a path"),
    bool: (bool, "True or False"),
    float: (Real, "a number"),
    int: (Integral, "a whole number"),
    tuple: (Collection, "a tuple ({})"),
    Iterable: (Iterable, "a list (each {})"),
    Sequence: (Iterable, "a list (each {})"),
    Mapping: (Mapping, "a mapping"),
    Callable: (Callable, "a function"),
}
# of a class: the function that returns it
_MADE_BY = {"Series": "open", "ThermalCamera": "fit", "TestField": "read_testfield"}


def checked(public: Public) -> Public:
    """Return a function that raises UsageError for an argument that its annotations exclude.

    A class is returned with its constructor and its public methods checked.
    """
    if isinstance(public, type):
        for name, member in vars(public).copy().items():
            if isinstance(member, FunctionType) and (name == "__init__" or name[0] != "_"):
                setattr(public, name, checked(member))
            elif isinstance(member, classmethod):
                setattr(public, name, classmethod(checked(member.__func__)))
        return public

    named_in_order = inspect.getfullargspec(public)

    @functools.cache
    def kinds() -> dict[str | None, Any]:  # when its module is imported whole
        found: dict[str | None, Any] = {}
        for name in public.__annotations__.keys() - {"return"}:
            with suppress(NameError):  # only type checkers import it: any value is accepted
                found[name] = eval(public.__annotations__[name], public.__globals__)
        return found

    @functools.wraps(public)
    def called(*given: Any, **named: Any) -> Any:
        given, named = tuple(map(_plain, given)), _plain(named)
        names = chain(named_in_order.args, repeat(named_in_order.varargs))  # *series is several
        for name, value in (*zip(names, given, strict=False), *named.items()):
            kind = kinds().get(name, Any)
            if not _accepts(kind, value):
                shown = repr(value)
                without = " without a NUL character" * ("\\x00" in shown)
                shown = shown if len(shown) <= 80 else f"{shown[:79]}…"
                raise UsageError(f"{name} is {shown}; it must be {_in_words(kind)}{without}")
        return public(*given, **named)

    return cast("Public", called)


def _parts(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return an annotation's type and its elements' types; tuple[X, ...] is a list of X."""
    inner = get_args(kind)
    return (Sequence, inner[:1]) if Ellipsis in inner else (get_origin(kind) or kind, inner)


def _in_words(kind: Any) -> str:
    """Return what a message calls the values of an annotation: `a list (each a number)`."""
    origin, inner = _parts(kind)
    if origin in (Union, UnionType):
        return " or ".join(_in_words(one) for one in inner if one is not NoneType)
    if origin in _KINDS:
        words = _KINDS[origin][1]
        return words.format(", ".join(map(_in_words, inner))) if "{" in words else words
    name = origin.__name__
    made = f" (from {_MADE_BY[name]})" if name in _MADE_BY else ""
    return f"{'an' if name[0] in 'AEIO' else 'a'} {name}{made}"


def _plain(value: Any) -> Any:
    """Return Python's number for one of NumPy, xarray, …, also in a mapping; NaN if masked.

    A path in a user's home folder (`~`, `~name`) is returned with that folder.
    """
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, str | os.PathLike) and str(value).startswith("~"):
        return os.path.expanduser(value)
    if getattr(value, "ndim", None) != 0 or "time" in str(value.dtype):
        return value
    number = getattr(value, "tolist", value.item)()
    return math.nan if number is None else number


def _accepts(kind: Any, value: Any) -> bool:
    """Return whether a value and its elements are what an annotation says."""
    origin, inner = _parts(kind)
    if origin in (Union, UnionType):
        return any(_accepts(one, value) for one in inner)
    if isinstance(value, str | os.PathLike) and "\0" in str(value):
        return False
    if origin is Any:
        return True
    if isinstance(value, bool) and origin in (int, float):
        return False
    if not isinstance(value, _KINDS.get(origin, (origin,))[0]):
        return False
    if origin not in _KINDS or not inner or not isinstance(value, Collection):
        return True  # an iterator can be read only once
    if isinstance(value, str):  # a list of its letters is never meant
        return False
    if isinstance(value, Mapping):
        inner, value = inner[1:], value.values()
    each = inner if origin is tuple else inner[:1] * len(value)
    return len(each) == len(value) and all(map(_accepts, each, value))
