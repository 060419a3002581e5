"""A camera in use, without a test field: its thermal model predicts it, control points pose it.

    readings ─► predicted interior orientation, with covariance ─┐
    frame ─► control points in the image ────────────────────────┴─► resection ─► row of the store

It is a calibrator, which the daemon's pipeline runs like the others. But nothing is calibrated, and
no row has the status `ok`, so that a study or a fit does not take a prediction for a measurement.

    predicted      interior orientation only: there are no control points, or none gives a pose
    resected       also the pose from the control points, with the predicted camera as prior
    last_pose      control points hidden, or too few to check each other: the last pose, with the
                   mount's possible motion, unless most of those seen contradict it
    outside_range  beyond the temperatures of the fit: predicted with widened covariance, or not at
                   all if too far
    no_temperature the last reading is too old or has jumped, or there is none
    repeated_frame the frame of the epoch before again, which says nothing of the present
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from thermocald.acquisition.calibrator import CalibratedEpoch, EpochCalibrator
from thermocald.analysis.thermal.control_points import ControlPoints
from thermocald.analysis.thermal.predictor import LONGEST_GAP_S, PredictedCamera, Predictor
from thermocald.analysis.thermal.thermal_camera import steady_camera
from thermocald.errors import ConfigurationError, DataError, ImageError
from thermocald.photogrammetry.camera.camera_model import (
    EOP,
    IOP,
    CameraSpec,
    ExteriorOrientation,
    InteriorOrientation,
    partials,
    project,
)
from thermocald.photogrammetry.epoch.adjustment import Adjustment, failed
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.frame.templates import MATCHING_SD, Templates
from thermocald.photogrammetry.frame.tracking import Tracker
from thermocald.photogrammetry.linalg import inverse_of_determined

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array
    from thermocald.epoch import Epoch
    from thermocald.photogrammetry.targets.image_file import EncodedImage
    from thermocald.store.series import EpochResult, StoredEpoch


_FEWEST = 3  # control points, if there is an earlier pose
_FEW = 4  # redundancy up to which a pose may follow a wrong control point
_MOVED_CHI2 = 38.3  # six degrees of freedom, one in a million
_ELSEWHERE_CHI2 = 18.4  # two degrees of freedom, one in ten thousand
_SUDDEN_K = 2.0  # change between two frames below which a missing effect has little influence
_UNMODELLED_PX = 0.05  # error of a control point from frame to frame: light, air, the template
_USUAL = {
    "predicted": "predicted by its thermal model",
    "resected": "predicted by its thermal model, posed by control points",
}


@dataclass(frozen=True, eq=False)
class Pose:
    """A resected pose, with which later frames are compared.

    time s; predicted: the camera then; values (16,) and covariance (16, 16) of camera and pose;
    seen: control points used.
    """

    time: float
    predicted: PredictedCamera
    values: Array
    covariance: Array
    seen: Observations


def _pose_of(
    epoch: Epoch, predicted: PredictedCamera, seen: Observations, result: Adjustment | EpochResult
) -> Pose:
    """Return the pose of an epoch's result; its rejected points are left out."""
    assert result.covariance is not None
    used = seen.select(~np.isin(seen.targets, result.rejected))
    return Pose(epoch.frame_time, predicted, result.values, result.covariance, used)


@dataclass(frozen=True, eq=False)
class Movement:
    """A movement of the camera since a time.

    values (6,): turn about the camera's axes (3,) rad and shift (3,) mm, with covariance; sudden:
    whether it happened from one frame to the next, at one temperature.
    """

    since: float
    values: Array
    covariance: Array
    sudden: bool = True

    @property
    def chi2(self) -> float:
        """Test statistic of no movement: chi-square with six degrees of freedom."""
        return float(self.values @ np.linalg.solve(self.covariance, self.values))

    def sentence(self) -> str:
        """Return turn and shift as a sentence."""
        sd = np.sqrt(np.diag(self.covariance))
        turn, shift = (np.linalg.norm(self.values[k]) for k in (slice(0, 3), slice(3, 6)))
        sd_turn, sd_shift = (np.linalg.norm(sd[k]) for k in (slice(0, 3), slice(3, 6)))
        return (
            f"the camera was moved: it turned by {math.degrees(turn):.4f} ± "
            f"{math.degrees(sd_turn):.4f}° and shifted by {shift:.1f} ± {sd_shift:.1f} mm"
            + ("; turn and shift can hardly be separated here" if sd_shift > shift else "")
            + (
                ""
                if self.sudden
                else "; it was not sudden: a thermometer in the sun or a missing effect looks the "
                "same"
            )
        )


