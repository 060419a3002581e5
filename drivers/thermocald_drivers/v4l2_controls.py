"""The controls of a V4L2 camera that move its image: locked, read back, compared with every frame.

A camera that focuses is another camera. Whatever is not configured is locked at the value it has
when the camera is opened, and set to the same value again after a re-plug: focus, exposure, gain,
white balance; zoom, pan, tilt and iris; image stabilisation is switched off. An automatic mode that
cannot be switched off is an error, unless the stanza asks for it by name (`focus: auto`).
Source: Linux Documentation/userspace-api/media/v4l/ext-ctrls-camera.rst, control.rst.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from thermocald.errors import WrongDevice
from thermocald_drivers.support import AUTO

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    Wanted = float | str | None

EXPOSURE = 0x009A0902
EXPOSURE_UNIT_S = 1e-4
_UNREADABLE = {errno.EINVAL, errno.EACCES, errno.ENOTTY}


@dataclass(frozen=True)
class Control:
    """A setting of the camera; `name` is its name in lower case with underscores."""

    id: int
    name: str
    minimum: int
    maximum: int
    step: int


class Access(Protocol):
    """Reading and setting controls by their V4L2 number."""

    def controls(self) -> dict[int, Control]: ...
    def get(self, control: int) -> int: ...
    def set(self, control: int, value: int) -> None: ...


@dataclass(frozen=True)
class Lock:
    """One setting: its option, the automatic mode and its values, the control and its unit."""

    option: str
    automatic: int
    manual: int
    automatic_values: tuple[int, ...]
    control: int
    unit: float = 1.0

    @property
    def flag(self) -> str:
        """The name of the automatic mode among a frame's settings."""
        return f"{self.option.rsplit('_', 1)[0] if '_' in self.option else self.option}_auto"


LOCKS = (
    # V4L2_EXPOSURE_MANUAL is 1; aperture priority, automatic, shutter priority are 3, 0, 2
    Lock("exposure_s", 0x009A0901, 1, (3, 0, 2), EXPOSURE, EXPOSURE_UNIT_S),
    Lock("gain", 0x00980912, 0, (1,), 0x00980913),
    Lock("focus", 0x009A090C, 0, (1,), 0x009A090A),
    Lock("white_balance_k", 0x0098090C, 0, (1,), 0x0098091A),
)
HELD = (0x009A0908, 0x009A0909, 0x009A090D, 0x009A0911)  # pan, tilt, zoom, iris
OFF = (0x009A0916,)  # image stabilisation


