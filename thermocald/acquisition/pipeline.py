"""One camera's frames on their way to the store, in bounded memory: calibration may be dropped,
acquisition not.

    submit (the camera's thread) ─► waiting ─► calibrated ─► kept, in the order of their numbers
                                      └─► too many wait: kept uncalibrated, with the frame, and
                                          calibrated when there is time

Two threads, one calibrates and one keeps, so that a slow disk or a slow adjustment never holds the
camera up. `check_frame` looks at one frame before a series begins.

Frame and readings keep their own times when they are paired; nothing is interpolated here. Who
needs the temperature at the frame's time interpolates between neighbouring epochs' readings.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol

from thermocald.acquisition.calibrator import CalibratedEpoch, EpochCalibrator
from thermocald.epoch import Epoch
from thermocald.errors import DataError
from thermocald.names import require_channels
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.field.testfield import observations_from_lists
from thermocald.photogrammetry.targets.image_file import EncodedImage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from thermocald.hal import Clock, Frame, Reading


_REMEMBERED = 16
_OLDEST_IN_PERIODS = 1.5


@dataclass(frozen=True, slots=True)
class PairedReadings:
    """What the thermometers said around a frame.

    utc: s, of the reference thermometer, NaN if there is none; temperatures: {channel: °C};
    skew_s: reading minus frame, NaN if there is none.
    """

    utc: float
    temperatures: Mapping[str, float]
    skew_s: float


def pair_readings(readings: Mapping[str, Reading | None], frame_monotonic: float) -> PairedReadings:
    """Join one reading per thermometer, the reference first, into the temperatures of an epoch.

    Channels keep the thermometer's own names where there is one thermometer; with several they are
    `<thermometer>` for its channel `temperature` and `<thermometer>_<channel>` for others. Without
    the reference the next thermometer that answered gives the time.
    """
    temperatures: dict[str, float] = {}
    reference: Reading | None = None
    for name, reading in readings.items():
        if reading is None:
            continue
        reference = reference or reading
        for channel, value in reading.values.items():
            temperatures[_column(name, channel, len(readings))] = value
    if reference is None:
        return PairedReadings(math.nan, {}, math.nan)
    return PairedReadings(reference.utc, temperatures, reference.monotonic - frame_monotonic)


def require_columns(thermometers: Mapping[str, Iterable[str]], error: type[Exception]) -> list[str]:
    """The columns of an epoch for {thermometer: its channels}, the reference first.

    Raises `error` where one has the name of another, or of a column of this program.
    """
    columns = [
        _column(name, channel, len(thermometers))
        for name, channels in thermometers.items()
        for channel in channels
    ]
    where = f"thermometers {', '.join(thermometers)}"
    require_channels(columns, where, error)
    if "temperature" in columns[1:]:
        raise error(
            f"{where}: `temperature` is what the reference is called, the first of the channels "
            f"({', '.join(columns)}); make it the first, or rename it"
        )
    return columns


def _column(thermometer: str, channel: str, thermometers: int) -> str:
    if thermometers == 1:
        return channel
    return thermometer if channel == "temperature" else f"{thermometer}_{channel}"


class Readings:
    """The last readings of all thermometers; threads add, pipelines ask."""

    def __init__(self, periods_s: Mapping[str, float]) -> None:
        self._periods_s = dict(periods_s)
        self._kept: dict[str, deque[Reading]] = {
            name: deque(maxlen=_REMEMBERED) for name in periods_s
        }
        self._changed = threading.Condition()

    def add(self, name: str, reading: Reading) -> None:
        """Keep a reading."""
        with self._changed:
            self._kept[name].append(reading)
            self._changed.notify_all()

    def nearest(self, name: str, monotonic: float) -> Reading | None:
        """The reading nearest to a time; None if all are more than 1.5 periods away."""
        with self._changed:
            found = min(self._kept[name], key=lambda r: abs(r.monotonic - monotonic), default=None)
        limit = _OLDEST_IN_PERIODS * self._periods_s[name]
        if found is None or abs(found.monotonic - monotonic) > limit:
            return None
        return found

    def around(self, names: Sequence[str], monotonic: float, patience_s: float) -> PairedReadings:
        """The readings around a frame.

        patience_s: of wall time to wait for a reading that is being taken just now; none is waited
        for that cannot come nearer.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: all(self._answered(name, monotonic) for name in names), patience_s
            )
        return pair_readings({name: self.nearest(name, monotonic) for name in names}, monotonic)

    def _answered(self, name: str, monotonic: float) -> bool:
        kept = self._kept[name]
        return bool(kept) and kept[-1].monotonic >= monotonic - 0.5 * self._periods_s[name]