class GaugeCalibrator(EpochCalibrator):
    """A calibrator that predicts and poses the epochs of one camera, and observes the results.

    control, finder: the control points and what measures them, or None; mount_sd_deg: the random
    walk of the mount about each axis, ° in an hour, None if unknown; tell(kind, text, utc, epoch):
    takes the events that `observe` finds.
    """

    def __init__(
        self,
        thermal: ThermalCamera,
        control: TestField | None = None,
        finder: Tracker | Templates | None = None,
        mount_sd_deg: float | None = None,
        snooping_alpha: float = 0.001,
    ) -> None:
        self.thermal = thermal
        self.sensor = thermal.model.sensor
        self.testfield = control or TestField.build([], np.empty((0, 3)))
        self.predictor = Predictor(thermal)
        self._finder = finder
        self._mount = mount_sd_deg
        self._alpha = snooping_alpha
        self.pose: Pose | None = None
        """The last pose from control points."""
        self._reference: Pose | None = None
        self._still: Pose | None = None  # the last that agrees with the reference
        self._moved: Pose | None = None  # the one after it, if that does not
        self._number = 0
        self.movement: Movement | None = None
        """The movement of the camera that the last epoch showed, if any."""
        self.tell: Callable[[str, str, float, int], None] = lambda *_: None
        self._status = self._reason = ""

    def outlook(self) -> str:
        """Describe the control points, and the pose that they give in the reference frame."""
        if not len(self.testfield):
            return "no control points: the interior orientation alone"
        text = f"{len(self.testfield)} control points"
        if not isinstance(self._finder, Templates):
            return text
        seen = self._finder.reference
        text += f", {len(seen)} within the reference frame"
        known = ControlPoints(self.testfield, seen, np.zeros(3), "mm")
        try:
            pose = known.pose(self.predictor.settled(), self._alpha)
        except DataError as error:
            return f"{text}: warning: {error}"
        rejected = ", ".join(self.testfield.names[row] for row in pose.rejected)
        text += f", sigma0 of their pose {pose.sigma0:.2f}"
        text += f"; left out: {rejected}" if rejected else ""
        doubts = known.find_doubts(self.predictor.settled(), pose)
        return text + "".join(f"; doubtful: {doubt}" for doubt in doubts)

    def reset(self) -> None:
        """Forget the last frame and where its control points were: they are searched for anew."""
        super().reset()
        if self._finder is not None:
            self._finder.reset()

    def remember(self, stored: Iterable[StoredEpoch]) -> None:
        """Restore the state from stored epochs: their readings and the last pose."""
        for one in stored:
            self.predictor.take(one.epoch.temperature_time, one.epoch.temperatures)
            self._number = one.epoch.number
            result = one.result
            if result.status == "resected" and result.covariance is not None:
                seen, known = one.epoch.observations, self.predictor.at(one.epoch.frame_time)
                if seen is not None and known is not None:
                    self.pose = self._still = _pose_of(one.epoch, known, seen, result)
                    self._reference = self._reference or self.pose

    def calibrate(
        self,
        epoch: Epoch,
        image: NDArray[Any] | EncodedImage | None = None,
        fingerprint: int | None = None,
    ) -> CalibratedEpoch:
        """Predict and pose the camera of an epoch. Never raises because of data."""
        self.predictor.take(epoch.temperature_time, epoch.temperatures)
        in_order = epoch.number > self._number
        self._number = max(self._number, epoch.number)
        now = self.predictor.at(epoch.frame_time)
        repeated, measured, why = self._measured(epoch, image, fingerprint)
        if repeated is not None:
            return repeated
        epoch = replace(epoch, observations=measured)
        if now is None:
            first = next(iter(epoch.temperatures), "the reference thermometer")
            names = " and ".join(dict.fromkeys([first, *self.thermal.channels]))
            bad = failed("no_temperature", f"no reading of {names} so far", measured)
            return CalibratedEpoch(epoch, bad, {})
        beyond, T = now.camera.extrapolated, now.camera.temperature
        extra = {
            "reading_age_s": now.age_s, "unknown_past_px": now.unknown_px, "outside_K": beyond,
        }  # fmt: skip
        outside = self.thermal.validity.place(T) if beyond else ""
        if beyond and not self.thermal.validity.beyond(T):
            outside = f"another thermometer is {beyond:.1f} K outside the range of the fit"
        if self.thermal.validity.is_far(T):
            bad = failed("outside_range", f"{outside}: nothing is predicted there", measured)
            return CalibratedEpoch(epoch, bad, extra)
        result = self._posed(epoch, now, measured, why, in_order)
        if self.movement is not None:
            extra["event"] = 1.0
        if outside:
            result = replace(result, status="outside_range", reason=f"{outside}: sds are widened")
        elif now.age_s > LONGEST_GAP_S:
            old = f"the last reading is {now.age_s:.0f} s old: the covariance grows"
            result = replace(result, status="no_temperature", reason=old)
        elif now.jump:
            jumped = f"the reading jumped by {now.jump:.1f} K: the covariance includes it"
            result = replace(result, status="no_temperature", reason=jumped)
        return CalibratedEpoch(epoch, result, extra)

    def _measured(
        self, epoch: Epoch, image: NDArray[Any] | EncodedImage | None, fingerprint: int | None
    ) -> tuple[CalibratedEpoch | None, Observations | None, str]:
        """Return the result if the frame is a repeated one, else control points or why none."""
        self.movement = None
        seen, why = epoch.observations, "no control point is seen"
        if seen is None and self._finder is None:
            return None, None, why
        try:
            image, fingerprint = self._look(epoch, image, fingerprint)
            if (repeated := self._repeated(epoch, fingerprint)) is not None:
                return repeated, None, why
            if seen is None:
                assert self._finder is not None
                if image is None:
                    return None, None, epoch.note or "there is no frame"
                found = self._finder.measure(image)
                seen, why = found.observations, found.status.reason or found.status.word
        except ImageError as error:
            return None, None, str(error)
        if len(seen):
            self._remember(epoch, fingerprint)
        return None, seen, why

    def _posed(
        self, epoch: Epoch, now: PredictedCamera, seen: Observations | None, why: str,
        in_order: bool,
    ) -> Adjustment:  # fmt: skip
        if not len(self.testfield):
            return self._unposed("predicted", "", now)
        if seen is None or len(seen) < _FEWEST:
            if seen is not None and len(seen):
                why = f"only {len(seen)} control point{'s are' if len(seen) > 1 else ' is'} seen"
            return self._without_pose(epoch, now, seen, why)
        start = None if self.pose is None else ExteriorOrientation.from_array(self.pose.values[EOP])
        result = now.camera.resect(self.testfield, seen, self._alpha, start)
        if not result.ok and start is not None and len(seen) > _FEWEST:
            # the last pose is a bad start if the camera was turned by a large angle
            again = now.camera.resect(self.testfield, seen, self._alpha)
            result = again if again.ok else result
        if not result.ok:
            return self._without_pose(epoch, now, seen, f"{result.status}: {result.reason}")
        if (last := self.pose) is not None and result.redundancy <= _FEW:
            used = seen.select(~np.isin(seen.targets, result.rejected))
            share = self._share_elsewhere(last, now, used, self._since(last, now, epoch))
            # most of them move with the camera; of three points, nothing checks even that
            if share > 0.0 and (share <= 0.5 or not result.redundancy):
                why = "a control point contradicts the last pose, and too few are seen to check it"
                return self._without_pose(epoch, now, used, why)
        if in_order:
            self.pose = _pose_of(epoch, now, seen, result)
            self._watch(self.pose)
        return replace(result, status="resected", reason="")

    def _unposed(
        self, status: str, reason: str, now: PredictedCamera, seen: Observations | None = None
    ) -> Adjustment:
        known = tuple(n for n, sd in now.camera.sd.items() if sd > 0)
        blank = failed(status, reason, seen, known)
        blank.covariance[IOP, IOP] = now.camera.covariance
        return replace(blank, interior=now.camera.interior)

    def _without_pose(
        self, epoch: Epoch, now: PredictedCamera, seen: Observations | None, why: str
    ) -> Adjustment:
        """Return the last pose, widened by what the mount may have moved; without one, no pose.

        The camera is the one of that pose, changed as predicted since: both errors are correlated.
        """
        last = self.pose
        if last is None:
            return self._unposed("predicted", f"no pose so far: {why}", now)
        still = f"; the mount may have moved for {_hours_between(last, epoch):.2f} h"
        if self._mount is None:
            still = "; the mount is taken not to have moved since, as its movement is not known"
        since = self._since(last, now, epoch)
        if seen is not None and len(seen) and self._share_elsewhere(last, now, seen, since) > 0.5:
            why = f"{why}; most are not where the last pose puts them: was the camera moved?"
            return self._unposed("predicted", why, now, seen)
        result = self._unposed("last_pose", why + still, now, seen)
        iop = last.values[IOP] + now.camera.values - last.predicted.camera.values
        return replace(
            result,
            interior=InteriorOrientation.from_array(iop),
            covariance=last.covariance + since,
            exterior=ExteriorOrientation.from_array(last.values[EOP]),
        )

    def _since(self, last: Pose, now: PredictedCamera, epoch: Epoch) -> Array:
        """Return the covariance (16, 16) of what may have changed since the last pose."""
        since = np.zeros((16, 16))
        since[IOP, IOP] = self._change(last.predicted, now)
        walk = math.radians(self._mount or 0.0) ** 2 * _hours_between(last, epoch)
        since[range(10, 13), range(10, 13)] = walk
        return since

    def _share_elsewhere(
        self, last: Pose, now: PredictedCamera, seen: Observations, since: Array
    ) -> float:
        """Return the share of the control points that contradict the last pose.

        Those that it used are compared with their image then, others with their coordinates; since
        (16, 16): the covariance of what may have changed.
        """
        moved, A, noise = self._moved_since(last, now, seen)
        C = [A @ since @ A.swapaxes(1, 2) + noise[:, :, None] * np.eye(2)]
        new = seen.select(~np.isin(seen.targets, last.seen.targets))
        points, sigmas = (v[new.targets] for v in (self.testfield.points, self.testfield.sigmas))
        at, A, B = partials(self.sensor, now.camera.values, last.values[EOP], points)
        C.append(A @ (last.covariance + since) @ A.swapaxes(1, 2))
        C[1] += B * sigmas[:, None] ** 2 @ B.swapaxes(1, 2)
        C[1][:, range(2), range(2)] += new.sigmas**2
        left = np.concatenate([moved, new.points - at])
        chi2 = np.einsum("ni,nij,nj->n", left, np.linalg.inv(np.concatenate(C)), left)
        return float(np.mean(chi2 > _ELSEWHERE_CHI2))

    def _moved_since(
        self, then: Pose, now: PredictedCamera, seen: Observations
    ) -> tuple[Array, Array, Array]:
        """Return how the control points of a pose have moved in the image beyond the prediction.

        The same points are used, so the errors of their coordinates cancel. Returns the movement
        (n, 2) px, its derivatives (n, 2, 16), and the variances (n, 2) of the image points.
        """
        both, *rows = np.intersect1d(then.seen.targets, seen.targets, return_indices=True)
        a, b = then.seen.select(rows[0]), seen.select(rows[1])
        points, before = self.testfield.points[both], then.predicted.camera.values
        at, A, _ = partials(self.sensor, before, then.values[EOP], points)
        warmer = project(self.sensor, now.camera.values, then.values[EOP], points) - at
        noise = _matching(a) ** 2 + _matching(b) ** 2 + _UNMODELLED_PX**2
        return b.points - a.points - warmer, A, noise

    def _change(self, then: PredictedCamera, now: PredictedCamera) -> Array:
        """Return the covariance (10, 10) of the camera's predicted change.

        Errors that the model has at both times cancel; those of the rates, of the readings, and of
        an unknown past remain.
        """
        _, covariance = self.thermal.steady_change(then.camera.temperature, now.camera.temperature)
        unknown = now.unknown - then.unknown
        return covariance + then.noise + now.noise + np.outer(unknown, unknown)

    def _watch(self, pose: Pose) -> None:
        """Compare a pose with the reference; two different poses in a row are a movement."""
        found = None if self._reference is None else self.compare(self._reference, pose)
        if found is None or found.chi2 <= _MOVED_CHI2:
            self._reference, self._still, self._moved = self._reference or pose, pose, None
        elif self._moved is None or self._still is None:
            self._moved = pose
        else:
            # the step between two consecutive frames shows whether it was sudden, not thermal
            then, now = self._still, self._moved
            step = self.compare(then, now)
            warmer = now.predicted.camera.temperature - then.predicted.camera.temperature
            sudden = step is not None and step.chi2 > _MOVED_CHI2 and abs(warmer) < _SUDDEN_K
            self.movement = replace(found, since=now.time, sudden=sudden)
            self._reference, self._still, self._moved = pose, pose, None

    def compare(self, then: Pose, now: Pose) -> Movement | None:
        """Return the camera's movement between two poses; None if they share too few points."""
        moved, A, noise = self._moved_since(then, now.predicted, now.seen)
        if len(moved) < _FEWEST:
            return None
        weighted = (A[..., EOP] / noise[..., None]).reshape(-1, 6)
        A = A.reshape(-1, 16)
        inverse = inverse_of_determined(A[:, EOP].T @ weighted)
        gain = inverse @ weighted.T
        lever = gain @ A[:, IOP]
        change = self._change(then.predicted, now.predicted)
        return Movement(now.time, gain @ moved.ravel(), inverse + lever @ change @ lever.T)

    def observe(self, calibrated: CalibratedEpoch, *_: object) -> dict[str, float]:
        """Report changes of the rows' status, and movements.

        Returns no columns to store, as a gauge has no series to adjust.
        """
        epoch, result = calibrated.epoch, calibrated.adjustment
        if result.status == "repeated_frame":  # the camera's own event is `frozen`
            return {}
        if (moved := self.movement) is not None:
            self.tell("camera_moved", moved.sentence(), moved.since, epoch.number)
        if result.status != self._status and (self._status or result.status not in _USUAL):
            text = result.reason or f"{result.status} again"
            self.tell(result.status, text, epoch.frame_time, epoch.number)
        self._status, self._reason = result.status, result.reason
        return {}

    def report(self) -> dict[str, Any]:
        """Return the state for status.json and the page."""
        return {"state": self._status, "sentence": self._reason or _USUAL.get(self._status, "")}


