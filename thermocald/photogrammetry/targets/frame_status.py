"""A frame's noise, and its status: whether its targets can be measured.

A sensor's noise variance grows with the light (photon noise) from a floor (readout and
quantisation): var(g) = floor + gain·g. Both are estimated from the residuals of the frame's fits.

Source: EMVA standard 1288, release 4.0, section 2.

A status is recorded with its epoch: a word to count, and a sentence for the user.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import cv2
import numpy as np

from thermocald.arrays import full_scale
from thermocald.photogrammetry.linalg import mad_sd

if TYPE_CHECKING:
    from numpy.typing import NDArray


_QUANTISATION = 1 / 12
_CUT = 4.0  # robust standard deviations; larger residuals are not noise
_CUT_LOSS = 0.9989  # variance of a normal distribution cut at 4 sd
_FEWEST = 200
_ENOUGH = 8_000
_BINS = 6


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """The noise model var(g) = floor + gain·g, with floor DN² and gain DN.

    spread: by what factor the correlation of neighbouring pixels enlarges the variance of a centre.
    """

    floor: float
    gain: float = 0.0
    spread: float = 1.0

    def variance(
        self, grey: NDArray[np.floating[Any]] | np.floating[Any]
    ) -> NDArray[np.floating[Any]]:
        """Return the variance at grey values, DN², at least that of quantisation."""
        return np.maximum(self.floor + self.gain * grey, _QUANTISATION)

    def scaled(self, factor: float) -> NoiseModel:
        """Return the noise model with all variances times a factor."""
        return NoiseModel(self.floor * factor, self.gain * factor, self.spread)


def estimate_noise(
    grey: NDArray[np.floating[Any]], residuals: NDArray[np.floating[Any]], unknowns: int = 0
) -> NoiseModel:
    """Estimate the noise from grey values and residuals (n,) DN of fits with `unknowns` in all.

    Gross residuals are cut. A line is fitted twice to the variances of bins of equal count, with
    weights from their precision; if the grey values do not determine a line, the noise is constant.
    """
    freedom = np.sqrt(max(len(residuals) - unknowns, 1) / max(len(residuals), 1))
    thin = max(len(residuals) // _ENOUGH, 1)
    grey, residuals = grey[::thin].astype(float), residuals[::thin].astype(float) / freedom
    sd = float(mad_sd(residuals)) if len(residuals) else 0.0
    sd = max(sd, np.sqrt(_QUANTISATION))
    good = np.abs(residuals) < 2 * _CUT * sd
    g, r2 = grey[good], residuals[good] ** 2
    if len(g) < _FEWEST:
        return NoiseModel(max(float(r2.mean()) if len(g) else sd * sd, _QUANTISATION))
    edges = [len(g) * k // _BINS for k in range(1, _BINS)]
    bins = np.split(np.argpartition(g, edges), edges)
    x = np.array([g[b].mean() for b in bins])
    v = np.empty(_BINS)
    for i, b in enumerate(bins):
        scale = 2.1981 * np.median(r2[b])  # 1 / median of chi-square, one degree of freedom
        kept = r2[b][r2[b] < _CUT**2 * max(scale, _QUANTISATION)]
        v[i] = kept.mean() / _CUT_LOSS
    if np.ptp(x) < 20:
        return NoiseModel(max(float(v.mean()), _QUANTISATION))
    line = v
    for _ in range(2):
        weight = 1 / np.maximum(line, _QUANTISATION)
        gain, floor = np.polyfit(x, v, 1, w=weight)
        line = floor + gain * x
    if gain < 0 or floor + gain * x[0] < _QUANTISATION:
        return NoiseModel(max(float(v.mean()), _QUANTISATION))
    return NoiseModel(float(floor), float(gain))


_PLATEAU = 0.005  # share of the pixels that have the brightest value
_STEEP = 2.0  # times the pixels one level below
_ALIKE = 0.5  # share of equal neighbours off a plateau, from which an image has no noise


def saturation_level(image: NDArray[Any]) -> int:
    """Return the grey value at which a sensor saturates, of an image of 8 or 16 bit.

    It is full scale, or less if the brightest pixels have one value and the others noise.
    """
    top, sample = full_scale(image), image[::4]
    level = int(sample.max())
    full = sample == level
    if level < top and np.mean(full) > _PLATEAU:
        below = ~full & (sample >= level - max(level >> 8, 1))
        rest = ~(full[:, 1:] | full[:, :-1])
        alike = np.mean((sample[:, 1:] == sample[:, :-1])[rest]) if rest.any() else 1.0
        if full.sum() > _STEEP * below.sum() and alike < _ALIKE:
            return level
    return top


Word = Literal[
    "ok", "no_image", "not_grey", "wrong_size", "black", "white", "half", "flat",
    "nothing_found", "other_field", "too_few",
]  # fmt: skip

_LEAST_CONTRAST = 8.0  # DN of 255 between the darkest and the brightest
_PERCENTILES = (0.02, 99.98)  # a single target must count, a hot pixel must not
_HALF_SHARE = 0.15


@dataclass(frozen=True, slots=True)
class FrameStatus:
    """A frame's status: `word` to count, `reason` for the user (empty if the word is ok)."""

    word: Word
    reason: str = ""

    @property
    def ok(self) -> bool:
        """Whether the frame can be measured."""
        return self.word == "ok"


OK = FrameStatus("ok")


def inspect_frame(image: NDArray[Any], size: tuple[int, int] | None = None) -> FrameStatus:
    """Check whether a frame can be used at all, before targets are searched in it.

    image: from a camera or a decoder; size: expected width and height, px.
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
    # averaged, so that the noise of a dark frame does not count as contrast
    sample = image[::4]
    for _ in range(2):  # half the time of one step by 4
        if min(sample.shape) >= 2:
            sample = cv2.resize(sample, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    levels = int(np.iinfo(image.dtype).max) + 1  # counted, since sorting takes twice as long
    count = np.cumsum(cv2.calcHist([sample], [0], None, [levels], [0, levels]), dtype=float)
    low, high = np.searchsorted(count / sample.size, np.array(_PERCENTILES) / 100)
    top = max(full_scale(sample), 255 if image.dtype == np.uint8 else 1023)
    if high - low < _LEAST_CONTRAST / 255 * top:
        if high < 0.12 * top:
            return FrameStatus("black", f"the frame is black (grey values up to {high} DN)")
        if low > 0.88 * top:
            return FrameStatus("white", f"the frame is white (grey values from {low} DN)")
        return FrameStatus("flat", f"the frame shows nothing (grey values {low} to {high} DN)")
    broken = _constant_rows(image)
    if broken >= _HALF_SHARE * height:
        rest = image[: height - broken : 4, ::4].astype(np.int32)
        # a drawing, with equal neighbours, may have constant rows
        if len(rest) < 2 or np.median(np.abs(np.diff(rest, axis=1))) > 0:
            return FrameStatus(
                "half",
                f"the frame is incomplete: its last {broken} of {height} rows have one grey value",
            )
    return OK


def _constant_rows(image: NDArray[Any]) -> int:
    """Return how many rows at the bottom have one grey value, as a decoder fills missing data."""
    last = image[-1, 0]
    rows = 0
    for start in range(image.shape[0] - 16, -1, -16):
        block = image[start : start + 16]
        if (block[::5] != last).any() or (block != last).any():
            break
        rows += 16
    return rows
