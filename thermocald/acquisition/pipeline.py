"""One camera's frames on their way to the store, in bounded memory.

    submit (the camera's thread) ─► waiting ─► calibrated ─► stored, in the order of their numbers
                                      └─► too many wait: stored uncalibrated, with the frame, and
                                          calibrated when there is time

Calibration may be deferred, acquisition may not. One thread calibrates and another one stores, so
that a slow disk or a slow adjustment never delays the camera. `check_frame` measures one frame
before a series begins.
"""

from __future__ import annotations

import logging
import math
import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Protocol

from thermocald.acquisition.calibrator import CalibratedEpoch, EpochCalibrator
from thermocald.epoch import Epoch
from thermocald.errors import DataError
from thermocald.numbers import listed
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.field.testfield import observations_from_lists
from thermocald.photogrammetry.targets.image_file import EncodedImage

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from thermocald.acquisition.thermometers import Thermometers
    from thermocald.hal import Clock, Frame


log = logging.getLogger(__name__)

_DEPTH = 3  # epochs that may wait for their calibration
_MOST_BYTES = 64_000_000  # of the frames that wait to be stored
_MOST_WAITING = 200
PATIENCE_S = 2.0
"""How long a frame waits for a reading at most; at most half a period."""
_IDLE_S = 0.5


def calibrate_frame(calibrator: EpochCalibrator, epoch: Epoch, frame: Frame) -> CalibratedEpoch:
    """Measure and adjust a frame; one that is not an image gives the status `bad_frame`."""
    try:
        if frame.observations is not None:
            if len(calibrator.testfield):  # else it is a gauge, without control points
                seen = observations_from_lists(frame.observations, calibrator.testfield)
                epoch = replace(epoch, observations=seen)
            return calibrator.calibrate(epoch)
        image = EncodedImage(frame.encoded or b"") if frame.image is None else frame.image
    except DataError as error:
        return CalibratedEpoch(epoch, failed("bad_frame", str(error)), {})
    return calibrator.calibrate(epoch, image, frame.fingerprint)


@dataclass(eq=False)
class AcquiredEpoch:
    """An epoch in the pipeline: its frame, and the results so far.

    calibrated: None until the epoch is calibrated, and if its calibration was deferred.
    """

    number: int
    frame: Frame
    clock_trusted: bool
    epoch: Epoch | None = None
    skew_s: float = math.nan
    calibrated: CalibratedEpoch | None = None
    state: Literal["waiting", "calibrating", "done", "dropped"] = "waiting"


class Keeper(Protocol):
    """The store of a pipeline; one thread calls each method."""

    def observe(self, calibrated: CalibratedEpoch, in_order: bool) -> CalibratedEpoch:
        """Return the epoch to be stored; in_order: it is no deferred one."""

    def keep(self, acquired: AcquiredEpoch) -> None:
        """Store an epoch, in the order of the numbers; `acquired.epoch` is set."""

    def amend(self, calibrated: CalibratedEpoch) -> None:
        """Store the calibration of an epoch that was stored uncalibrated."""

    def backlog(self, below: int) -> Epoch | None:
        """Return an uncalibrated epoch with a number below `below`, and with its frame's path."""

    def lose(self, why: str) -> None:
        """Count an acquired epoch that was not stored."""