def plan_gauge(
    thermal: ThermalCamera, control: Path | None, unit: str, reference: Path | None,
    mount_sd_deg: float | None, snooping_alpha: float,
) -> tuple[GaugeCalibrator, list[float]]:  # fmt: skip
    """Return the calibrator of a gauge and the origin (3,) of its coordinates, mm."""
    if control is None:
        return GaugeCalibrator(thermal, mount_sd_deg=mount_sd_deg), [0.0, 0.0, 0.0]
    try:  # a pose is compared with others through the steady camera
        steady_camera(thermal, thermal.model.T0)
    except DataError as error:
        raise ConfigurationError(f"a gauge with control points: {error}") from error
    given = ControlPoints.read(control, unit)
    finder: Tracker | Templates
    if reference is None:
        if not any(given.field.codes):
            raise ConfigurationError(
                f"{control}: no control point has a code; set `control_reference` to the frame in "
                "which x, y of the natural points were measured"
            )
        model = thermal.model
        known = CameraSpec(model.camera, model.sensor, interior=model.interior)
        finder = Tracker(given.field, known)
    else:
        finder = Templates.read(reference, given.field, given.seen)
        size, sensor = finder.image_size, thermal.model.sensor
        if size != (sensor.width, sensor.height):
            raise ConfigurationError(
                f"control_reference {reference}: has {size[0]}×{size[1]} px, the camera's frames "
                f"{sensor.width}×{sensor.height} px"
            )
    gauge = GaugeCalibrator(thermal, given.field, finder, mount_sd_deg, snooping_alpha)
    return gauge, given.origin.tolist()


def _hours_between(last: Pose, epoch: Epoch) -> float:
    return abs(epoch.frame_time - last.time) / 3600.0  # an epoch that is processed late is earlier


def _matching(seen: Observations) -> Array:
    """Return standard deviations (n, 2) px from frame to frame, without errors in common."""
    own = seen.quality.get(MATCHING_SD)
    return seen.sigmas if own is None else np.stack([own, own], axis=1)
