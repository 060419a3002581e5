"""The scene itself as a check of a thermal model: static features seen by a fixed camera.

Features of a reference frame are tracked into every frame. Much of a river scene moves by itself
(water, leaves, shadows); the movement that features share is the camera's. The thermal model's
prediction is subtracted from it. What remains, unpredicted, is a turn of the mount about three axes
and a change of the principal distance. A turn from one frame to the next means that the camera was
moved; a systematic change of the principal distance, that an effect is missing.

From one station a shift of the principal point cannot be separated from a turn, nor a shift of the
camera from either if depths are unknown: what is reported as a turn may be any of them. The
principal distance is determined by the scale. Standard deviations come from the scatter of the
features that take part.

Static features can be written as a recording that `discover` reads. A feature has a direction, but
no depth: its target is placed on its ray, so far away that no movement of a mount matters. Such an
image determines the camera's turns and its interior orientation, and nothing else. Depths differ
from target to target, so that the projection centre is determined and is not correlated with the
principal distance, as it would be with a plane.

Source: Fischler, M. and Bolles, R. (1981): Random sample consensus, CACM 24(6); Lucas, B. and
Kanade, T. (1981), in OpenCV's pyramidal form, tracked forwards and backwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from scipy.special import fdtri

from thermocald.arrays import eight_bit
from thermocald.epoch import Epoch
from thermocald.errors import DataError, ImageError
from thermocald.numbers import with_sd
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, partials
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.linalg import mad_sd
from thermocald.photogrammetry.targets.frame_status import inspect_frame
from thermocald.photogrammetry.targets.image_file import decode_grey
from thermocald.result import Result, jsonable, new_figure, with_sds
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.writer import RecordingWriter

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
_FEWEST = 12  # features with a common movement, and places where they are
_APART_PX = 12
_WINDOW_PX = 21
_BACK_PX = 0.3  # largest difference after tracking forwards and back
_DRAWS = 300
_NEAR_PX = 0.6  # within this distance a feature follows a drawn movement
_TUKEY = 4.685
_ROUNDS = 10
_WORD_SIGMAS = 4.0  # of a slope with temperature that the model is said to miss
_MISSED_ALPHA = 1e-3  # probability of rejecting an adequate model
_KNOWN = 1e6  # degrees of freedom that stand for a known variance
_FEWEST_BEYOND = 3  # frames in excess of the parameters of a smooth course
_MOVED_CHI2 = 30.7  # three degrees of freedom, one in a million
_LEAST_PX = 0.03  # at the image's edge: real corners share a wobble of up to 0.02 px RMS
_DISTANCE_MM = 1e6
"""Distance of the targets: 1 mm of mount movement moves no image point by more than 0.01 px."""
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_MOST_TARGETS = 200
_STILL = 0.8  # fraction of the frames in which a feature has to follow the common movement
_FEWEST_TARGETS = 12
_LOCKED_PX = 0.004  # matching error that depends on the subpixel shift: common to all features


Track = tuple["NDArray[np.int64]", "Array"]
"""One frame's features that follow the common movement: rows (n,), image points (n, 2) px."""