class CameraControls:
    """The settings of one camera, kept while it is closed and opened again.

    wanted: {option of LOCKS: value, AUTO, or None to lock what is there}; named: {control by its
    name: value}. Raises WrongDevice where the camera does not have or hold them.
    """

    def __init__(self, where: str, wanted: Mapping[str, Wanted], named: Mapping[str, int]) -> None:
        self._where = where
        self._wanted = wanted
        self._named = named
        self._held: dict[int, int] = {}
        self._asked: dict[int, int] = {}
        self._automatic: list[Lock] = []
        self._configured: set[int] = set()
        self._available: dict[int, Control] = {}

    def warnings(self) -> list[str]:
        """A sentence for each automatic mode that the stanza asks for."""
        return [
            f"{lock.option}: auto lets the camera change it; every change is another camera"
            for lock in LOCKS
            if self._wanted.get(lock.option) == AUTO
        ]

    def apply(self, stream: Access, *, strict: bool) -> None:
        """Set all, automatic modes first; strict: raise where it does not read back."""
        self._available = stream.controls()
        self._asked, self._automatic = {}, []
        locked = self._collect(stream)
        self._configured = set(self._asked) - locked - set(OFF)
        for control, value in self._asked.items():
            self._set(stream, control, value, locked)
        for control in locked & set(self._asked):
            if control not in self._modes():
                # the camera rounds: what it took is what is locked
                self._asked[control] = self._held[control] = stream.get(control)
        problems = self.deviations(self.values(stream))
        if problems and strict:
            raise WrongDevice(f"{self._where}: {'; '.join(problems)}")

    def _collect(self, stream: Access) -> set[int]:
        """Fill `_asked` and `_automatic`; the controls that nobody configured are returned."""
        locked = set()
        for lock in LOCKS:
            wanted = self._wanted.get(lock.option)
            if wanted == AUTO:
                self._ask_automatic(stream, lock)
                continue
            if wanted is not None and lock.control not in self._available:
                raise WrongDevice(
                    f"{self._where}: {lock.option}: it has no control 0x{lock.control:08x} to set"
                )
            if wanted is None:
                locked |= {lock.automatic, lock.control}
                value = self._standing(stream, lock.control)
            else:
                value = round(float(wanted) / lock.unit)
            if lock.automatic in self._available:
                self._asked[lock.automatic] = lock.manual
            if value is not None:
                self._asked[lock.control] = value
        for control in HELD:
            if (value := self._standing(stream, control)) is not None:
                self._asked[control] = value
                locked.add(control)
        self._asked |= {control: 0 for control in OFF if control in self._available}
        by_name = {control.name: number for number, control in self._available.items()}
        for name, number in self._named.items():
            if name not in by_name:
                known = ", ".join(sorted(by_name)) or "none"
                raise WrongDevice(f"{self._where}: there is no control {name!r}; it has {known}")
            self._asked[by_name[name]] = number
            locked.discard(by_name[name])
        return locked

    def _ask_automatic(self, stream: Access, lock: Lock) -> None:
        if lock.automatic not in self._available:
            raise WrongDevice(f"{self._where}: {lock.option}: auto, but it has no automatic mode")
        self._automatic.append(lock)
        if stream.get(lock.automatic) != lock.manual:
            return
        for value in lock.automatic_values:
            try:
                stream.set(lock.automatic, value)
            except OSError:
                continue
            return
        raise WrongDevice(f"{self._where}: {lock.option}: auto is not accepted")

    def _standing(self, stream: Access, control: int) -> int | None:
        """The value to hold: that of before a re-plug, else the current one; None without it."""
        if control not in self._available:
            return None
        if control not in self._held:
            try:
                value = stream.get(control)
            except OSError as error:
                if error.errno not in _UNREADABLE:
                    raise
                return None
            limits = self._available[control]
            self._held[control] = min(max(value, limits.minimum), limits.maximum)
        return self._held[control]

    def _set(self, stream: Access, control: int, value: int, locked: set[int]) -> None:
        try:
            if control in locked and stream.get(control) == value:
                return  # some cameras refuse a value that they already have
            stream.set(control, value)
        except OSError as error:
            limits = self._limits(control)
            if control in locked and control not in self._modes():
                return  # it cannot be set, so it stays; every frame is checked
            remedy = self._remedy(control) or f"it takes {limits}"
            raise WrongDevice(
                f"{self._where}: does not take {self._name(control)} = {value} "
                f"({error.strerror}); {remedy}"
            ) from error

    def values(self, stream: Access) -> dict[int, int]:
        """The current values of everything that is locked, and of what is automatic."""
        watched = [*self._asked, *(c for lock in self._automatic for c in self._of(lock))]
        return {control: stream.get(control) for control in dict.fromkeys(watched)}

    def deviations(self, values: Mapping[int, int]) -> list[str]:
        """A sentence for each control that does not read back as it was set."""
        return [
            f"{self._name(control)} was set to {asked} and is {values[control]} "
            f"({self._remedy(control) or self._limits(control)})"
            for control, asked in self._asked.items()
            if values[control] != asked
        ]

    def settings(self, values: Mapping[int, int]) -> dict[str, float]:
        """The values under the options' names and units; automatic modes as 1.0 and 0.0."""
        found: dict[str, float] = {}
        named = set()
        for lock in LOCKS:
            named |= {lock.automatic, lock.control}
            if lock.automatic in values:
                found[lock.flag] = float(values[lock.automatic] != lock.manual)
            if lock.control in values:
                found[lock.option] = round(values[lock.control] * lock.unit, 9)
        others = {c: v for c, v in values.items() if c not in named}
        return found | {self._name(control): float(value) for control, value in others.items()}

    def configured(self, values: Mapping[int, int]) -> dict[str, int]:
        """The values of what the stanza sets, by the device's own names."""
        return {self._name(c): v for c, v in values.items() if c in self._configured}

    def _of(self, lock: Lock) -> Iterable[int]:
        return [c for c in (lock.automatic, lock.control) if c in self._available]

    def _name(self, control: int) -> str:
        return self._available[control].name

    def _limits(self, control: int) -> str:
        c = self._available[control]
        return f"{c.minimum} … {c.maximum} in steps of {c.step}"

    def _remedy(self, control: int) -> str:
        lock = self._modes().get(control)
        return f"to let it change, write {lock.option}: auto" if lock else ""

    def _modes(self) -> dict[int, Lock]:
        """{automatic mode: its lock}."""
        return {lock.automatic: lock for lock in LOCKS}


def standing_values(
    available: Mapping[int, Control], get: Callable[[int], int]
) -> dict[str, float]:
    """{option: value} of a camera as it is now, for its stanza; `get` reads one control."""
    found: dict[str, float] = {}
    for lock in LOCKS:
        if lock.control not in available:
            continue
        try:
            value = get(lock.control)
        except OSError:
            continue
        limits = available[lock.control]
        value = min(max(value, limits.minimum), limits.maximum)
        found[lock.option] = round(value * lock.unit, 9) if lock.unit != 1.0 else value
    return found
