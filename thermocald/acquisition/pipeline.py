"""From a camera and its thermometers to calibrated epochs, one tick after the other.

This is the daemon's tick without its threads: what a virtual clock, a desk and a test want. A
camera that warms up for 25 minutes:

    clock = VirtualClock()
    camera = open_device("camera", "mock", {"seed": 1}, clock)
    thermometer = open_device("thermometer", "mock", {"seed": 2}, clock)
    with camera, thermometer:
        calibrator = Calibrator(camera.model.sensor, camera.field, nominal_c=3.04)
        pipeline = Pipeline(camera, {"temperature": thermometer}, calibrator, clock, period_s=10.0)
        for calibrated, frame in pipeline.run(150):
            ...                                    # or sinks=[f]: f(calibrated, frame)

`calibrated.epoch` has the times and temperatures, `calibrated.adjustment` the result or the reason
why there is none. A tick in which the camera fails for the moment gives no epoch and is counted in
`pipeline.lost`; one in which a thermometer fails gives an epoch without its temperature.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from thermocald.acquisition.calibrator import CalibratedEpoch
from thermocald.acquisition.link import Link
from thermocald.acquisition.pairing import pair_readings
from thermocald.acquisition.scheduler import Schedule
from thermocald.epoch import Epoch
from thermocald.errors import DataError
from thermocald.photogrammetry.epoch.adjustment import failed
from thermocald.photogrammetry.field.exchange import observations_from_lists
from thermocald.photogrammetry.targets.image_file import EncodedImage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from thermocald.acquisition.calibrator import Calibrator
    from thermocald.acquisition.pairing import PairedReadings
    from thermocald.hal import Camera, Clock, Frame, Thermometer

    Sink = Callable[[CalibratedEpoch, Frame], None]

__all__ = ["Pipeline", "calibrate_frame", "make_epoch"]


def make_epoch(number: int, frame: Frame, paired: PairedReadings) -> Epoch:
    """The epoch of a frame and its readings; the picture is not measured yet."""
    return Epoch(number, frame.utc, paired.utc, paired.temperatures)


def calibrate_frame(calibrator: Calibrator, epoch: Epoch, frame: Frame) -> CalibratedEpoch:
    """Measure and adjust; a frame that is not an image gives the status `bad_frame`, no error."""
    try:
        if (lists := frame.metadata.get("observations")) is not None:
            seen = observations_from_lists(lists, calibrator.testfield)
            return calibrator.calibrate(replace(epoch, observations=seen))
        image = EncodedImage(frame.encoded or b"") if frame.image is None else frame.image
    except DataError as error:
        return CalibratedEpoch(epoch, failed("bad_frame", str(error)), {})
    return calibrator.calibrate(epoch, image)


class Pipeline:
    """One camera's ticks: capture, read, calibrate, hand over; the devices must be open.

    calibrator: None if epochs are only acquired. first: number of the first epoch.
    """

    def __init__(
        self,
        camera: Camera,
        thermometers: Mapping[str, Thermometer],
        calibrator: Calibrator | None,
        clock: Clock,
        *,
        period_s: float = 10.0,
        sinks: Sequence[Sink] = (),
        first: int = 1,
    ) -> None:
        self.lost = 0
        self._camera = camera
        self._thermometers = dict(thermometers)
        self._camera_link = Link("camera", "camera", camera, clock, period_s=period_s, is_open=True)
        self._thermometer_links = {
            name: Link("thermometer", name, device, clock, period_s=period_s, is_open=True)
            for name, device in thermometers.items()
        }
        self._calibrator = calibrator
        self._schedule = Schedule(clock, period_s)
        self._sinks = list(sinks)
        self._number = first

    def run(self, epochs: int | None = None) -> Iterator[tuple[CalibratedEpoch, Frame]]:
        """Run until so many epochs are there (None: for ever); yields each after the sinks had it.

        A recording that has been played ends the run; what else is not recoverable is raised, as a
        PermanentDeviceError.
        """
        done = 0
        while epochs is None or done < epochs:
            if self._schedule.wait() is None:
                return
            frame = self._camera_link.call(self._camera.capture)
            if frame is None:
                if self._camera_link.state == "finished":
                    return
                if self._camera_link.error is not None:
                    raise self._camera_link.error
                self.lost += 1
                continue
            readings = {
                name: self._thermometer_links[name].call(device.read)
                for name, device in self._thermometers.items()
            }
            epoch = make_epoch(self._number, frame, pair_readings(readings, frame.monotonic))
            calibrated = self._calibrate(epoch, frame)
            self._number += 1
            done += 1
            for sink in self._sinks:
                sink(calibrated, frame)
            yield calibrated, frame

    def _calibrate(self, epoch: Epoch, frame: Frame) -> CalibratedEpoch:
        if self._calibrator is None:
            why = failed("not_measured", "no test field is configured for this camera")
            return CalibratedEpoch(epoch, why, {})
        calibrated = calibrate_frame(self._calibrator, epoch, frame)
        skew = epoch.temperature_time - epoch.frame_time
        if math.isfinite(skew):
            calibrated = replace(calibrated, extra={**calibrated.extra, "skew_s": skew})
        return calibrated
