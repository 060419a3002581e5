"""Tracking a static camera's targets from epoch to epoch.

    first frame ─► measure (full search) ─► weights
    next frames ─► fixed weights in windows ─► moved or disturbed ones fitted again ─► observations
                        └─► too many lost ─► full search, with the reason in the measurement

A tracker stores where the targets were in the last frame, and no image.

A hidden circle is looked for at its predicted place. While markers that a search missed are not
seen (somebody stood in front of them), the whole frame is searched again 1, 2, 4, 8 … frames later:
they are found after twice the time at most. If corners are suddenly lost, it is searched at once: a
board that has moved by a whole square would be tracked with other numbers.

Fixed gradient weights give the next epoch's centres as weighted sums of grey values: between epochs
a centre moves by hundredths of a pixel, so that the blurred disc of the last fit is still right to
first order. One step of Gauss-Newton from it is a sum over pixels with constant weights:
δ = N⁻¹ Jᵀ W (g − model). It is as precise as the fit itself, at the Cramér-Rao bound. Errors of
second order are even about the centre and cancel; those of third order reach a thousandth of a
pixel at 0.15 px, where the weights must be renewed. A change of light scales the partials; it is
estimated with the other parameters and removed from the step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np

from thermocald.photogrammetry.frame.measurement import (
    Measurement,
    add_unknown_tilts,
    measure,
    predict_circles,
)
from thermocald.photogrammetry.linalg import scaled_solve
from thermocald.photogrammetry.targets.circle import CircleFit, blurred_disc, fit_circles
from thermocald.photogrammetry.targets.corner import Corners, measure_corners
from thermocald.photogrammetry.targets.frame_status import OK, NoiseModel, saturation_level
from thermocald.photogrammetry.targets.image_file import EncodedImage
from thermocald.photogrammetry.targets.outline import LocalMap, windows
from thermocald.photogrammetry.targets.ring_code import have_rings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from thermocald.arrays import Array, Image, Single
    from thermocald.photogrammetry.camera.camera_model import CameraSpec
    from thermocald.photogrammetry.field.testfield import Observations, TestField


@dataclass(frozen=True, slots=True, eq=False)
class GradientWeights:
    """The weights of n targets, from their parameters (n, 10) and the frame's noise.

    maps, coded (n,): the targets' outlines, and which have a code ring; parts: for targets with
    windows of the same size, their rows, pixels, values, weights and weighted partials; inverse
    (n, 10, 10): of the normal matrices; freedom (n,): redundancy of the pixels.
    """

    maps: LocalMap
    coded: NDArray[np.bool_]
    parameters: Array
    noise: NoiseModel
    parts: tuple[tuple[NDArray[np.int64], NDArray[np.int64], Single, Single, Single], ...]
    inverse: Array
    freedom: Array

    @classmethod
    def build(
        cls,
        image: Image,
        maps: LocalMap,
        coded: NDArray[np.bool_],
        parameters: Array,
        noise: NoiseModel,
    ) -> Self:
        """Build weights from fitted parameters (n, 10); only the size of the image matters."""
        parts = []
        inverse = np.zeros((len(parameters), 10, 10))
        freedom = np.ones(len(parameters))
        placed = maps.at(parameters[:, :2])
        blur = float(np.median(parameters[:, 5])) if len(parameters) else 0.9
        for w in windows(image, placed, coded, blur):
            p = parameters[w.rows].copy()
            p[:, :2] -= w.origin
            value, j = blurred_disc(placed.select(w.rows), p, w.x, w.y)
            weight = (w.weight / noise.variance(value)).astype(np.float32)
            jw = np.ascontiguousarray((j * weight).transpose(1, 0, 2))
            N = (jw @ j.transpose(1, 2, 0)).astype(float)
            inverse[w.rows] = scaled_solve(N, np.eye(10)[None], 1e-10)
            freedom[w.rows] = np.maximum(w.weight.sum(axis=1) - 10, 1)
            parts.append((w.rows, w.pixel, value, weight, jw))
        return cls(maps, coded, parameters, noise, tuple(parts), inverse, freedom)

    def apply(self, image: Image) -> CircleFit:
        """Return the fit in an image of the same size, by one step from the epoch of the weights.

        Covariances and misfit are for the noise of that epoch.
        """
        n = len(self.parameters)
        rhs, square = np.zeros((n, 10)), np.zeros(n)
        flat = image.ravel()
        for rows, pixel, value, weight, weighted_partials in self.parts:
            r = flat.take(pixel, mode="clip").astype(np.float32)
            r -= value
            rhs[rows] = (weighted_partials @ r[..., None])[..., 0]
            r *= r
            r *= weight
            square[rows] = r.sum(axis=1)
        delta = (self.inverse @ rhs[..., None])[..., 0]
        square -= np.sum(rhs * delta, axis=1)
        contrast = self.parameters[:, 7]
        # position, shape and blur act in proportion to the present contrast
        gain = contrast / np.where(np.abs(contrast + delta[:, 7]) > 0.1 * np.abs(contrast),
                                   contrast + delta[:, 7], np.inf)  # fmt: skip
        delta[:, :6] *= gain[:, None]
        return CircleFit(
            self.parameters + delta,
            self.inverse[:, :2, :2] * (self.noise.spread * gain**2)[:, None, None],
            np.sqrt(np.maximum(square, 0.0) / self.freedom),
            np.zeros(n),
            np.full(n, "", dtype=object),
            self.noise,
        )


RENEWED_AT_PX = 0.15
"""A target that has moved farther since its weights were computed gets new ones."""
_LARGEST_BLUR_CHANGE = 0.1
_LARGEST_LIGHT_CHANGE = 0.2  # of the contrast
_NEARLY_SATURATED = 0.97
_MISFIT = 1.5  # of the epoch's median; a target with more is fitted again
_LOST_SHARE = 0.3
_RENEW_SHARE = 0.1
_SUDDEN_LOSS = 0.95  # share of the targets that remain
_FEWEST = 4
_MOVED_PX = 3.0  # from where a tracked target is found by a search


_Circles: TypeAlias = "tuple[NDArray[np.int64], GradientWeights, Array, NDArray[np.bool_]]"
"""The tracked circles: rows of the field, weights, what unknown tilts add to the covariances
(n, 2, 2) px², and which are seen."""


class Tracker:
    """Measures the frames of one camera and one test field, one after the other."""

    def __init__(self, testfield: TestField, camera: CameraSpec) -> None:
        self._testfield, self._camera = testfield, camera
        self.reset()

    def reset(self) -> None:
        """Forget the tracked targets; the next frame is searched."""
        self._shape: tuple[int, ...] | None = None  # of the frames, while something is tracked
        self._missed: frozenset[int] = frozenset()  # targets that no frame has shown since a search
        self._age = self._seen = 0  # frames since the search; targets in the last frame
        self._corners = Corners.none()

    def measure(self, image: NDArray[Any] | EncodedImage) -> Measurement:
        """Measure a frame (H, W), grey, 8 or 16 bit.

        Never raises for a bad frame, except ImageError if an encoded image cannot be decoded.
        """
        self._age += 1
        due = bool(self._missed) and self._age & (self._age - 1) == 0  # a power of two
        fewest = _SUDDEN_LOSS * self._seen if self._corners else 0.0
        if isinstance(image, EncodedImage):
            image = image.whole()
        if self._shape is None:
            return self._search(image, "nothing is tracked yet")
        if image.shape != self._shape or image.dtype != self._dtype:
            return self._search(image, f"the frame is {image.shape} {image.dtype}")
        tracked = self._track(image)
        if tracked is None:
            return self._search(image, f"too many of {self._seen} targets were lost")
        if due or len(tracked.observations) < fewest:
            return self._search(image, "targets are seen that were hidden, or moved", tracked)
        return tracked

    def _search(
        self, image: NDArray[Any], why: str, tracked: Measurement | None = None
    ) -> Measurement:
        """Search the whole frame; return `tracked` if that has as many targets where they are."""
        found = measure(image, self._testfield, self._camera)
        if tracked is not None:
            a, b = found.observations, tracked.observations
            _, i, j = np.intersect1d(a.targets, b.targets, return_indices=True)
            off = np.abs(a.points[i] - b.points[j])
            if len(a) <= len(b) and not (off.size and np.median(off) > _MOVED_PX):
                return tracked
        # after a bad frame the targets may still be at their last places
        if found.status.ok:
            self._shape, self._dtype, self._seen = image.shape, image.dtype, len(found.observations)
            self._circles, self._corners = self._begin(image, found), found.corners
            placed = () if self._circles is None else self._circles[0].tolist()
            self._missed, self._age = frozenset(found.missed).difference(placed), 0
        return replace(found, searched=why)

    def _begin(self, image: Image, found: Measurement) -> _Circles | None:
        """Predict every circle in view, measured or not, and compute the weights."""
        if found.orientation is None:
            return None
        rows, maps = predict_circles(
            self._testfield, found.orientation.camera, found.orientation.exterior
        )
        if len(rows) == 0:
            return None
        coded = have_rings(self._testfield, rows)
        seen = np.isin(rows, found.observations.targets)
        at = np.searchsorted(found.observations.targets, rows[seen])
        centre = maps.centre.copy()
        centre[seen] = found.observations.points[at]
        maps = maps.at(centre)
        blur = float(np.nanmedian(found.observations.quality["blur"]))
        fit = fit_circles(image, maps, coded, blur)
        seen &= fit.good
        if seen.sum() < _FEWEST:
            return None
        # a hidden target gets typical values, so that it is found when it reappears
        p = np.where(seen[:, None], fit.parameters, np.median(fit.parameters[seen], axis=0))
        p[~seen, :2] = maps.centre[~seen]
        tilts = np.zeros((len(rows), 2, 2))
        add_unknown_tilts(tilts, self._testfield, found.orientation.camera, rows, maps, p)
        return rows, GradientWeights.build(image, maps, coded, p, fit.noise), tilts, seen

    def _track(self, image: Image) -> Measurement | None:
        """Measure in windows; None if too many targets are lost."""
        missed: dict[int, str] = {}
        circles = self._circles
        found = measure_corners(image, self._corners, missed)
        if circles is not None:
            tracked = _track_circles(image, circles, missed)
            if tracked is None:
                return None
            found, circles = found.joined(tracked[0]), tracked[1]
        if len(found) < max(_FEWEST, (1 - _LOST_SHARE) * self._seen):
            return None
        self._seen, self._circles = len(found), circles
        self._corners = self._corners.moved(found)
        self._missed = self._missed.difference(found.targets.tolist())
        return Measurement(found, OK, missed, None, self._corners)


def _track_circles(
    image: Image, circles: _Circles, missed: dict[int, str]
) -> tuple[Observations, _Circles] | None:
    """Return observations and the new state; None if too many targets are lost."""
    rows, weights, tilts, seen = circles
    fit = weights.apply(image)
    old, p, misfit = weights.parameters, fit.parameters, fit.misfit
    top = saturation_level(image)
    level = max(float(np.median(misfit[seen])) if seen.any() else 1.0, 1.0)
    disturbed = (
        (np.abs(p[:, :2] - old[:, :2]).max(axis=1, initial=0.0) > RENEWED_AT_PX)
        | (misfit > _MISFIT * level)
        | (np.abs(p[:, 5] - old[:, 5]) > _LARGEST_BLUR_CHANGE * old[:, 5])
        | (np.abs(p[:, 6:8] - old[:, 6:8]).max(axis=1) > _LARGEST_LIGHT_CHANGE * np.abs(old[:, 7]))
        | (np.maximum(p[:, 6], p[:, 6] + p[:, 7]) > _NEARLY_SATURATED * top)
        | ~np.isfinite(p).all(axis=1)
    )
    again = disturbed | ~seen
    calm = ~again
    # the noise may have changed since the weights were computed; calm targets show by how much
    factor = float(np.median(misfit[calm])) ** 2 if calm.any() else 1.0
    np.multiply(fit.covariances, factor, out=fit.covariances)
    # assume that the others have moved like the calm ones
    shift = np.median(p[calm, :2] - old[calm, :2], axis=0) if calm.any() else np.zeros(2)
    if again.any():
        which = np.nonzero(again)[0]
        blur = float(np.median(old[:, 5]))
        others = fit_circles(
            image, weights.maps.select(which).at(old[which, :2] + shift), weights.coded[which],
            blur, weights.noise,
        )  # fmt: skip
        for name in ("parameters", "covariances", "misfit", "saturation", "reasons"):
            getattr(fit, name)[which] = getattr(others, name)
    good = fit.good
    if good.sum() < (1 - _LOST_SHARE) * seen.sum():
        return None
    if np.sum(again & good) > _RENEW_SHARE * good.sum():
        base = np.where(good[:, None], p, old)
        base[~good, :2] += shift
        weights = GradientWeights.build(image, weights.maps, weights.coded, base, weights.noise)
    if not good.all():
        missed.update(fit.missed(rows))
    fit = replace(fit, noise=fit.noise.scaled(factor), covariances=fit.covariances + tilts)
    return fit.observations(rows, good), (rows, weights, tilts, good)
