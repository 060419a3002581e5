"""Approximate values for a network, from the photographs alone or from nominal coordinates.

Without nominal coordinates one pair is oriented relatively (essential matrix); the others follow
one by one by resection on the targets intersected so far. With nominal coordinates every photograph
is resected by itself. Both work on rays of an approximate interior orientation and tolerate wrong
identifications.

Source: Nistér, D. (2004): An efficient solution to the five-point relative pose problem; Terzakis,
G., Lourakis, M. (2020): A consistently fast and globally optimal solution to the perspective-n-
point problem (both as implemented in OpenCV).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from thermocald.errors import GeometryError
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation, Sensor
from thermocald.photogrammetry.camera.camera_model import rays as camera_rays
from thermocald.photogrammetry.network.bundle import Bundle, BundleAdjustment, ImageRays
from thermocald.photogrammetry.orientation import FLIP, majority_pose

if TYPE_CHECKING:
    from thermocald.arrays import Array, Index


_INLIER_PX = 6.0
_MIN_RESECTION = 6
_MIN_PAIR = 8
_LEAST_ANGLE = np.radians(2.0)  # between two rays of a target
# Principal distances to try for an unknown camera, in image widths: wide angle to tele.
_TRIAL_DISTANCES = (0.75, 1.0, 1.35, 0.55, 2.0, 3.0)
# A plane field has a second, false relative orientation per pair: three good pairs are tried.
_GOOD_PAIRS, _PAIRS = 3, 12
_GOOD_MEDIAN_PX = 0.5
_GOOD_MISSING = 4  # twentieths of the image points that a good start may lack


class _Start:
    """A network under construction, with the poses and targets determined so far."""

    def __init__(self, sensor: Sensor, interior: Array, rays: ImageRays, n_targets: int) -> None:
        self.sensor, self.interior, self.rays = sensor, interior, rays
        self.directions = camera_rays(sensor, interior, rays.points) @ FLIP
        self.normalised: Array = self.directions[:, :2] / self.directions[:, 2:]
        self.threshold = _INLIER_PX * sensor.pixel_pitch / float(interior[0])
        self.poses: dict[int, tuple[Array, Array]] = {}  # OpenCV: x_camera = R x + t
        self.points = np.full((n_targets, 3), np.nan)

    def rows(self, photo: int) -> Index:
        """Return the rows of one photograph's rays."""
        return np.flatnonzero(self.rays.photo == photo)

    def resect(self, photo: int) -> bool:
        """Orient one photograph on the targets determined so far; return whether that succeeded."""
        rows = self.rows(photo)
        rows = rows[np.isfinite(self.points[self.rays.target[rows], 0])]
        if len(rows) < _MIN_RESECTION:
            return False
        known, image = self.points[self.rays.target[rows]], self.normalised[rows]
        fewest = max(_MIN_RESECTION, len(rows) // 3)
        found = majority_pose(known, image, self.threshold, fewest, seed=1)
        if found is not None:
            self.poses[photo] = found[:2]
        return found is not None

    def intersect(self) -> None:
        """Intersect every target that oriented photographs see at a sufficient angle."""
        oriented = np.isin(self.rays.photo, list(self.poses))
        for target in np.unique(self.rays.target[oriented]):
            rows = np.flatnonzero(oriented & (self.rays.target == target))
            if len(rows) < 2:
                continue
            R = np.array([self.poses[int(p)][0] for p in self.rays.photo[rows]])
            t = np.array([self.poses[int(p)][1] for p in self.rays.photo[rows]])
            d = np.einsum("nji,nj->ni", R, self.directions[rows])
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            if np.arccos(np.clip((d @ d.T).min(), -1, 1)) < _LEAST_ANGLE:
                continue
            X0 = -np.einsum("nji,nj->ni", R, t)
            P = np.eye(3) - d[:, :, None] * d[:, None, :]
            x = np.linalg.solve(P.sum(axis=0), np.einsum("nij,nj->i", P, X0))
            if np.all(np.einsum("ni,ni->n", x - X0, d) > 0):
                self.points[target] = x

    def bundle(self) -> tuple[Bundle, list[int], ImageRays]:
        """Return the bundle so far, its photographs, and its rays with photographs renumbered."""
        photos = sorted(self.poses)
        number = np.full(int(self.rays.photo.max()) + 1, -1)
        number[photos] = np.arange(len(photos))
        keep = (number[self.rays.photo] >= 0) & np.isfinite(self.points[self.rays.target, 0])
        used = self.rays.select(keep)
        used = replace(used, photo=number[used.photo])
        R = np.array([self.poses[p][0] for p in photos])
        t = np.array([self.poses[p][1] for p in photos])
        centres = -np.einsum("nji,nj->ni", R, t)
        points = np.where(np.isfinite(self.points), self.points, 0.0)
        return Bundle(self.interior, np.swapaxes(R, 1, 2) @ FLIP, centres, points), photos, used

    def refine(self) -> None:
        """Adjust the bundle so far by a few robust iterations, the interior orientation held."""
        bundle, photos, used = self.bundle()
        held = BundleAdjustment(self.sensor, used, np.array([], dtype=int))
        bundle = held.solve(bundle, robust=True, iterations=4)
        R = FLIP @ np.swapaxes(bundle.rotations, 1, 2)
        for i, photo in enumerate(photos):
            self.poses[photo] = (R[i], -R[i] @ bundle.centres[i])
        known = np.isfinite(self.points[:, 0])
        self.points[known] = bundle.points[known]

    def extend(self) -> None:
        """Add photographs, the one that sees most known targets first, until none can be added."""
        tried: set[int] = set()
        photos = {int(p) for p in np.unique(self.rays.photo)}
        while remaining := photos - set(self.poses) - tried:
            known = np.isfinite(self.points[self.rays.target, 0])
            counts = {p: int(known[self.rays.photo == p].sum()) for p in remaining}
            best = max(sorted(counts), key=lambda p: counts[p])
            if not self.resect(best):
                tried.add(best)
                continue
            tried.clear()
            self.intersect()
            if len(self.poses) <= 8 or len(self.poses) % 4 == 0:
                self.refine()
        self.intersect()

    def common(self, first: int, second: int) -> tuple[Index, Index]:
        """Return the rays of two photographs to the targets that both show."""
        a, b = self.rows(first), self.rows(second)
        _, ia, ib = np.intersect1d(self.rays.target[a], self.rays.target[b], return_indices=True)
        return a[ia], b[ib]

    def pairs(self) -> list[tuple[int, int]]:
        """Return pairs of photographs to begin with, the most promising first.

        A promising pair has many common targets, with directions that a rotation alone does not
        explain, so that there is a base between the photographs.
        """
        scored = []
        for a, b in combinations(np.unique(self.rays.photo).tolist(), 2):
            d1, d2 = (self.directions[rows] for rows in self.common(a, b))
            if len(d1) >= _MIN_PAIR:
                U, _, Vt = np.linalg.svd(d1.T @ d2)
                turned = d2 @ (U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt).T
                parallax = float(np.median(np.linalg.norm(d1 - turned, axis=1)))
                scored.append((len(d1) * min(parallax, 0.3), a, b))
        return [(a, b) for _, a, b in sorted(scored, key=lambda row: -row[0])]

    def begin_with_pair(self, pair: tuple[int, int]) -> None:
        """Orient two photographs to each other. Raises GeometryError if they do not fit."""
        import cv2

        a, b = self.common(*pair)
        first, second = self.normalised[a], self.normalised[b]
        cv2.setRNGSeed(1)
        E, mask = cv2.findEssentialMat(
            first, second, focal=1.0, pp=(0.0, 0.0), method=cv2.RANSAC, prob=0.9999,
            threshold=self.threshold,
        )  # fmt: skip
        n = 0
        if E is not None and E.shape == (3, 3):
            n, R, t, _ = cv2.recoverPose(E, first, second, focal=1.0, pp=(0.0, 0.0), mask=mask)
        # a pair that disagrees in half of its targets is useless, however large its parallax
        if n < max(_MIN_PAIR, len(a) // 2):
            raise GeometryError("the two photographs do not fit together")
        self.poses = {
            pair[0]: (np.eye(3), np.zeros(3)),
            pair[1]: (np.asarray(R, dtype=float), np.asarray(t, dtype=float).ravel()),
        }
        self.points[:] = np.nan
        self.intersect()
        if np.isfinite(self.points[:, 0]).sum() < _MIN_PAIR:
            raise GeometryError("the two photographs have too few targets in common")

    def begin_with_nominal(self, nominal: Array) -> None:
        """Resect every photograph on nominal coordinates (m, 3) mm, NaN if unknown."""
        self.points[:] = nominal
        for photo in np.unique(self.rays.photo):
            self.resect(int(photo))
        if len(self.poses) < 2:
            raise GeometryError("fewer than two photographs show enough of the nominal field")
        # now the targets follow from the photographs, also those without nominal coordinates
        self.points[:] = np.nan
        self.intersect()


def approximate(
    sensor: Sensor,
    rays: ImageRays,
    n_targets: int,
    interior: InteriorOrientation | None,
    nominal: Array | None,
    free: Index,
) -> tuple[Bundle, list[int], ImageRays]:
    """Return the best approximate network: most image points, then smallest residuals.

    interior: approximate, several are tried if None; nominal (n_targets, 3) mm or None; free: the
    interior parameters to estimate. Returns the bundle, its photographs, and their rays,
    renumbered. Raises GeometryError if nothing can be oriented.
    """
    width = max(sensor.width, sensor.height) * sensor.pixel_pitch
    trials = [interior] if interior else [InteriorOrientation(k * width) for k in _TRIAL_DISTANCES]
    best: tuple[int, float, Bundle, list[int], ImageRays] | None = None
    for trial in trials:
        start = _Start(sensor, trial.as_array(), rays, n_targets)
        ways: list[tuple[int, int] | None] = [] if nominal is None else [None]
        ways += start.pairs()[:_PAIRS]
        good = 0
        for way in ways:
            try:
                if way is not None:
                    start.begin_with_pair(way)
                else:
                    start.begin_with_nominal(np.asarray(nominal, dtype=float))
                start.refine()
                start.extend()
                bundle, photos, used = start.bundle()
                adjustment = BundleAdjustment(sensor, used, free)
                bundle = adjustment.approach(bundle, 15)
            except GeometryError:
                continue
            off = replace(adjustment, rays=used.in_pixels()).residuals(bundle)
            median = float(np.median(np.linalg.norm(off, axis=1)))
            # a difference of five per cent of the image points does not count
            missing = round(20 * (1 - len(used) / len(rays)))
            if best is None or (missing, median) < best[:2]:
                best = (missing, median, bundle, photos, used)
            good += 1
            if best[0] <= _GOOD_MISSING and best[1] < _GOOD_MEDIAN_PX:
                return best[2:]
            if good == _GOOD_PAIRS:
                break
    if best is None:
        raise GeometryError(
            "no two photographs can be oriented to each other: at least two must show 8 common "
            "targets from clearly different places, and three are needed"
        )
    return best[2:]
