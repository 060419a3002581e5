"""The scene itself as a check of a thermal model: what does not move, seen by a camera that stands.

Features of a reference frame are found again in every frame. Most of what a river shows moves by
itself (water, leaves, shadows); what has a common movement is the camera's. Of it the thermal
model's prediction is taken off; the rest is a turn of the mount about three axes and a change of
the principal distance, which the model did not predict. A turn from one frame to the next is a
camera that was moved; a principal distance with a course of its own, an effect that is missing.

From one place a shift of the principal point cannot be told from a turn, nor a shift of the camera
from either where depths are unknown: what is stated as a turn may be any of them. The principal
distance can be told, by the scale. Standard deviations are those of the features that take part.

Source: Fischler, M. and Bolles, R. (1981): Random sample consensus, CACM 24(6); Lucas, B. and
Kanade, T. (1981), in OpenCV's pyramidal form, forwards and backwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.special import fdtri

from thermocald.analysis.thermal.correction import require_inside
from thermocald.analysis.thermal.scene_recording import Track, write_scene
from thermocald.errors import DataError, ImageError
from thermocald.numbers import with_sd
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, partials
from thermocald.photogrammetry.linalg import mad_sd
from thermocald.photogrammetry.targets.frame_status import inspect_frame
from thermocald.photogrammetry.targets.image_file import decode_grey
from thermocald.result import Result, new_figure, with_sds

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from thermocald.analysis.camera.camera import Camera
    from thermocald.analysis.thermal.thermal_camera import ThermalCamera
    from thermocald.arrays import Array
    from thermocald.store.logger.temperatures import TemperatureLog

_MOST_FEATURES = 600
_FEWEST = 12  # that have a common movement
_APART_PX = 12
_WINDOW_PX = 21
_BACK_PX = 0.3  # forwards and backwards again
_DRAWS = 300
_NEAR_PX = 0.6  # of a common movement: a draw's followers
_TUKEY = 4.685
_ROUNDS = 10
_WORD_SIGMAS = 4.0
_MISSED_ALPHA = 1e-3  # of a model that holds
_KNOWN = 1e6  # degrees of freedom of a variance that is known
_FEWEST_BEYOND = 3  # frames more than a smooth course has numbers
_MOVED_CHI2 = 30.7  # three degrees of freedom, one in a million
_LEAST_PX = 0.03  # at the edge: real corners have a common wobble of up to 0.02 px RMS
_LOCKED_PX = 0.004  # of matching, as a function of the pixel's part moved: common to all features


@dataclass(frozen=True, eq=False)
class SceneMovement:
    """The movement that a frame shows beside the model's prediction.

    values (4,): turns about the camera's x, y and z axis in rad, change of the principal distance
    mm; covariance (4, 4); locked (4,): the part of the sds that further frames do not lessen;
    follow (n,): which of the features have it in common.
    """

    values: Array
    covariance: Array
    locked: Array
    follow: NDArray[np.bool_]


def features(reference: NDArray[Any]) -> NDArray[np.float32]:
    """Features (F, 2) px of a reference frame (H, W); DataError where it has too few."""
    corners = cv2.goodFeaturesToTrack(
        _eight_bit(reference), _MOST_FEATURES, 0.005, _APART_PX, blockSize=7
    )
    found = np.zeros((0, 2)) if corners is None else np.asarray(corners).reshape(-1, 2)
    last = np.array(reference.shape[::-1]) - _WINDOW_PX
    points = found[((found >= _WINDOW_PX) & (found < last)).all(axis=1)].astype(np.float32)
    if len(points) < _FEWEST:
        raise DataError(
            f"the reference frame has {len(points)} features; at least {_FEWEST} are needed that "
            "do not move: another frame, more light"
        )
    return points


def followed(
    reference: NDArray[Any], points: NDArray[np.float32], image: NDArray[Any]
) -> tuple[NDArray[np.int64], Array]:
    """Rows of the features (F, 2) px that are found again, and how far they moved (n, 2) px."""
    first, now, start = _eight_bit(reference), _eight_bit(image), None
    options: dict[str, Any] = {
        "winSize": (_WINDOW_PX, _WINDOW_PX), "maxLevel": 3,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-3),
    }  # fmt: skip
    flow: Any = cv2.calcOpticalFlowPyrLK
    there, found, _ = flow(first, now, points, start, **options)
    back, again, _ = flow(now, first, there, start, **options)
    same = np.abs(back - points).max(axis=1) < _BACK_PX
    rows = np.flatnonzero((found.ravel() == 1) & (again.ravel() == 1) & same)
    return rows, (there - points)[rows].astype(float)


def common_movement(
    then: Camera, now: Camera, points: Array, moved: Array, seed: int = 0
) -> SceneMovement | None:
    """Estimate what features have in common beside the prediction; None where too few have it.

    then, now: the predicted cameras; points (n, 2) px in the reference frame; moved (n, 2) px.
    """
    predicted = then.as_seen_by(points, now.interior) - points
    left = moved - predicted
    rays = then.rays(points)
    _, J, _ = partials(then.sensor, then.values, np.zeros(6), rays / -rays[:, 2:])
    A = J[:, :, [10, 11, 12, 0]]
    scale = np.abs(A).max(axis=(0, 1))
    A = A / scale
    x = _consensus(A, left, np.random.default_rng(seed))
    if x is None:
        return None
    weight = np.ones(len(left))
    spread = _NEAR_PX
    for _ in range(_ROUNDS):
        r = left - A @ x
        size = np.linalg.norm(r, axis=1)
        near = size < 3 * _NEAR_PX
        if near.sum() < _FEWEST:
            return None
        spread = max(mad_sd(r[near]), 1e-3)
        weight = np.clip(1 - (size / (_TUKEY * spread)) ** 2, 0.0, None) ** 2
        if (weight > 0).sum() < _FEWEST:
            return None
        N = np.einsum("nci,n,ncj->ij", A, weight, A)
        x = np.linalg.solve(N, np.einsum("nci,n,nc->i", A, weight, left))
    r = left - A @ x
    inverse = np.linalg.inv(N)
    # windows overlap: features near each other have their errors in common
    cells = np.unique(points // (2 * _WINDOW_PX), axis=0, return_inverse=True)[1].ravel()
    score = np.zeros((cells.max() + 1, 4))
    np.add.at(score, cells, np.einsum("nci,n,nc->ni", A, weight, r))
    groups = np.unique(cells[weight > 0]).size
    covariance = inverse @ (score.T @ score) @ inverse * groups / max(groups - 2, 1)
    covariance += _LOCKED_PX**2 * np.eye(4)
    whole = covariance / np.outer(scale, scale)
    return SceneMovement(x / scale, whole, _LOCKED_PX / scale, weight > 0)


def _consensus(A: Array, left: Array, rng: np.random.Generator) -> Array | None:
    """The movement that most features follow, of two features drawn at a time."""
    best, most = np.zeros(4), 0
    for _ in range(_DRAWS if len(left) >= _FEWEST else 0):
        pair = rng.choice(len(left), 2, replace=False)
        M = A[pair].reshape(4, 4)
        # two features hardly tell the scale: a little weight on none
        x = np.linalg.solve(M.T @ M + 1e-6 * np.eye(4), M.T @ left[pair].ravel())
        count = int((np.abs(left - A @ x).max(axis=1) < _NEAR_PX).sum())
        if count > most:
            best, most = np.asarray(x, dtype=float), count
    return best if most >= _FEWEST else None


@dataclass(frozen=True, eq=False)
class SceneCourse(Result):
    """The course of a scene in a series of frames, beside a thermal model's prediction.

    names (E); times (E,) s UTC; temperatures (E,) °C; values (E, 4) and covariance (E, 4, 4) as of
    `SceneMovement`, NaN where a frame shows nothing; unsure (E, 4): sds of the prediction itself,
    since the reference frame; features (E,); locked (4,); pitch_rad: of a pixel.
    """

    camera: str
    names: tuple[str, ...]
    times: Array
    temperatures: Array
    values: Array
    covariance: Array
    unsure: Array
    features: NDArray[np.int64]
    reasons: tuple[str, ...]
    locked: Array
    pitch_rad: float

    @cached_property
    def sd(self) -> Array:
        """(E, 4) of what is seen."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """(E,): frames with a common movement."""
        return np.isfinite(self.values[:, 0])

    @cached_property
    def per_kelvin(self) -> tuple[Array, Array]:
        """Slopes (4,) of `values` against the temperature, and their standard deviations.

        Those are of the larger of stated and found scatter; NaN where the temperature did not
        change.
        """
        T = self.temperatures[self.seen]
        slopes, sds = np.full(4, np.nan), np.full(4, np.nan)
        if len(T) < 4 or np.ptp(T) < 1.0:
            return slopes, sds
        for k in range(4):
            y, s = self.values[self.seen, k], self.sd[self.seen, k]
            A = np.column_stack([np.ones(len(T)), T - T.mean()]) / s[:, None]
            inverse = np.linalg.inv(A.T @ A)
            x = inverse @ A.T @ (y / s)
            scatter = float(np.sum((y / s - A @ x) ** 2) / (len(T) - 2))
            ends = 2.0 * self.locked[k] / np.ptp(T)
            slopes[k], sds[k] = x[1], np.hypot(np.sqrt(inverse[1, 1] * max(1.0, scatter)), ends)
        return slopes, sds

    @cached_property
    def model_misses(self) -> bool:
        """Return whether the principal distance changes by more than the prediction is sure to.

        With the temperature, or with anything else that has a course.
        """
        slope, sd = (v[3] for v in self.per_kelvin)
        change = float(np.ptp(self.temperatures[self.seen])) if self.seen.any() else 0.0
        own = float(np.nanmax(self.unsure[:, 3], initial=0.0)) / max(change, 1e-9)
        if abs(slope) > _WORD_SIGMAS * np.hypot(sd, own):
            return True
        rows = np.flatnonzero(self.seen)
        least = _LEAST_PX * float(self.locked[3]) / _LOCKED_PX
        if len(rows) < 4 or float(np.sqrt(np.mean(self.values[rows, 3] ** 2))) < least:
            return False
        return self._has_smooth_course(rows) or self._has_course(rows)

    def _has_smooth_course(self, rows: NDArray[np.int64]) -> bool:
        """Test whether c goes with temperature, its square, time, or differs from the reference's.

        Noise is what these leave. All frames stand together in four numbers, and the effect is not
        taken for noise: an effect of second order is found that is hidden in each frame.
        """
        T, hours = self.temperatures[rows] - self.temperatures[0], self.times[rows] - self.times[0]
        A = np.column_stack([np.ones(len(T)), T, T**2, hours])
        A = A / np.maximum(np.abs(A).max(axis=0), 1e-9)
        y, noise, known = self._beside(rows)
        weight = np.linalg.inv(noise)
        N = A.T @ weight @ A
        rank = int(np.linalg.matrix_rank(N, hermitian=True))
        free = len(rows) - rank
        if rank == 0 or free < _FEWEST_BEYOND:
            return False
        rest = y - A @ (np.linalg.pinv(N, hermitian=True) @ (A.T @ weight @ y))
        factor = max(1.0, float(rest @ weight @ rest) / free)
        weight = np.linalg.inv(factor * noise + known)
        right = A.T @ weight @ y
        explained = float(right @ np.linalg.pinv(A.T @ weight @ A, hermitian=True) @ right)
        return explained / rank > _f_bound(rank, factor, free)

    def _has_course(self, rows: NDArray[np.int64]) -> bool:
        """Test whether c has a course: noise is what differs from the mean of the frames beside."""
        y, noise, known = self._beside(rows)
        v = self.covariance[rows, 3, 3]
        bends = np.diff(y, 2) ** 2 / (v[2:] + 4.0 * v[1:-1] + v[:-2])
        factor = max(1.0, float(bends.mean()))
        whole = float(y @ np.linalg.solve(factor * noise + known, y))
        return whole / len(rows) > _f_bound(len(rows), factor, len(rows) / 2.0)

    def _beside(self, rows: NDArray[np.int64]) -> tuple[Array, Array, Array]:
        """Return c beside the prediction (n,), its covariance by noise, and by the prediction."""
        variance = self.covariance[rows, 3, 3]
        known = self.unsure[rows, 3] * np.sign(self.temperatures[rows] - self.temperatures[0])
        # the reference frame's noise is common to all
        noise = np.diag(variance) + float(np.median(variance))
        return self.values[rows, 3], noise, np.outer(known, known)

    @cached_property
    def movements(self) -> list[tuple[int, Array, Array]]:
        """Frames in which the camera was moved since the one before: turn (3,) rad, covariance.

        The next frame must show it too, where there is one. A mount that follows the temperature
        slowly is none.
        """
        rows = np.flatnonzero(self.seen)
        values = np.vstack([np.zeros(3), self.values[rows, :3]])
        spread = np.zeros((len(values), 3, 3))
        spread[1:] = self.covariance[rows, :3, :3]
        spread[1:, range(3), range(3)] += self.unsure[rows, :3] ** 2
        found = []
        for k in range(1, len(values)):
            beyond = []
            for after in range(k, min(k + 2, len(values))):
                turn, C = values[after] - values[k - 1], spread[after] + spread[k - 1]
                beyond.append(turn @ np.linalg.solve(C, turn) > _MOVED_CHI2)
            if all(beyond):
                turn, C = values[k] - values[k - 1], spread[k] + spread[k - 1]
                found.append((int(rows[k - 1]), turn, C))
        return found

    def as_dict(self) -> dict[str, Any]:
        slopes, sds = self.per_kelvin
        keys = ("turn_x", "turn_y", "turn_z", "c")
        frames = [
            {
                "frame": name, "time": time, "temperature": T, "features": int(count),
                "reason": why, **with_sds(keys, v, sd),
            }
            for name, time, T, count, why, v, sd in zip(
                self.names, self.times.tolist(), self.temperatures.tolist(), self.features,
                self.reasons, self.values.tolist(), self.sd.tolist(), strict=True,
            )
        ]  # fmt: skip
        return {
            "format": "thermocald-scene/1", "camera": self.camera, "frames": frames,
            "per_kelvin": dict(zip(keys, slopes.tolist(), strict=True)),
            "sd_per_kelvin": dict(zip(keys, sds.tolist(), strict=True)),
            "model_misses_an_effect": self.model_misses,
            "movements": [
                {
                    "frame": self.names[row], "time": float(self.times[row]),
                    **with_sds(keys[:3], turn, np.sqrt(C.diagonal())),
                }
                for row, turn, C in self.movements
            ],
        }  # fmt: skip

    def lines(self) -> list[str]:
        out = [f"{int(self.seen.sum())} of {len(self.names)} frames follow the reference frame"]
        slopes, sds = self.per_kelvin
        if np.isfinite(slopes).all():
            out.append(
                "principal distance beside the model: "
                f"{with_sd(1e3 * slopes[3], 1e3 * sds[3], 'µm')} per kelvin"
                + (": the model misses an effect" if self.model_misses else ", as it should be")
            )
            px = [with_sd(slopes[k] / self.pitch_rad, sds[k] / self.pitch_rad) for k in (0, 1)]
            out.append(
                f"turn of the mount, or principal point, which one place cannot tell: {px[0]} px "
                f"per kelvin about x, {px[1]} about y"
            )
        else:
            out.append("the temperature hardly changed: the model cannot be checked")
        for row, turn, C in self.movements:
            angle, sd = (float(np.degrees(np.linalg.norm(v))) for v in (turn, C.diagonal() ** 0.5))
            out.append(
                f"{self.names[row]}: the camera was moved since the frame before: it turned by "
                f"{angle:.4f} ± {sd:.4f}°; a shift looks alike"
            )
        reasons = [why for why in self.reasons if why]
        out += [f"{reasons.count(why)} × {why}" for why in sorted(set(reasons))]
        return out

    def plot(self) -> Figure:
        figure, axes = new_figure(2)
        hours = (self.times - self.times[0]) / 3600
        for k, label in enumerate(("about x", "about y", "about z")):
            y = np.degrees(self.values[:, k])
            axes[0, 0].errorbar(hours, y, np.degrees(self.sd[:, k]), fmt=".", label=label)
        axes[0, 0].set_ylabel("turn in °")
        axes[0, 0].legend()
        axes[1, 0].errorbar(hours, 1e3 * self.values[:, 3], 1e3 * self.sd[:, 3], fmt=".")
        axes[1, 0].set(ylabel="c beside the model in µm", xlabel="hours")
        return figure


def follow_scene(
    thermal: ThermalCamera,
    log: TemperatureLog,
    frames: Sequence[tuple[Path, float]],
    extrapolate: bool = False,
    advance: Callable[[int], None] = lambda _: None,
    recording: Path | None = None,
) -> SceneCourse:
    """Follow the scene of frames (file, s UTC), the first of which is the reference.

    recording: a folder to write what does not move to, for `discover`. Raises DataError where there
    is no temperature, or nothing to follow.
    """
    if len(frames) < 2:
        raise DataError("a scene needs a reference frame and at least one more")
    frames = sorted(frames, key=lambda frame: frame[1])
    times = np.array([time for _, time in frames])
    require_inside(log, times)
    reference = decode_grey(frames[0][0])
    thermal = thermal.for_images(reference.shape[1], reference.shape[0])
    along = thermal.along(log.times, log.channels, times, extrapolate)
    since = thermal.along(
        log.times, log.channels, times, extrapolate, float(along.temperatures[0]),
        thermal.reading_sd,
    ).sd  # fmt: skip
    corners = features(reference)
    E = len(frames)
    values, covariance = np.full((E, 4), np.nan), np.full((E, 4, 4), np.nan)
    locked = np.zeros(4)
    count, reasons = np.zeros(E, dtype=np.int64), [""] * E
    points = corners.astype(float)
    tracks: list[Track | None] = [(np.arange(len(points)), points), *[None] * (E - 1)]
    for k, (path, _) in enumerate(frames):
        if k == 0:
            reasons[k] = "the reference frame"
            continue
        found = None
        try:
            image = decode_grey(path)
            status = inspect_frame(image, (reference.shape[1], reference.shape[0]))
            reasons[k] = status.reason
            if status.ok:
                rows, moved = followed(reference, corners, image)
                found = common_movement(along[0], along[k], points[rows], moved, k)
                reasons[k] = "" if found else "too few features have a common movement"
        except ImageError as error:
            reasons[k] = str(error)
        if found is not None:
            follow = found.follow
            tracks[k] = rows[follow], points[rows][follow] + moved[follow]
            values[k], covariance[k] = found.values, found.covariance
            count[k], locked = int(follow.sum()), found.locked
        advance(1)
    if recording is not None:
        write_scene(recording, thermal.model.camera, along[0], log, times, points, tracks)
    interior = InteriorOrientation.from_array(along.values[0])
    unsure = since[:, [2, 1, 0, 0]] / [interior.c, interior.c, np.inf, 1.0]
    return SceneCourse(
        thermal.model.camera, tuple(path.name for path, _ in frames), times, along.temperatures,
        values, covariance, unsure, count, tuple(reasons), locked,
        thermal.model.sensor.pixel_pitch / interior.c,
    )  # fmt: skip


def _f_bound(rank: int, factor: float, free: float) -> float:
    """Bound of one of the two tests of a course, noise being `factor` times the stated variance.

    Stated variances stand, unless that of so many degrees of freedom is of their upper quarter.
    """
    if factor < fdtri(free, _KNOWN, 0.75):
        free = _KNOWN
    return float(fdtri(rank, free, 1.0 - _MISSED_ALPHA / 2))


def _eight_bit(image: NDArray[Any]) -> NDArray[np.uint8]:
    return image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
