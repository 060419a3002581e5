"""The static features of photographs of a scene, as a recording that `discover` reads.

A feature has a direction, but no depth. Its target is placed on its ray, so far away that no
movement of a mount matters: such an image determines the camera's turns and its interior
orientation, and nothing else. Depths differ from target to target, so that the projection centre is
determined and is not correlated with the principal distance, as it would be with a plane.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from thermocald.epoch import Epoch
from thermocald.errors import DataError
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.photogrammetry.linalg import mad_sd
from thermocald.store.recording.head import CameraSpec, Channel, Head
from thermocald.store.recording.writer import RecordingWriter

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from thermocald.analysis.camera.camera import Camera
    from thermocald.arrays import Array
    from thermocald.store.logger.temperatures import TemperatureLog

_DISTANCE_MM = 1e6
"""Distance of the targets: 1 mm of mount movement moves no image point by more than 0.01 px."""
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_MOST_TARGETS = 200
_STILL = 0.8  # fraction of the frames in which a feature has to follow the common movement
_FEWEST_TARGETS = 12

Track = tuple["NDArray[np.int64]", "Array"]
"""One frame's features that follow the common movement: rows (n,), image points (n, 2) px."""


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
    noise = _noise(points, shown, target)
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


def _noise(points: Array, shown: Sequence[Track], target: NDArray[np.int64]) -> float:
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
