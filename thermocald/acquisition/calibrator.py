"""The calibrator of one camera and one test field, which measures and adjusts epochs.

It passes on from epoch to epoch where the targets are, and the orientation to start from. Without
these, or if the adjustment fails from them (a knock), it starts anew. In a recording it starts anew
every 200 epochs, so that these blocks are independent and give the same bits in any process.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any, Self
from zlib import crc32

import numpy as np

from thermocald.errors import ImageError
from thermocald.parallel import in_order
from thermocald.photogrammetry.camera.camera_model import CameraSpec
from thermocald.photogrammetry.epoch.adjustment import (
    Adjustment,
    AdjustmentSettings,
    adjust,
    cold_start,
    failed,
    pose_only,
)
from thermocald.photogrammetry.frame.measurement import frame_figures
from thermocald.photogrammetry.frame.tracking import Tracker
from thermocald.photogrammetry.targets.image_file import EncodedImage

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.camera.camera_model import (
        InteriorOrientation,
        Sensor,
    )
    from thermocald.photogrammetry.field.testfield import Observations, TestField

_USUAL = AdjustmentSettings()
_WRONG_START = 5.0  # times the last sigma0; more: the camera has been knocked


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedEpoch:
    """An epoch with its observations and its adjustment.

    extra: columns for the store, from `measurement.frame_figures`.
    """

    epoch: Epoch
    adjustment: Adjustment
    extra: dict[str, float]


class EpochCalibrator:
    """A calibrator as a pipeline calls it: this module's, or one that predicts the camera.

    The same frame again, or the same image points, is no new observation: the epoch has the status
    `repeated_frame`, and no observations.
    """

    testfield: TestField
    seen: tuple[float | None, int] = None, 0
    """Fingerprint and number of the last epoch with observations."""

    def calibrate(
        self,
        epoch: Epoch,
        image: NDArray[Any] | EncodedImage | None = None,
        fingerprint: int | None = None,
    ) -> CalibratedEpoch:
        """Calibrate an epoch from its observations, or from its frame; never raises for bad data.

        image: the frame as grey values or encoded, with its fingerprint; by default the file that
        the epoch names.
        """
        raise NotImplementedError

    def reset(self) -> None:
        """Forget the last epoch."""
        self.seen = None, 0

    def _look(
        self, epoch: Epoch, image: NDArray[Any] | EncodedImage | None, fingerprint: int | None
    ) -> tuple[NDArray[Any] | EncodedImage | None, int | None]:
        """Return the image to be measured, None if there is none, and the epoch's fingerprint.

        Raises ImageError.
        """
        if (points := epoch.observations) is not None:
            return None, crc32(points.targets.tobytes() + points.points.tobytes())
        if image is None and epoch.frame is not None:
            image = EncodedImage(epoch.frame)
            fingerprint = crc32(image.data)
        return image, fingerprint

    def _repeated(self, epoch: Epoch, fingerprint: int | None) -> CalibratedEpoch | None:
        """Return the result of an epoch that repeats the last one, None for any other."""
        if fingerprint is None or fingerprint != self.seen[0]:
            return None
        why = f"it repeats the frame of epoch {self.seen[1]}, and is no new observation"
        bad = failed("repeated_frame", why)
        return CalibratedEpoch(replace(epoch, observations=None), bad, {})

    def _remember(self, epoch: Epoch, fingerprint: int | None) -> None:
        """Remember an epoch with observations, unless a later one was calibrated before it."""
        if epoch.number >= self.seen[1]:
            self.seen = fingerprint, epoch.number


@dataclass(eq=False)
class Calibrator(EpochCalibrator):
    """Measures and adjusts the epochs of one camera, one after the other.

    nominal_c: mm, from the data sheet; interior: an earlier calibration, for the start and for the
    parameters held fixed; sigma_floor_px: added in quadrature to the sigmas of image points.
    """

    sensor: Sensor
    testfield: TestField
    settings: AdjustmentSettings = _USUAL
    nominal_c: float | None = None
    interior: InteriorOrientation | None = None
    sigma_floor_px: float = 0.0

    def __post_init__(self) -> None:
        camera = CameraSpec("", self.sensor, self.nominal_c, self.interior)
        self._tracker = Tracker(self.testfield, camera)
        self.reset()

    @classmethod
    def of_recording(cls, recording: Any, settings: AdjustmentSettings = _USUAL) -> Self:
        """Return the calibrator of a recording (store.recording.reader)."""
        camera: CameraSpec = recording.head.camera
        given = camera.principal_distance, camera.interior
        return cls(camera.sensor, recording.testfield, settings, *given)

    def reset(self) -> None:
        """Forget the last epoch, and where the camera was."""
        super().reset()
        self._last: Adjustment | None = None
        self._usual = float("nan")
        self._tracker.reset()

    def begin_block(self, before: Epoch | None) -> None:
        """Start anew, knowing of the epoch before only whether the next one repeats it."""
        self.reset()
        if before is not None:
            self.calibrate(before)
            seen = self.seen
            self.reset()
            self.seen = seen

    def calibrate(
        self,
        epoch: Epoch,
        image: NDArray[Any] | EncodedImage | None = None,
        fingerprint: int | None = None,
    ) -> CalibratedEpoch:
        """Measure the epoch's frame unless it has observations already, and adjust.

        Never raises for bad data: an epoch without a result has a status and a reason.
        """
        extra: dict[str, float] = {}
        try:
            image, fingerprint = self._look(epoch, image, fingerprint)
            if repeated := self._repeated(epoch, fingerprint):
                return repeated
            if image is not None:
                measured = self._tracker.measure(image)
                seen = measured.observations
                epoch = replace(epoch, observations=seen)
                extra = frame_figures(seen, self.sensor)
                if not measured.status.ok:
                    bad = failed(measured.status.word, measured.status.reason, seen)
                    return CalibratedEpoch(epoch, bad, extra)
        except ImageError as error:
            return CalibratedEpoch(epoch, failed("bad_frame", str(error)), extra)
        if epoch.observations is None:
            why = epoch.note or "neither a frame nor observations"
            return CalibratedEpoch(epoch, failed("no_frame", why), extra)
        if not len(epoch.observations):
            bad = failed("no_observations", "no target was measured", epoch.observations)
            return CalibratedEpoch(epoch, bad, extra)
        self._remember(epoch, fingerprint)
        return CalibratedEpoch(epoch, self.adjust(epoch.observations), extra)

    def weighed(self, observations: Observations) -> Observations:
        """Return the observations with the sigmas used in the adjustment."""
        if self.sigma_floor_px == 0:
            return observations
        return replace(observations, sigmas=np.hypot(observations.sigmas, self.sigma_floor_px))

    def adjust(self, observations: Observations) -> Adjustment:
        """Adjust one epoch's observations, from the last epoch's orientation if it fits."""
        observations = self.weighed(observations)
        last = self._last
        if last is not None and last.interior is not None and last.exterior is not None:
            start = last.interior, last.exterior
            result = adjust(self.sensor, self.testfield, observations, *start, self.settings)
            lost = {"no_convergence", "too_many_rejected"}
            if result.status not in lost and not result.sigma0 > _WRONG_START * self._usual:
                return self._keep(result)
        seen = self.sensor, self.testfield, observations
        if not self.settings.free and self.interior is not None:
            return self._keep(pose_only(*seen, self.interior, self.settings))
        return self._keep(cold_start(*seen, self.settings, self.nominal_c, self.interior))

    def _keep(self, result: Adjustment) -> Adjustment:
        if result.ok:
            self._last = result
            self._usual = result.sigma0
        return result


EPOCHS_OF_A_BLOCK = 200


def calibrated_epochs(
    calibrator: Calibrator, epochs: Iterable[Epoch], jobs: int = 1, before: Epoch | None = None
) -> Iterator[CalibratedEpoch]:
    """Yield calibrated epochs in their order.

    calibrator: one that has not calibrated an epoch yet; jobs: number of processes; before: the
    epoch before the first one. Never raises for bad data: an epoch without a result has a status
    and a reason.
    """
    blocks = _blocks(epochs, before)
    if jobs <= 1:
        for last, block in blocks:
            calibrator.begin_block(last)
            yield from map(calibrator.calibrate, block)
        return
    for done in in_order(_calibrate_block, calibrator, blocks, jobs):
        yield from done


def _blocks(
    epochs: Iterable[Epoch], before: Epoch | None
) -> Iterator[tuple[Epoch | None, list[Epoch]]]:
    """Yield blocks of epochs, each with the epoch before it."""
    source = iter(epochs)
    while block := list(islice(source, EPOCHS_OF_A_BLOCK)):
        yield before, block
        before = block[-1]


def _calibrate_block(
    calibrator: Calibrator, block: tuple[Epoch | None, list[Epoch]]
) -> list[CalibratedEpoch]:
    """Calibrate a block anew with the calibrator of this process."""
    calibrator.begin_block(block[0])
    return [calibrator.calibrate(epoch) for epoch in block[1]]