@dataclass(eq=False)
class Pipeline:
    """The queue of one camera, with a thread that calibrates and one that stores.

    calibrator: None if epochs are only acquired; names: of the camera's thermometers, the reference
    first; patience_s: how long to wait for a reading that is being taken.
    """

    name: str
    calibrator: EpochCalibrator | None
    thermometers: Thermometers
    names: Sequence[str]
    keeper: Keeper
    clock: Clock
    next_number: int = 1
    patience_s: float = PATIENCE_S

    def __post_init__(self) -> None:
        self.dropped = 0  # epochs whose calibration was deferred
        self.caught_up = 0
        self.lost = 0  # epochs that were acquired and not handed to the store
        self._items: deque[AcquiredEpoch] = deque()
        self._amended: deque[CalibratedEpoch] = deque()
        self._changed = threading.Condition()
        self._stopping = self._all_calibrated = False
        self._busy_since: dict[str, float] = {}
        self._threads = [
            threading.Thread(target=work, name=f"{what} {self.name}", daemon=True)
            for what, work in (("calibrate", self._calibrate_all), ("store", self._store_all))
        ]

    def start(self) -> None:
        """Start both threads."""
        for thread in self._threads:
            thread.start()

    def submit(self, frame: Frame, clock_trusted: bool = True) -> None:
        """Queue a frame; returns at once."""
        with self._changed:
            if len(self._items) > 2 * _DEPTH:  # a machine may stall for seconds without a loss
                frames = [item.frame for item in self._items]
                held = sum(
                    len(f.encoded or b"") + (0 if f.image is None else f.image.nbytes)
                    for f in frames
                )
                if len(frames) > _MOST_WAITING or held > _MOST_BYTES:
                    self._lose("frames cannot be stored fast enough")
                    return
            self._items.append(AcquiredEpoch(self.next_number, frame, clock_trusted))
            self.next_number += 1
            self._changed.notify_all()

    def _lose(self, why: str) -> None:
        self.lost += 1
        self.keeper.lose(f"camera {self.name}: {why}")

    def wait_for_room(self, timeout_s: float) -> bool:
        """Wait until one more epoch defers no calibration: for replays; False after the timeout."""
        with self._changed:
            return self._changed.wait_for(lambda: len(self._items) < _DEPTH, timeout_s)

    def finish(self, grace_s: float) -> bool:
        """Calibrate and store all waiting epochs, then stop; False if that took too long."""
        with self._changed:
            self._changed.wait_for(lambda: not self._items and not self._amended, 0.5 * grace_s)
        return self.stop(0.5 * grace_s)

    def stop(self, grace_s: float) -> bool:
        """Finish the current epoch, store the others as they are; False if that took too long."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        deadline = self.clock.monotonic() + grace_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - self.clock.monotonic()))
        with self._changed:
            while self._items:
                self._items.popleft()
                self._lose("a frame was still waiting to be stored when the camera was stopped")
        return not any(thread.is_alive() for thread in self._threads)

    def waiting(self) -> int:
        """Return the number of epochs in the queue."""
        return len(self._items)

    def busy_s(self) -> float:
        """Return how long a thread has been busy with one epoch, s; 0 if none is busy."""
        now = self.clock.monotonic()
        return max((now - since for since in list(self._busy_since.values())), default=0.0)

    def _calibrate_all(self) -> None:
        while (item := self._next_to_calibrate()) is not None:
            self._busy_since["calibrate"] = self.clock.monotonic()
            if isinstance(item, AcquiredEpoch):
                result = self._safely(self._pair(item, self.patience_s), item.frame)
                if math.isfinite(item.skew_s):
                    result = replace(result, extra={**result.extra, "skew_s": item.skew_s})
            else:
                result = self._safely(item, None)
            with self._changed:
                if isinstance(item, AcquiredEpoch) and item.state != "dropped":
                    item.calibrated, item.state = result, "done"
                else:  # stored uncalibrated already: it took too long
                    self._amended.append(result)
                    self.caught_up += 1
                self._changed.notify_all()
            self._busy_since.pop("calibrate", None)
        with self._changed:
            self._all_calibrated = True
            self._changed.notify_all()

    def _next_to_calibrate(self) -> AcquiredEpoch | Epoch | None:
        """Return the oldest waiting epoch, else one with a deferred calibration; None to stop."""
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
                old = self.keeper.backlog(below)
                if old is not None:
                    return old
            with self._changed:
                if not self._stopping and not any(i.state == "waiting" for i in self._items):
                    self._changed.wait(_IDLE_S)

    def _safely(self, epoch: Epoch, frame: Frame | None) -> CalibratedEpoch:
        """Calibrate an epoch from its frame, or from the file that it names; never raises."""
        if self.calibrator is None:
            why = failed("not_measured", "no test field is configured for this camera")
            return CalibratedEpoch(epoch, why, {})
        try:
            if frame is None:
                return self.keeper.observe(self.calibrator.calibrate(epoch), False)
            return self.keeper.observe(calibrate_frame(self.calibrator, epoch, frame), True)
        except Exception as error:
            # an epoch with an unexpected error must not stop months of acquisition
            log.exception("camera %s: epoch %d was not calibrated", self.name, epoch.number)
            self.calibrator.reset()
            return CalibratedEpoch(epoch, failed("program_error", str(error)), {})

    def _pair(self, item: AcquiredEpoch, patience_s: float) -> Epoch:
        utc, temperatures, item.skew_s = self.thermometers.around(
            self.names, item.frame.monotonic, patience_s
        )
        item.epoch = Epoch(item.number, item.frame.utc, utc, temperatures)
        return item.epoch

    def _store_all(self) -> None:
        while (item := self._next_to_store()) is not None:
            self._busy_since["store"] = self.clock.monotonic()
            try:
                if isinstance(item, CalibratedEpoch):
                    self.keeper.amend(item)
                else:
                    if item.epoch is None:
                        self._pair(item, 0.0)
                    self.keeper.keep(item)
            except Exception as error:
                log.exception("camera %s: an epoch was not stored", self.name)
                if isinstance(item, AcquiredEpoch):
                    self._lose(f"epoch {item.number}: {error}")
            self._busy_since.pop("store", None)

    def _next_to_store(self) -> AcquiredEpoch | CalibratedEpoch | None:
        with self._changed:
            while True:
                if self._amended:
                    self._changed.notify_all()
                    return self._amended.popleft()
                if self._items:
                    first = self._items[0]
                    deferred = len(self._items) > _DEPTH
                    deferred |= self._stopping and first.state == "waiting"
                    if deferred and first.state != "done":
                        first.state = "dropped"
                        self.dropped += 1
                    if first.state in ("done", "dropped"):
                        self._changed.notify_all()
                        return self._items.popleft()
                elif self._all_calibrated:
                    return None
                self._changed.wait(_IDLE_S)


_BLURRED_PX = 3.0
_SATURATED = 0.02
_LOW_CONTRAST = 30.0
_MOST_NAMES = 5

_RULES: tuple[tuple[str, Callable[[float], bool], str], ...] = (
    ("saturation", lambda v: v > _SATURATED, "saturated; use less light or a shorter exposure"),
    ("blur", lambda v: v > _BLURRED_PX, "blurred; focus, or hold the camera still"),
    ("contrast", lambda v: abs(v) < _LOW_CONTRAST, "low contrast; use more light"),
)


def check_frame(name: str, calibrator: EpochCalibrator, frame: Frame) -> tuple[list[str], str]:
    """Measure and adjust a frame before a series begins.

    Returns lines on the targets and the adjustment, with what the user can improve; and why no
    series can begin, empty if one can.
    """
    calibrated = calibrate_frame(calibrator, Epoch(1, frame.utc, math.nan, {}), frame)
    result, seen = calibrated.adjustment, calibrated.epoch.observations
    names, lines = calibrator.testfield.names, []
    if seen is not None and len(seen):
        blur = calibrated.extra.get("blur_px")
        blurred = "" if blur is None else f", blur {blur:.2f} px"
        lines.append(f"{name}: {len(seen)} of {len(names)} targets{blurred}")
        for key, bad, words in _RULES:
            values = zip(seen.targets, seen.quality.get(key, ()), strict=False)
            if rows := [int(target) for target, value in values if bad(value)]:
                shown = listed([names[row] for row in rows], _MOST_NAMES)
                lines.append(f"  target {shown}: {words}")
    if not result.ok:
        return lines, f"{result.status}: {result.reason}"
    c, sd = result.values[0], result.sd[0]
    return [*lines, f"{name}: sigma0 {result.sigma0:.2f}, c {c:.5f} ± {sd:.5f} mm"], ""
