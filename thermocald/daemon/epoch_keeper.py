"""Stores a camera's epochs: first the frame, then the row; then passes them on to the outputs."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from thermocald.daemon.plan import series_head
from thermocald.daemon.store_guard import Row
from thermocald.errors import ImageError, StoreError
from thermocald.names import UNEVENTFUL
from thermocald.photogrammetry.camera.camera_model import PARAMETER_NAMES
from thermocald.store.series import NOT_CALIBRATED, EpochResult, StoredSeries

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.acquisition.frame_folder import FrameFolder
    from thermocald.acquisition.pipeline import AcquiredEpoch
    from thermocald.daemon.plan import CameraPlan
    from thermocald.daemon.store_guard import StoreGuard
    from thermocald.epoch import Epoch
    from thermocald.store.series import StoredEpoch


log = logging.getLogger(__name__)

_CATCH_UP_BATCH = 200


class EpochKeeper:
    """The `Keeper` of a camera's pipeline.

    on_kept: called for each epoch after it was stored (or refused), with its row for the outputs;
    identity: called for the camera's identity when the series begins.
    """

    def __init__(
        self,
        plan: CameraPlan,
        guard: StoreGuard,
        frames: FrameFolder,
        on_kept: Callable[[AcquiredEpoch, dict[str, Any]], None],
        identity: Callable[[], Mapping[str, Any]] = dict,
        *,
        start: str = "",
    ) -> None:
        self.plan = plan
        self.stored = 0
        self.kept_frames = 0
        self._guard = guard
        self._frames = frames
        self._on_kept = on_kept
        self._identity = identity
        self._start = start
        self._series = guard.find(plan.name, plan.series)
        self._backlog: list[Epoch] = []
        self._searched_to = 0
        self._uncorrected = ""
        self._strange: list[str] = []  # channels that are no columns of the series

    @property
    def series(self) -> StoredSeries | None:
        """The series in the store; None before its first epoch."""
        if self._series is not None:
            try:
                self._series = self._guard.series(self._series)
            except StoreError as error:
                log.debug("the series cannot be read now: %s", error)
        return self._series

    @property
    def first_number(self) -> int:
        """The number of the next epoch."""
        series = self.series
        return 1 if series is None else self._guard.last_epoch(series) + 1

    def record(self, utc: float, kind: str, text: str, epoch: int | None = None) -> None:
        """Store an event of the series."""
        series = self.series
        series_id = None if series is None else series.id or None
        self._guard.event(utc, kind, text, series=series_id, epoch=epoch)

    def read(self, first: int, last: int | None = None, **how: bool) -> list[StoredEpoch]:
        """Read some epochs of the series; if they cannot be read, log it and return none."""
        series = self.series
        if series is None:
            return []
        try:
            return self._guard.epochs(series, first, last, **how)
        except StoreError as error:
            log.warning("earlier epochs cannot be read: %s", error)
            return []

    def last_seen(self) -> tuple[float | None, int]:
        """Return the fingerprint of the last stored frame if it was measured, and its epoch."""
        for stored in self.read(self.first_number - 1, details=False):
            if stored.result.n_observations or stored.result.status == "repeated_frame":
                return stored.extra.get("fingerprint"), stored.epoch.number
        return None, 0

    def keep(self, acquired: AcquiredEpoch) -> None:
        """Store an epoch; a deferred calibration is done later from its frame."""
        assert acquired.epoch is not None
        calibrated = acquired.calibrated
        series = self._begin_series(acquired)
        epoch = acquired.epoch if calibrated is None else calibrated.epoch
        deferred = calibrated is None and self.plan.calibrator is not None
        eventful = calibrated is not None and (
            calibrated.adjustment.status not in UNEVENTFUL or "event" in calibrated.extra
        )
        result = None
        extra = {
            key: value
            for name, value in acquired.frame.settings.items()
            if (key := f"camera_{name}") not in epoch.temperatures  # a channel may have this name
        }
        if (mark := acquired.frame.fingerprint) is not None:
            extra["fingerprint"] = float(mark)
        path = None
        if self._frames.wanted(epoch.number, eventful) or deferred:
            path = self._frames.keep(self.plan.name, self.plan.series, epoch.number, acquired.frame)
            self.kept_frames += path is not None
        if calibrated is not None:
            result = EpochResult.from_adjustment(calibrated.adjustment)
            extra |= calibrated.extra
            self._correct(path, calibrated)
        elif deferred and path is None:
            result = EpochResult("frame_not_kept", "calibration deferred, but no frame stored")
        elif deferred:
            result = EpochResult(NOT_CALIBRATED, "calibrated later, when there is time")
        strange = [name for name in epoch.temperatures if name not in series.head.channels]
        if strange and not self._strange:
            text = (
                f"camera {self.plan.name}: series {self.plan.series} began without "
                f"{', '.join(strange)}: no analysis of it shows them; begin another series"
            )
            log.warning(text, extra={"event": "channel_unknown"})
            self.record(epoch.frame_time, "channel_unknown", text, epoch.number)
        self._strange = strange
        epoch = replace(epoch, frame=path)
        values = result_row(self.plan, epoch, result, extra)
        stored = self._guard.append(Row(series, epoch, result, extra, acquired.clock_trusted))
        self.stored += stored
        self._on_kept(acquired, {**values, "stored": stored, "lost": self._guard.lost})

    def amend(self, calibrated: CalibratedEpoch) -> None:
        """Store a deferred calibration; delete a frame that was stored only for it."""
        if self._series is None:
            return
        epoch = calibrated.epoch
        result = EpochResult.from_adjustment(calibrated.adjustment)
        try:
            self._guard.amend(
                self._series, epoch.number, result, epoch.observations, calibrated.extra
            )
        except StoreError as error:
            # that the store is away was logged once
            level = logging.DEBUG if self._guard.away else logging.WARNING
            log.log(level, "the calibration of epoch %d waits: %s", epoch.number, error)
            self._searched_to = min(self._searched_to, epoch.number - 1)
            return
        failed = calibrated.adjustment.status not in UNEVENTFUL
        frame = next((s.epoch.frame for s in self.read(epoch.number, epoch.number)), None)
        if frame is not None and not self._frames.wanted(epoch.number, failed):
            self._frames.delete(frame)
            self.kept_frames -= 1
        else:
            self._correct(frame, calibrated)

    def _correct(self, frame: Path | None, calibrated: CalibratedEpoch) -> None:
        """Store a frame again, as a camera without drift would take it; log a failure once."""
        if frame is None or self.plan.corrector is None:
            return
        try:
            encoded = (self._frames.root / frame).read_bytes()
            jpeg = self.plan.corrector.correct(encoded, calibrated)
        except (ImageError, OSError) as error:
            if str(error) != self._uncorrected:
                log.warning("camera %s: frames cannot be corrected: %s", self.plan.name, error)
            self._uncorrected = str(error)
            return
        self._uncorrected = ""
        self._frames.keep_corrected(frame, jpeg)

    def backlog(self, below: int) -> Epoch | None:
        """Return the oldest epoch that was stored without calibration and still has its frame.

        A call searches at most 200 epochs, each once: all of a year take minutes, in which new
        epochs would wait for their calibration.
        """
        series, first = self.series, self._searched_to + 1
        if series is not None and not self._backlog and first < below:
            try:
                end = min(below - 1, self._guard.last_epoch(series, waiting=False))
                # not tried again if they cannot be read: a damaged row stays damaged
                self._searched_to = max(self._searched_to, min(end, first + _CATCH_UP_BATCH - 1))
                for stored in self._guard.epochs(series, first, self._searched_to, details=False):
                    frame = stored.epoch.frame
                    if stored.result.status == NOT_CALIBRATED and frame is not None:
                        path = self._frames.root / frame
                        if path.is_file():
                            self._backlog.append(replace(stored.epoch, frame=path))
            except StoreError as error:
                log.warning("epochs with a deferred calibration cannot be read: %s", error)
        return self._backlog.pop(0) if self._backlog else None

    def _begin_series(self, acquired: AcquiredEpoch) -> StoredSeries:
        """Return the series; the store creates it with its first row, when it can be written."""
        if self._series is None:
            assert acquired.epoch is not None
            channels = acquired.epoch.temperatures
            head, field, settings = series_head(self.plan, acquired.frame, channels)
            utc = acquired.frame.utc
            self._series = StoredSeries(
                0, head, field, self._start, self._identity(), settings, utc
            )
            text = f"camera {self.plan.name}: series {self.plan.series} begins"
            self.record(utc, "series_begun", text, acquired.number)
        return self._series


def result_row(
    plan: CameraPlan, epoch: Epoch, result: EpochResult | None, extra: Mapping[str, float]
) -> dict[str, Any]:
    """Return an epoch's row for outputs: the CSV export's columns, `device`, `series`, channels.

    temperature: °C, the reference thermometer's at `temperature_time`; missing numbers are NaN.
    """
    reference = next(iter(epoch.temperatures.values()), math.nan)
    row: dict[str, Any] = {
        "device": plan.name,
        "series": plan.series,
        "epoch": epoch.number,
        "frame_time": epoch.frame_time,
        "temperature_time": epoch.temperature_time,
        **epoch.temperatures,
        "temperature": reference,
    }
    kept = result or EpochResult(NOT_CALIBRATED)
    row.update(zip(PARAMETER_NAMES, kept.values.tolist(), strict=True))
    row.update(zip((f"sd_{n}" for n in PARAMETER_NAMES), kept.sd.tolist(), strict=True))
    row.update(
        sigma0=kept.sigma0,
        n_observations=kept.n_observations,
        n_rejected=len(kept.rejected),
        status=kept.status,
        reason=kept.reason,
        **extra,
    )
    return row
