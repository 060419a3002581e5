"""Whether a frame can be measured at all, and if not, why: black, white, half, wrong size, …

A status is for an epoch's record: one word to count by and one sentence for a person.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["OK", "FrameStatus", "inspect_frame"]

Word = Literal[
    "ok", "no_image", "not_grey", "wrong_size", "black", "white", "half", "flat",
    "nothing_found", "other_field", "too_few",
]  # fmt: skip

_LEAST_CONTRAST = 8.0  # DN of 255 between the darkest and the brightest
_PERCENTILES = (0.02, 99.98)  # a single target must be enough, a hot pixel must not
_HALF_SHARE = 0.15
_STRIDE = 4
_HALVINGS = 2


@dataclass(frozen=True, slots=True)
class FrameStatus:
    """`word` to count by, `reason` for a person (empty where the word is ok)."""

    word: Word
    reason: str = ""

    @property
    def ok(self) -> bool:
        """Whether the frame was measured."""
        return self.word == "ok"


OK = FrameStatus("ok")


def inspect_frame(image: NDArray[Any], size: tuple[int, int] | None = None) -> FrameStatus:
    """Look for what makes a frame useless before anything is searched in it.

    image: what a camera or a decoder gave; size: width and height px that are expected.
    """
    if image.size == 0:
        return FrameStatus("no_image", "the frame is empty")
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        return FrameStatus(
            "not_grey",
            f"the frame is {'×'.join(map(str, image.shape))} {image.dtype}; a grey image of 8 or "
            "16 bit (height × width) is needed",
        )
    height, width = image.shape
    if size is not None and (width, height) != size:
        turned = " (turned by 90°?)" if (height, width) == size else ""
        return FrameStatus(
            "wrong_size",
            f"the frame has {width}×{height} px, the camera is set up for "
            f"{size[0]}×{size[1]} px{turned}",
        )
    # Averaged, so that the noise of a dark frame does not pass for contrast.
    sample = image[::_STRIDE]
    for _ in range(_HALVINGS):
        if min(sample.shape) >= 2:
            sample = cv2.resize(sample, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    levels = np.iinfo(image.dtype).max + 1
    histogram = cv2.calcHist([sample], [0], None, [levels], [0, levels])
    share = np.cumsum(histogram, dtype=float) / sample.size
    low, high = (int(v) for v in np.searchsorted(share, np.array(_PERCENTILES) / 100))
    top = 255 if image.dtype == np.uint8 else max(int(sample.max()), 1023)
    if high - low < _LEAST_CONTRAST / 255 * top:
        if high < 0.12 * top:
            return FrameStatus("black", f"the frame is black (grey values up to {high} DN)")
        if low > 0.88 * top:
            return FrameStatus("white", f"the frame is white (grey values from {low} DN)")
        return FrameStatus("flat", f"the frame shows nothing (grey values {low} to {high} DN)")
    broken = _constant_rows(image)
    if broken >= _HALF_SHARE * height and _noise(image[: height - broken : 4, ::4]) > 0:
        return FrameStatus(
            "half",
            f"the frame is incomplete: its last {broken} of {height} rows hold one grey value",
        )
    return OK


def _constant_rows(image: NDArray[Any]) -> int:
    """How many rows at the bottom hold one grey value; a decoder fills so what it did not get."""
    last = image[-1, 0]
    rows = 0
    for start in range(image.shape[0] - 16, -1, -16):
        block = image[start : start + 16]
        if (block[::5] != last).any() or (block != last).any():
            break
        rows += 16
    return rows


def _noise(sample: NDArray[Any]) -> float:
    """Median difference between neighbours in DN: 0 in a drawing, which may have constant rows."""
    if sample.shape[0] < 2:
        return 1.0
    return float(np.median(np.abs(np.diff(sample.astype(np.int32), axis=1))))