def detect_features(reference: NDArray[Any]) -> NDArray[np.float32]:
    """Detect features (F, 2) px in a reference frame (H, W). Raises DataError for too few."""
    corners = cv2.goodFeaturesToTrack(
        eight_bit(reference, int(reference.max())), _MOST_FEATURES, 0.005, _APART_PX, blockSize=7
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


def track_features(
    reference: NDArray[Any], points: NDArray[np.float32], image: NDArray[Any]
) -> tuple[NDArray[np.int64], Array]:
    """Track features (F, 2) px; return the rows of those found again and their shifts (n, 2) px."""
    brightest = max(int(reference.max()), int(image.max()))
    first, now = (eight_bit(frame, brightest) for frame in (reference, image))
    start = None
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


def estimate_movement(
    then: Camera, now: Camera, points: Array, moved: Array, seed: int = 0
) -> tuple[Array, Array, Array, NDArray[np.bool_]] | None:
    """Estimate the movement that features share beyond the prediction; None if too few share it.

    then, now: the predicted cameras; points (n, 2) px in the reference frame; moved (n, 2) px.
    Returns turns about the camera's x, y and z axes in rad and the change of the principal distance
    in mm (4,), their covariance (4, 4), the part of their sds that more frames do not reduce (4,),
    and which features (n,) share the movement.
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
    # windows overlap: errors of neighbouring features are correlated; a cell at a time is left out
    cells = np.unique(points // (2 * _WINDOW_PX), axis=0, return_inverse=True)[1].ravel()
    if np.unique(cells[weight > 0]).size < _FEWEST:
        return None
    score, own = np.zeros((cells.max() + 1, 4)), np.zeros((cells.max() + 1, 4, 4))
    np.add.at(score, cells, np.einsum("nci,n,nc->ni", A, weight, r))
    np.add.at(own, cells, np.einsum("nci,n,ncj->nij", A, weight, A))
    score = np.linalg.solve(np.eye(4) - own @ inverse, score[..., None])[..., 0]
    covariance = inverse @ (score.T @ score) @ inverse
    covariance += _LOCKED_PX**2 * np.eye(4)
    whole = covariance / np.outer(scale, scale)
    return x / scale, whole, _LOCKED_PX / scale, weight > 0


def _consensus(A: Array, left: Array, rng: np.random.Generator) -> Array | None:
    """Return the movement of two drawn features that most features follow; None if too few do."""
    best, most = np.zeros(4), 0
    for _ in range(_DRAWS if len(left) >= _FEWEST else 0):
        pair = rng.choice(len(left), 2, replace=False)
        M = A[pair].reshape(4, 4)
        # two features hardly determine the scale: regularised towards no change
        x = np.linalg.solve(M.T @ M + 1e-6 * np.eye(4), M.T @ left[pair].ravel())
        count = int((np.abs(left - A @ x).max(axis=1) < _NEAR_PX).sum())
        if count > most:
            best, most = np.asarray(x, dtype=float), count
    return best if most >= _FEWEST else None


@dataclass(frozen=True, eq=False)
class SceneCourse(Result):
    """The movements of a scene over a series of frames, beyond a thermal model's prediction.

    names (E); times (E,) s UTC; temperatures (E,) °C; values (E, 4): turns about the camera's x, y
    and z axes in rad, change of the principal distance in mm; covariance (E, 4, 4); both are NaN
    for a frame without a common movement; unsure (E, 4): sds of the predicted change since the
    reference frame; features (E,): that share the movement; reasons (E): why a frame has none;
    locked (4,): the part of the sds that more frames do not reduce; pitch_rad: the angle of a
    pixel.
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
        """Standard deviations (E, 4) of `values`."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Which frames (E,) have a common movement."""
        return np.isfinite(self.values[:, 0])

    @cached_property
    def per_kelvin(self) -> tuple[Array, Array]:
        """Slopes (4,) of `values` against the temperature, and their standard deviations.

        From the larger of stated and observed scatter; NaN below four frames or 1 K of change. A
        movement of the camera is a step in its turns; NaN if it cannot be separated from a slope.
        """
        T, rows = self.temperatures[self.seen], np.flatnonzero(self.seen)
        steps = [(rows >= row).astype(float) for row, _, _ in self.movements if row > rows[0]]
        slopes, sds = np.full(4, np.nan), np.full(4, np.nan)
        if len(T) < 4 or np.ptp(T) < 1.0:
            return slopes, sds
        for k in range(4):
            y, s = self.values[self.seen, k], self.sd[self.seen, k]
            own = steps if k < 3 else []
            A = np.column_stack([np.ones(len(T)), T - T.mean(), *own]) / s[:, None]
            if np.linalg.matrix_rank(A) < A.shape[1]:
                continue
            inverse = np.linalg.inv(A.T @ A)
            x = inverse @ A.T @ (y / s)
            scatter = float(np.sum((y / s - A @ x) ** 2)) / max(len(T) - 2 - len(own), 1)
            ends = 2.0 * self.locked[k] / np.ptp(T)
            slopes[k], sds[k] = x[1], np.hypot(np.sqrt(inverse[1, 1] * max(1.0, scatter)), ends)
        return slopes, sds

    @cached_property
    def model_misses(self) -> bool:
        """True if c changes with temperature, or in another systematic way, beyond its sds."""
        slope, sd = (v[3] for v in self.per_kelvin)
        change = float(np.ptp(self.temperatures[self.seen])) if self.seen.any() else 0.0
        own = float(np.nanmax(self.unsure[:, 3], initial=0.0)) / max(change, 1e-9)
        if abs(slope) > _WORD_SIGMAS * np.hypot(sd, own):
            return True
        rows = np.flatnonzero(self.seen)
        least = _LEAST_PX * float(self.locked[3]) / _LOCKED_PX
        if len(rows) < 4 or float(np.sqrt(np.mean(self.values[rows, 3] ** 2))) < least:
            return False
        # c less the prediction; the reference frame's noise is common to all, and the prediction's
        # error is one number times its sds
        y, variance = self.values[rows, 3], self.covariance[rows, 3, 3]
        noise = np.diag(variance) + float(np.median(variance))
        errors = self.unsure[rows, 3] * np.sign(self.temperatures[rows] - self.temperatures[0])
        known = np.outer(errors, errors)
        if self._has_smooth_course(rows, y, noise, known):
            return True
        # another systematic course; the noise is that of the differences from both neighbours' mean
        bends = np.diff(y, 2) ** 2 / (variance[2:] + 4.0 * variance[1:-1] + variance[:-2])
        factor = max(1.0, float(bends.mean()))
        whole = float(y @ np.linalg.solve(factor * noise + known, y))
        return whole / len(rows) > _f_bound(len(rows), factor, len(rows) / 2.0)

    def _has_smooth_course(
        self, rows: NDArray[np.int64], y: Array, noise: Array, known: Array
    ) -> bool:
        """Test whether c changes with temperature, its square, time, or since the reference frame.

        y (n,): c less the prediction, with covariances from noise and from the prediction. The size
        of the noise is estimated from the residuals. Four parameters describe all frames together,
        so that the effect does not count as noise: one that no single frame shows is found.
        """
        T, hours = self.temperatures[rows] - self.temperatures[0], self.times[rows] - self.times[0]
        A = np.column_stack([np.ones(len(T)), T, T**2, hours])
        A = A / np.maximum(np.abs(A).max(axis=0), 1e-9)
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

    @cached_property
    def movements(self) -> list[tuple[int, Array, Array]]:
        """Frames in which the camera has moved since the frame before: turn (3,) rad, covariance.

        The next frame, if any, must confirm it. A mount's slow thermal movement does not count.
        """
        rows = np.flatnonzero(self.seen)
        values = np.vstack([np.zeros(3), self.values[rows, :3]])
        spread = np.zeros((len(values), 3, 3))
        spread[1:] = self.covariance[rows, :3, :3]
        spread[1:, range(3), range(3)] += self.unsure[rows, :3] ** 2
        found = []
        for row, k in enumerate(rows.tolist()):
            turns, C = values[row + 1 :] - values[row], spread[row + 1 :] + spread[row]
            pairs = list(zip(turns, C, strict=True))
            if all(turn @ np.linalg.solve(Q, turn) > _MOVED_CHI2 for turn, Q in pairs[:2]):
                found.append((k, *pairs[0]))
        return found

    def as_dict(self) -> dict[str, Any]:
        slopes, sds = self.per_kelvin
        keys = ("turn_x", "turn_y", "turn_z", "c")
        frames = [
            {
                "frame": name, "time": self.times[k], "temperature": self.temperatures[k],
                "features": self.features[k], "reason": self.reasons[k],
                **with_sds(keys, self.values[k], self.sd[k]),
            }
            for k, name in enumerate(self.names)
        ]  # fmt: skip
        movements = [
            {k: frames[row][k] for k in ("frame", "time")}
            | with_sds(keys[:3], turn, np.sqrt(C.diagonal()))
            for row, turn, C in self.movements
        ]
        document: dict[str, Any] = jsonable({
            "format": "thermocald-scene/1", "camera": self.camera, "frames": frames,
            "per_kelvin": dict(zip(keys, slopes, strict=True)),
            "sd_per_kelvin": dict(zip(keys, sds, strict=True)),
            "model_misses_an_effect": self.model_misses, "movements": movements,
        })  # fmt: skip
        return document

    def lines(self) -> list[str]:
        out = [f"{int(self.seen.sum())} of {len(self.names)} frames follow the reference frame"]
        slopes, sds = self.per_kelvin
        if np.isfinite(slopes[3]):
            verdict = "the model misses an effect"
            if not self.model_misses:
                verdict = "consistent with the model"
            out.append(
                "change of the principal distance beyond the model: "
                f"{with_sd(1e3 * slopes[3], 1e3 * sds[3], 'µm')} per kelvin, {verdict}"
            )
            px = [with_sd(slopes[k] / self.pitch_rad, sds[k] / self.pitch_rad) for k in (0, 1)]
            out.append(
                "turn of the mount or shift of the principal point (one station cannot separate "
                f"them): {px[0]} px per kelvin about x, {px[1]} about y"
                if np.isfinite(slopes[:2]).all()
                else "whether the mount turns with temperature cannot be told from its movements"
            )
        else:
            out.append("the temperature hardly changed: the model cannot be tested")
        for row, turn, C in self.movements:
            angle, sd = (float(np.degrees(np.linalg.norm(v))) for v in (turn, C.diagonal() ** 0.5))
            out.append(
                f"{self.names[row]}: the camera was moved since the frame before: it turned by "
                f"{angle:.4f} ± {sd:.4f}°, or it was shifted, which looks the same"
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
        axes[1, 0].set(ylabel="c minus predicted c in µm", xlabel="hours")
        return figure


def follow_scene(
    thermal: ThermalCamera,
    log: TemperatureLog,
    frames: Sequence[tuple[Path, float]],
    advance: Callable[[int], None] = lambda _: None,
    recording: Path | None = None,
) -> SceneCourse:
    """Follow a scene through frames (file, s UTC); the earliest frame is the reference.

    recording: a folder to which the static features are written as a recording, for `discover`.
    Raises DataError for fewer than two frames, times outside the log, or too few features.
    """
    if len(frames) < 2:
        raise DataError("a scene needs a reference frame and at least one more")
    frames = sorted(frames, key=lambda frame: frame[1])
    times = np.array([time for _, time in frames])
    reference = decode_grey(frames[0][0])
    thermal = thermal.for_images(reference.shape[1], reference.shape[0])
    along = thermal.along(
        log.times, log.channels, times, temperature_sd=thermal.reading_sd, since=frames[0][1]
    )
    corners = detect_features(reference)
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
                rows, moved = track_features(reference, corners, image)
                found = estimate_movement(along[0], along[k], points[rows], moved, k)
                reasons[k] = "" if found else "too few features have a common movement"
        except ImageError as error:
            reasons[k] = str(error)
        if found is not None:
            values[k], covariance[k], locked, follow = found
            tracks[k] = rows[follow], points[rows][follow] + moved[follow]
            count[k] = int(follow.sum())
        advance(1)
    if recording is not None:
        write_scene(recording, along[0], log, times, points, tracks)
    interior = InteriorOrientation.from_array(along.values[0])
    unsure = along.sd[:, [2, 1, 0, 0]] / [interior.c, interior.c, np.inf, 1.0]
    return SceneCourse(
        thermal.model.camera, tuple(path.name for path, _ in frames), times, along.temperatures,
        values, covariance, unsure, count, tuple(reasons), locked,
        thermal.model.sensor.pixel_pitch / interior.c,
    )  # fmt: skip


def _f_bound(rank: int, factor: float, free: float) -> float:
    """Return the bound of one of the two tests of c; factor: observed over stated variance.

    The stated variance counts as known unless `factor`, with `free` degrees of freedom, lies in the
    upper quarter of its distribution.
    """
    if factor < fdtri(free, _KNOWN, 0.75):
        free = _KNOWN
    return float(fdtri(rank, free, 1.0 - _MISSED_ALPHA / 2))


def write_scene(
    path: Path,
    camera: Camera,
    log: TemperatureLog,
    times: Array,
    points: Array,
    tracks: Sequence[Track | None],
) -> int:
    """Write the static features as a recording; return how many there are.

    times (E,) s UTC: of the frames; camera: at the first frame; points (F, 2) px: the features in
    that frame; tracks: one per frame, None for a frame without a common movement. Raises DataError
    for fewer than twelve static features, RecordingError if `path` cannot be written.
    """
    shown = [track for track in tracks if track is not None]
    seen = np.bincount(np.concatenate([rows for rows, _ in shown]), minlength=len(points))
    still = np.flatnonzero(seen >= _STILL * len(shown))
    still = np.sort(still[np.argsort(-seen[still], kind="stable")[:_MOST_TARGETS]])
    if len(still) < _FEWEST_TARGETS:
        raise DataError(
            f"{len(still)} features are static in most of the frames; a recording needs at least "
            f"{_FEWEST_TARGETS}"
        )
    target = np.full(len(points), -1)
    target[still] = np.arange(len(still))
    noise = _feature_noise(points, shown, target)
    rays = camera.rays(points[still])
    depths = _DISTANCE_MM * 2.0 ** (2.0 * ((np.arange(len(still)) * _GOLDEN) % 1.0) - 1.0)
    across = noise * camera.sensor.pixel_pitch / camera.interior.c * _DISTANCE_MM
    field = TestField.build(
        [f"feature{row}" for row in still], rays / -rays[:, 2:] * depths[:, None], across
    )
    name = camera.name
    head = Head(
        name, name, float(np.median(np.diff(times))) if len(times) > 1 else 1.0,
        CameraSpec(name, camera.sensor, camera.interior.c, camera.interior),
        {channel: Channel() for channel in log.channels},
    )  # fmt: skip
    nearest = np.clip(np.searchsorted(log.times, times, side="right") - 1, 0, None)
    with RecordingWriter(path, head, field) as writer:
        writer.keep_readings(log)
        for number, (time, row, track) in enumerate(zip(times, nearest, tracks, strict=True), 1):
            observed = None
            if track is not None:
                kept = target[track[0]] >= 0
                sigmas = np.full((int(kept.sum()), 2), noise)
                observed = Observations(target[track[0]][kept], track[1][kept], sigmas)
            values = {channel: float(T[row]) for channel, T in log.channels.items()}
            writer.append(Epoch(number, float(time), float(log.times[row]), values, None, observed))
    return len(still)


def _feature_noise(points: Array, shown: Sequence[Track], target: NDArray[np.int64]) -> float:
    """Estimate the noise of an image point, px, from the differences of consecutive frames.

    The common difference (shift, turn and scale) is removed first.
    """
    left = []
    for (rows, at), (later, there) in pairwise(shown):
        both, here, then = np.intersect1d(rows, later, return_indices=True)
        of_targets = target[both] >= 0
        moved = (there[then] - at[here])[of_targets]
        if len(moved) > 6:
            A = np.column_stack([np.ones(len(moved)), points[both][of_targets]])
            left.append((moved - A @ np.linalg.lstsq(A, moved, rcond=None)[0]).ravel())
    return max(mad_sd(np.concatenate(left)) / np.sqrt(2.0), 1e-3) if left else 0.1
