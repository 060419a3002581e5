"""Focus and light of a frame, from the quality of its targets.

The edge width of each target is known; its trend over the image tells a tilted or shifting lens
from plain defocus, and heat does both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from thermocald.arrays import Array
    from thermocald.photogrammetry.camera.camera_model import Sensor
    from thermocald.photogrammetry.field.testfield import Observations

__all__ = ["blur_trend", "frame_figures"]

_FEWEST = 6
_CUT = 3.5
_ROUNDS = 3


def frame_figures(observations: Observations, sensor: Sensor) -> dict[str, float]:
    """Figures of one frame for the store.

    `blur_px` (in the middle of the image), `blur_trend_x`, `blur_trend_y` (px from the left to the
    right edge, from top to bottom), `blur_curvature` (px from the middle to the corners), each with
    `sd_…`; medians over the targets of `contrast` (DN, negative for dark targets), `grey` (DN of
    the background), `noise` (DN), `saturation` (share of pixels). What cannot be told is absent.
    """
    figures: dict[str, float] = {}
    for name in ("contrast", "grey", "noise", "saturation"):
        values = observations.quality.get(name)
        if values is not None and np.isfinite(values).any():
            figures[name] = float(np.nanmedian(values))
    blur = observations.quality.get("blur")
    if blur is not None and np.isfinite(blur).sum() >= _FEWEST:
        values, sd = blur_trend(observations.points, blur, sensor)
        for name, value, s in zip(
            ("blur_px", "blur_trend_x", "blur_trend_y", "blur_curvature"), values, sd, strict=True
        ):
            figures[name], figures[f"sd_{name}"] = float(value), float(s)
    elif blur is not None and np.isfinite(blur).any():
        figures["blur_px"] = float(np.nanmedian(blur))
    return figures


def blur_trend(points: Array, blur: Array, sensor: Sensor) -> tuple[Array, Array]:
    """Blur as b + tx·x + ty·y + k·r² of points (n, 2) px: (b, tx, ty, k) and their sd (4,), px.

    x and y run from -½ to ½ over the image, r from 0 in its middle to 1 in its corners. Robust: a
    target that is disturbed does not count. The terms that the targets' spread does not carry get
    large standard deviations.
    """
    x, y = ((points - sensor.centre) / (sensor.width, sensor.height)).T
    design = np.column_stack([np.ones(len(x)), x, y, 2 * (x * x + y * y)])
    good = np.isfinite(blur)
    solution, variance = np.zeros(4), 0.0
    for _ in range(_ROUNDS):
        A, b = design[good], blur[good]
        solution = np.linalg.lstsq(A, b, rcond=None)[0]
        residual = blur - design @ solution
        sd = 1.4826 * float(np.median(np.abs(residual[good])))
        variance = float(np.sum(residual[good] ** 2)) / max(int(good.sum()) - 4, 1)
        good = np.isfinite(blur) & (np.abs(residual) <= _CUT * max(sd, 1e-6))
    normal = design[good].T @ design[good]
    inverse = np.linalg.pinv(normal + 1e-9 * np.eye(4))
    return solution, np.sqrt(np.maximum(np.diag(inverse) * variance, 0.0))
