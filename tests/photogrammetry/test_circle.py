"""Centres of circles reach the Cramér-Rao bound with true standard deviations, or have a reason."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.photogrammetry.exact_rendering import rms
from tests.photogrammetry.single_targets import SIZE, SingleTargets, single_targets
from thermocald.photogrammetry.targets.circle import fit_circles
from thermocald.photogrammetry.targets.frame_status import NoiseModel

NOISE = 2.0


@pytest.fixture(scope="module")
def targets() -> SingleTargets:
    """Diameters 12 to 40 px at 0 to 60°, blur 0.8 px."""
    return single_targets()


def whitened(fit, targets: SingleTargets) -> np.ndarray:
    """Return errors (n, 2) over the roots of their covariances: white if these are true."""
    roots = np.linalg.cholesky(fit.covariances)
    return np.linalg.solve(roots, (fit.points - targets.true)[..., None])[..., 0]


@pytest.mark.slow
def test_every_size_and_tilt_is_at_the_bound(targets):
    """`test_visible_targets_are_found` has other light, inks and focus, and rings of a code."""
    rng, bound, over_bound, over_stated = np.random.default_rng(12), targets.bound(NOISE), [], []
    for _ in range(400):
        begin = targets.maps.at(targets.true + rng.uniform(-0.4, 0.4, targets.true.shape))
        fit = fit_circles(targets.frame(rng, NOISE), begin)
        assert set(fit.reasons) == {""}
        over_bound.append((fit.points - targets.true) / bound)
        over_stated.append(whitened(fit, targets))
    # 800 errors per target give its RMS to 2.5 %, so 1.25 is a bound for each target
    for k in range(len(targets.true)):
        label = f"{targets.diameters[k]:.0f} px, {targets.tilts[k]:.0f}°"
        stated = np.array(over_stated)[:, k]
        assert rms(np.array(over_bound)[:, k]) <= 1.25, label
        assert 0.9 <= rms(stated) <= 1.1, label
        # elements of a covariance from 400 draws have sds of 5 to 7 %
        assert np.cov(stated.T) == pytest.approx(np.eye(2), abs=0.25), label


def test_noise_that_grows_with_the_light_is_estimated(targets):
    rng = np.random.default_rng(15)
    over, shapes = [], []
    for _ in range(30):
        image = targets.frame(rng, 0.0)
        for x, y, patch in targets.patches:
            grey = rng.normal(patch, np.sqrt(1 + 0.06 * patch))
            image[y : y + SIZE, x : x + SIZE] = np.clip(np.rint(grey), 0, 255)
        fit = fit_circles(image, targets.maps)
        over.append(whitened(fit, targets))
        shapes.append(fit.parameters[:, 2:5])
    # the outline's curvature moves a blurred edge inwards, by 1 % of the smallest discs' radius
    assert np.abs(np.mean(shapes, axis=0)).max() < 0.004
    assert fit.noise.gain == pytest.approx(0.06, abs=0.015)
    assert 0.9 <= rms(np.array(over)) <= 1.1


def covered(grey: int, left: int, top: int, right: int, bottom: int):
    """Return a function that covers a rectangle beside a target's centre (x, y) px."""
    return lambda image, x, y: cv2.rectangle(
        image, (x + left, y + top), (x + right, y + bottom), grey, -1
    )


@pytest.mark.parametrize(
    ("reason", "drawn", "change"),
    [
        ("", {}, None),
        ("cut off", {}, lambda image, x, y: image[:, : x + 3]),
        ("cut off", {}, lambda image, x, y: image[: y + 3]),
        ("too small", {"diameters": (3,)}, None),
        ("saturated", {}, lambda image, x, y: cv2.add(image, 72)),
        ("saturated", {}, covered(255, -15, -20, 29, 1)),
        ("covered", {}, covered(230, -10, 0, 2, 19)),
        ("contrast", {"ink": 188.0}, None),
        ("blurred", {"diameters": (8,), "blur": 5.5}, None),
    ],
)
def test_a_target_that_cannot_be_measured_has_a_reason(reason, drawn, change):
    one = single_targets(**{"diameters": (20,), "tilts": (0,), **drawn})
    image = one.frame(np.random.default_rng(3), NOISE)
    if change:
        image = np.ascontiguousarray(change(image, *one.true[0].astype(int).tolist()))
    # One target alone cannot separate a frame's noise from disturbances
    fit = fit_circles(image, one.maps, noise=NoiseModel(NOISE**2 + 1 / 12))
    assert (reason in fit.reasons[0]) if reason else fit.good.tolist() == [True]
