"""A recording played back as a camera and as a thermometer.

    cameras:
      - {name: replayed, driver: replay, recording: ../recordings/M1}
    thermometers:
      - {name: replayed, driver: replay, recording: ../recordings/M1}

`loop: true` starts again after the last epoch, with times that continue. Otherwise the device
raises DeviceFinished. An epoch without a frame, or without a temperature, raises BadReading.
`after`, s UTC, leaves out the frames up to that time.

Frames retain their recorded time: `utc` is the recorded time, `monotonic` the same instant on the
clock's monotonic scale; `sequence` is the epoch's number. A JPEG, or a file that is no image, is
delivered as recorded, in `encoded`. A recording of observations delivers frames with `observations`
and no image.
"""

from __future__ import annotations

import os
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thermocald.errors import (
    BadReading,
    DataError,
    DeviceFinished,
    DeviceNotFound,
    ImageError,
    PermanentDeviceError,
)
from thermocald.hal import Camera, Device, DriverOptions, Frame, Reading, Thermometer
from thermocald_drivers import support

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from thermocald.epoch import Epoch
    from thermocald.store.recording.reader import Recording


@contextmanager
def _permanent_errors() -> Iterator[None]:
    """Raise an error of a file as a PermanentDeviceError: reading it again does not help."""
    try:
        yield
    except (DataError, OSError) as error:
        raise PermanentDeviceError(str(error)) from error


class _Replay(Device):
    """The epochs of a recording, in order; re-opening continues with the next epoch."""

    recorded = True

    class Options(DriverOptions):
        recording: support.Text | Path
        loop: bool = False
        after: float | None = None

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._path = Path(self.options.recording)
        self.where = str(self._path)
        self._recording: Recording | None = None
        self._epochs: Iterator[Epoch] = iter(())
        self._shift_s = 0.0

    def open(self) -> None:
        if not os.path.isdir(self._path):
            raise DeviceNotFound(f"{self._path}: there is no such recording")
        if self._recording is None:
            from thermocald.store.recording.reader import open_recording

            with _permanent_errors():
                self._recording = open_recording(self._path)
            after, every = self.options.after, self._recording.iter_epochs()
            self._epochs = every if after is None else (e for e in every if e.frame_time > after)
        self.handle = self._recording

    def identity(self) -> Mapping[str, str]:
        if self._recording is None:
            return {"name": "replay"}
        head = self._recording.head
        return {"name": head.camera.name, "recording": head.name, "series": head.series}

    def _next(self) -> Epoch:
        recording: Recording = self.opened()
        with _permanent_errors():
            epoch = next(self._epochs, None)
        if epoch is None and self.options.loop:
            times = recording.columns.frame_time
            self._shift_s += float(times[-1] - times[0]) + recording.head.interval
            self._epochs = recording.iter_epochs()
            epoch = next(self._epochs)
        if epoch is None:
            raise DeviceFinished(f"{self._path}: the recording has ended")
        return epoch

    def _times(self, recorded: float) -> tuple[float, float]:
        """Convert a recorded UTC time to (monotonic, utc)."""
        utc = recorded + self._shift_s
        return utc - self.clock.utc() + self.clock.monotonic(), utc


class ReplayCamera(_Replay, Camera):
    """A camera that delivers the frames or observations of a recording."""

    def frame_size(self) -> tuple[int, int] | None:
        from thermocald.store.recording.head import read_head

        with suppress(DataError, OSError):  # `open` reports it
            sensor = read_head(self._path).camera.sensor
            return sensor.width, sensor.height
        return None

    def capture(self) -> Frame:
        epoch = self._next()
        monotonic, utc = self._times(epoch.frame_time)
        observations = image = encoded = None
        if epoch.observations is not None:
            from thermocald.photogrammetry.field.testfield import observations_to_lists

            observations = observations_to_lists(epoch.observations, self.handle.testfield)
        elif epoch.frame is None:
            raise BadReading(f"{self._path}: epoch {epoch.number} has no frame")
        if epoch.frame is not None:
            from thermocald.photogrammetry.targets.image_file import decode_grey

            try:
                encoded = epoch.frame.read_bytes()
                if not encoded.startswith(b"\xff\xd8"):
                    image, encoded = decode_grey(epoch.frame), None
            except OSError as error:
                raise BadReading(f"{epoch.frame}: cannot be read: {error.strerror}") from error
            except ImageError:
                pass  # delivered as recorded, so that its epoch is a `bad_frame`
        return Frame(
            image, monotonic, utc, None, epoch.number, encoded=encoded, observations=observations
        )


class ReplayThermometer(_Replay, Thermometer):
    """A thermometer that delivers the readings of all channels of a recording."""

    def read(self) -> Reading:
        epoch = self._next()
        values = {name: t for name, t in epoch.temperatures.items() if t == t}  # not NaN
        if not values:
            raise BadReading(f"{self._path}: epoch {epoch.number} has no temperature")
        monotonic, utc = self._times(epoch.temperature_time)
        return Reading(values, monotonic, utc)