log = logging.getLogger(__name__)

_DEPTH = 3
_MOST_BYTES = 64_000_000  # of frames that wait to be kept
_MOST_WAITING = 200
_PATIENCE_S = 2.0
_IDLE_S = 0.5


def make_epoch(number: int, frame: Frame, paired: PairedReadings) -> Epoch:
    """The epoch of a frame and its readings; the picture is not measured yet."""
    return Epoch(number, frame.utc, paired.utc, paired.temperatures)


def calibrate_frame(calibrator: EpochCalibrator, epoch: Epoch, frame: Frame) -> CalibratedEpoch:
    """Measure and adjust; a frame that is not an image gives the status `bad_frame`, no error."""
    try:
        if (lists := frame.metadata.get("observations")) is not None:
            seen = observations_from_lists(lists, calibrator.testfield)
            return calibrator.calibrate(replace(epoch, observations=seen))
        image = EncodedImage(frame.encoded or b"") if frame.image is None else frame.image
    except DataError as error:
        return CalibratedEpoch(epoch, failed("bad_frame", str(error)), {})
    return calibrator.calibrate(epoch, image)


@dataclass(eq=False)
class AcquiredEpoch:
    """An epoch on its way: the frame, and what became of it so far.

    calibrated: None while it waits, and for good if calibration was dropped.
    """

    number: int
    frame: Frame
    clock_trusted: bool
    epoch: Epoch | None = None
    skew_s: float = float("nan")
    calibrated: CalibratedEpoch | None = None
    state: Literal["waiting", "calibrating", "done", "dropped"] = field(default="waiting")


class Keeper(Protocol):
    """Who keeps epochs; called by one thread, in the order of their numbers."""

    def keep(self, acquired: AcquiredEpoch) -> None:
        """Keep an epoch; `acquired.epoch` is set."""

    def amend(self, calibrated: CalibratedEpoch) -> None:
        """Keep the calibration of an epoch that was kept without."""

    def backlog(self, below: int) -> Epoch | None:
        """An epoch numbered below, kept without calibration, with the path of its frame."""


