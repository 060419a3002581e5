"""Frames of a camera at work, resampled to what it would have seen at its model's T₀.

A program that knows one camera then takes the frames of a cold morning and of a hot day alike. The
JPEG has EXIF, and in its comment, as JSON, the camera at T₀ in OpenCV's terms and the pose, with
standard deviations. Those of the camera are the frame's own: what is wrong with the camera of now
goes into the resampled frame as it is.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from thermocald.analysis.camera.undistortion import Maps
from thermocald.errors import ImageError
from thermocald.photogrammetry.camera.camera_model import EOP, EOP_NAMES, IOP
from thermocald.photogrammetry.camera.conversions import opencv_terms
from thermocald.photogrammetry.targets.image_file import (
    EncodedImage,
    has_exif,
    with_comment,
    with_exif,
    with_metadata,
)
from thermocald.result import jsonable, with_sds

if TYPE_CHECKING:
    from collections.abc import Sequence

    from thermocald.acquisition.calibrator import CalibratedEpoch
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera

_QUALITY = 95  # of a JPEG: its losses are below the noise of a camera


class FrameCorrector:
    """Makes the corrected frames of one camera.

    camera: its name; origin (3,) mm: what the pose's coordinates count from.
    """

    def __init__(self, thermal: ThermalCamera, camera: str, origin: Sequence[float]) -> None:
        self.sensor, self.to = thermal.model.sensor, thermal.model.T0
        self._camera, self._origin = camera, list(origin)
        self._steady = thermal.at(self.to, extrapolate=True)
        self._maps: Maps | None = None

    def correct(self, encoded: bytes, calibrated: CalibratedEpoch) -> bytes:
        """Return a frame as the steady camera had seen it: a JPEG.

        encoded: a JPEG or PNG. Raises ImageError for what cannot be decoded or has another size,
        and where the epoch has no camera.
        """
        result = calibrated.adjustment
        if result.interior is None:
            raise ImageError(f"{result.status}: {result.reason}")
        image = EncodedImage(encoded).as_it_is()
        if image.dtype != np.uint8:
            image = (image >> 8).astype(np.uint8)
        sensor = self.sensor
        if image.shape[:2] != (sensor.height, sensor.width):
            raise ImageError(
                f"the frame has {image.shape[1]}×{image.shape[0]} px, the model's camera "
                f"{sensor.width}×{sensor.height}"
            )
        self._maps = self._maps or Maps(self._steady.sensor, self._steady.values, self.to)
        resampled = self._maps.resample(image, result.interior.as_array())
        _, data = cv2.imencode(".jpg", resampled, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        jpeg = with_metadata(data.tobytes(), encoded)
        if not has_exif(jpeg):
            pixels = 1.0 / sensor.pixel_pitch
            when = calibrated.epoch.frame_time
            jpeg = with_exif(jpeg, self._camera, when, self._steady.interior.c, pixels)
        return with_comment(jpeg, json.dumps(self._document(calibrated), allow_nan=False))

    def _document(self, calibrated: CalibratedEpoch) -> dict[str, Any]:
        epoch, result = calibrated.epoch, calibrated.adjustment
        pose = None
        if result.exterior is not None:
            sd = np.sqrt(np.diag(result.covariance)[EOP])
            six = with_sds(EOP_NAMES, result.exterior.as_array(), sd)
            pose = {**six, "origin_mm": self._origin}
        document: dict[str, Any] = jsonable(
            {
                "format": "thermocald-frame/1",
                "camera": self._camera,
                "epoch": epoch.number,
                "time": epoch.frame_time,
                "temperature": next(iter(epoch.temperatures.values()), None),
                "corrected_to": self.to,
                "status": result.status,
                "reason": result.reason,
                "opencv": opencv_terms(
                    self.sensor, self._steady.values, result.covariance[IOP, IOP]
                ),
                "pose": pose,
            }
        )
        return document
