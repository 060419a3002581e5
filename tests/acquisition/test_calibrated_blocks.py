"""Epochs calibrated in blocks: the same bits on any number of processes."""

from dataclasses import replace

import numpy as np
import pytest

from thermocald.acquisition.calibrator import Calibrator, calibrated_epochs
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.testfields import corner_field, demonstration_model

BLOCK = 12


@pytest.fixture
def calibrator(monkeypatch):
    """Return a call for a new calibrator, whose blocks are short."""
    monkeypatch.setattr("thermocald.acquisition.calibrator.EPOCHS_OF_A_BLOCK", BLOCK)
    field = corner_field("plain", per_side=4, pitch_mm=150.0)
    return lambda: Calibrator(demonstration_model(field).sensor, field, nominal_c=3.04)


def seen(calibrator, count):
    """Return epochs of noisy image points."""
    field, rng = calibrator().testfield, np.random.default_rng(3)
    model = demonstration_model(field)
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    image, rows = project(model.sensor, iop, eop, field.points), np.arange(len(field))
    points = image + rng.normal(0, 0.05, (count, *image.shape))
    observations = [Observations(rows, one, np.full(one.shape, 0.05)) for one in points]
    return [Epoch(n, 10.0 * n, 10.0 * n, observations=o) for n, o in enumerate(observations)]


def test_a_late_epoch_or_one_without_targets_is_not_the_one_that_others_repeat(calibrator):
    a, b, c = seen(calibrator, 3)
    nothing = Epoch(0, 0.0, 0.0, observations=Observations.none())
    one, order = calibrator(), [(a, 7), (b, 3), (nothing, 8), (a, 9), (c, 10)]
    done = [one.calibrate(replace(epoch, number=number)).adjustment for epoch, number in order]
    statuses = ["ok", "ok", "no_observations", "repeated_frame", "ok"]
    assert [adjustment.status for adjustment in done] == statuses
    assert "epoch 7" in done[3].reason


def test_processes_do_not_matter_and_a_block_knows_the_frame_before_it(calibrator):
    """A daemon calibrates without blocks, and says of a replayed series what a replay says."""
    epochs = seen(calibrator, 3 * BLOCK + 4)
    epochs[BLOCK] = replace(epochs[BLOCK - 1], number=BLOCK)
    one, two = (list(calibrated_epochs(calibrator(), epochs, jobs)) for jobs in (1, 2))
    assert [done.epoch.number for done in two] == list(range(3 * BLOCK + 4))
    for a, b in zip(one, two, strict=True):
        status = "repeated_frame" if a.epoch.number == BLOCK else "ok"
        assert a.adjustment.status == b.adjustment.status == status
        np.testing.assert_array_equal(b.adjustment.values, a.adjustment.values)
        np.testing.assert_array_equal(b.adjustment.sd, a.adjustment.sd)
    rest = calibrated_epochs(calibrator(), epochs[BLOCK:][:2], 1, before=epochs[BLOCK - 1])
    assert [d.adjustment.status for d in rest] == ["repeated_frame", "ok"]