class Pipeline:
    """The queue, the calibrating and the keeping thread of one camera.

    calibrator: None if epochs are only acquired. observe: (a calibrated epoch, whether it comes in
    order) → the epoch as it is kept. depth: epochs that may wait. patience_s: to wait for a reading
    that is being taken, at most half a period. columns: of an epoch's temperatures, the reference
    first, as far as they are known. on_lost: told why an epoch that was taken is not kept.
    """

    def __init__(
        self,
        name: str,
        calibrator: EpochCalibrator | None,
        readings: Readings,
        thermometers: Sequence[str],
        keeper: Keeper,
        clock: Clock,
        *,
        first: int = 1,
        period_s: float = 10.0,
        depth: int = _DEPTH,
        patience_s: float | None = None,
        trusted: Callable[[], bool] = lambda: True,
        observe: Callable[[CalibratedEpoch, bool], CalibratedEpoch] = lambda epoch, _: epoch,
        columns: Callable[[], Sequence[str]] = tuple,
        on_lost: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.name = name
        self.calibrator = calibrator
        self.dropped = 0  # epochs whose calibration was deferred
        self.caught_up = 0
        self.lost = 0  # epochs that were taken and not handed over to be kept
        self.next_number = first
        self._readings = readings
        self._thermometers = list(thermometers)
        self._keeper = keeper
        self._clock = clock
        self._patience_s = min(_PATIENCE_S, 0.5 * period_s) if patience_s is None else patience_s
        self._depth = depth
        self._trusted = trusted
        self._observe = observe
        self._columns = columns
        self._on_lost = on_lost
        self._items: deque[AcquiredEpoch] = deque()
        self._amended: deque[CalibratedEpoch] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._busy_since: dict[str, float] = {}
        self._threads = [
            threading.Thread(target=self._calibrate_all, name=f"calibrate {name}", daemon=True),
            threading.Thread(target=self._keep_all, name=f"keep {name}", daemon=True),
        ]

    def start(self) -> None:
        """Start both threads."""
        for thread in self._threads:
            thread.start()

    def submit(self, frame: Frame) -> None:
        """Take a frame over; returns at once."""
        with self._changed:
            if len(self._items) > 2 * self._depth and self._is_full():
                self._lose("it cannot be kept fast enough")
                return
            self._items.append(AcquiredEpoch(self.next_number, frame, self._trusted()))
            self.next_number += 1
            self._changed.notify_all()

    def _is_full(self) -> bool:
        """Whether no frame more may wait: a machine that stalls for seconds costs none."""
        frames = [i.frame for i in self._items]
        held = sum(
            len(f.encoded or b"") + (0 if f.image is None else f.image.nbytes) for f in frames
        )
        return len(frames) > _MOST_WAITING or held > _MOST_BYTES

    def _lose(self, why: str) -> None:
        self.lost += 1
        self._on_lost(f"camera {self.name}: {why}")

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until nothing need be deferred for one more epoch: for what can be replayed."""
        with self._changed:
            return self._changed.wait_for(lambda: len(self._items) < self._depth, timeout_s)

    def drain(self, timeout_s: float) -> bool:
        """Wait until all that was submitted is calibrated and handed over to be kept."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._items and not self._amended, timeout_s)

    def stop(self, grace_s: float) -> bool:
        """Finish the current epoch, keep the others as they are; False if that took too long."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        deadline = self._clock.monotonic() + grace_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - self._clock.monotonic()))
        with self._changed:
            while self._items:
                self._items.popleft()
                self._lose("it was still waiting to be kept at the end")
        return not any(thread.is_alive() for thread in self._threads)

    def waiting(self) -> int:
        """How many epochs are on their way."""
        return len(self._items)

    def busy_s(self) -> float:
        """For how long a thread has not finished one thing; 0 if none is busy."""
        now = self._clock.monotonic()
        return max((now - since for since in list(self._busy_since.values())), default=0.0)

    def _calibrate_all(self) -> None:
        while (item := self._next_to_calibrate()) is not None:
            self._busy_since["calibrate"] = self._clock.monotonic()
            if isinstance(item, AcquiredEpoch):
                self._calibrate(item)
            else:
                result = self._safely(item, None)
                with self._changed:
                    self._amended.append(result)
                    self.caught_up += 1
                    self._changed.notify_all()
            self._busy_since.pop("calibrate", None)

    def _next_to_calibrate(self) -> AcquiredEpoch | Epoch | None:
        """The oldest that waits; if there is none, one that was deferred; None at the end."""
        while True:
            with self._changed:
                if self._stopping:
                    return None
                item = next((i for i in self._items if i.state == "waiting"), None)
                if item is not None:
                    item.state = "calibrating"
                    return item
                idle = not self._items and not self._amended
                below = self.next_number
            if idle and self.calibrator is not None:
                old = self._keeper.backlog(below)
                if old is not None:
                    return old
            with self._changed:
                if not self._stopping and not any(i.state == "waiting" for i in self._items):
                    self._changed.wait(_IDLE_S)

    def _calibrate(self, item: AcquiredEpoch) -> None:
        self._pair(item, self._patience_s)
        assert item.epoch is not None
        result = self._safely(item.epoch, item.frame)
        if item.skew_s == item.skew_s:
            result = replace(result, extra={**result.extra, "skew_s": item.skew_s})
        with self._changed:
            if item.state == "dropped":  # it took so long that it was kept without
                self._amended.append(result)
                self.caught_up += 1
            else:
                item.calibrated = result
                item.state = "done"
            self._changed.notify_all()

    def _safely(self, epoch: Epoch, frame: Frame | None) -> CalibratedEpoch:
        """Calibrate from the frame, or from the file that the epoch names."""
        if self.calibrator is None:
            why = failed("not_measured", "no test field is configured for this camera")
            return CalibratedEpoch(epoch, why, {})
        try:
            if frame is None:
                return self._observe(self.calibrator.calibrate(epoch), False)
            return self._observe(calibrate_frame(self.calibrator, epoch, frame), True)
        except Exception as error:
            # one epoch that breaks the program must not end months of acquisition
            log.exception("camera %s: epoch %d was not calibrated", self.name, epoch.number)
            self.calibrator.reset()
            return CalibratedEpoch(epoch, failed("program_error", str(error)), {})

    def _pair(self, item: AcquiredEpoch, patience_s: float) -> None:
        paired = self._readings.around(self._thermometers, item.frame.monotonic, patience_s)
        # a reference that was not read leaves its place empty: no other takes it
        columns = dict.fromkeys(self._columns(), math.nan)
        paired = replace(paired, temperatures={**columns, **paired.temperatures})
        item.epoch = make_epoch(item.number, item.frame, paired)
        item.skew_s = paired.skew_s

    def _keep_all(self) -> None:
        while (item := self._next_to_keep()) is not None:
            self._busy_since["keep"] = self._clock.monotonic()
            try:
                if isinstance(item, CalibratedEpoch):
                    self._keeper.amend(item)
                else:
                    if item.epoch is None:
                        self._pair(item, 0.0)
                    self._keeper.keep(item)
            except Exception as error:
                log.exception("camera %s: an epoch was not kept", self.name)
                if isinstance(item, AcquiredEpoch):
                    self._lose(f"epoch {item.number}: {error}")
            self._busy_since.pop("keep", None)

    def _next_to_keep(self) -> AcquiredEpoch | CalibratedEpoch | None:
        with self._changed:
            while True:
                if self._amended:
                    self._changed.notify_all()
                    return self._amended.popleft()
                if self._items:
                    first = self._items[0]
                    deferred = len(self._items) > self._depth
                    deferred |= self._stopping and first.state == "waiting"
                    if deferred and first.state != "done":
                        first.state = "dropped"
                        self.dropped += 1
                    if first.state in ("done", "dropped"):
                        self._changed.notify_all()
                        return self._items.popleft()
                elif self._stopping and not self._threads[0].is_alive():
                    return None
                self._changed.wait(_IDLE_S)


_BLURRED_PX = 3.0
_SATURATED = 0.02
_LOW_CONTRAST = 30.0
_NAMED = 5

_RULES: tuple[tuple[str, Callable[[float], bool], str], ...] = (
    ("saturation", lambda v: v > _SATURATED, "saturated: less light, or a shorter exposure"),
    ("blur", lambda v: v > _BLURRED_PX, "blurred: focus, or hold the camera still"),
    ("contrast", lambda v: abs(v) < _LOW_CONTRAST, "of low contrast: more light"),
)


@dataclass(frozen=True, slots=True)
class FrameCheck:
    """What was found, sentence by sentence; failed: why no series can begin, empty if one can."""

    found: tuple[str, ...]
    failed: str = ""


def check_frame(name: str, calibrator: EpochCalibrator, frame: Frame) -> FrameCheck:
    """Measure and adjust a frame, and say what a person can mend."""
    nothing = PairedReadings(float("nan"), {}, float("nan"))
    calibrated = calibrate_frame(calibrator, make_epoch(1, frame, nothing), frame)
    result, seen = calibrated.adjustment, calibrated.epoch.observations
    field = calibrator.testfield
    found: list[str] = []
    if seen is not None and len(seen):
        blur = calibrated.extra.get("blur_px")
        blurred = "" if blur is None else f", blur {blur:.2f} px"
        found.append(f"{name}: {len(seen)} of {len(field)} targets{blurred}")
        found += _remarks(field.names, seen.targets, seen.quality)
    if not result.ok:
        return FrameCheck(tuple(found), f"{result.status}: {result.reason}")
    c, sd = result.values[0], result.sd[0]
    found.append(f"{name}: sigma0 {result.sigma0:.2f}, c {c:.5f} ± {sd:.5f} mm")
    return FrameCheck(tuple(found))


def _remarks(names: tuple[str, ...], targets: Any, quality: Mapping[str, Any]) -> Iterator[str]:
    for key, bad, words in _RULES:
        rows = [int(t) for t, v in zip(targets, quality.get(key, ()), strict=False) if bad(v)]
        if rows:
            shown = ", ".join(names[row] for row in rows[:_NAMED])
            more = f" and {len(rows) - _NAMED} more" if len(rows) > _NAMED else ""
            yield f"  target {shown}{more}: {words}"
