"""Epochs calibrated in blocks: the same bits on any number of processes."""

import numpy as np

from thermocald.acquisition.calibrator import EPOCHS_OF_A_BLOCK, Calibrator, calibrated_epochs
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.testfields import corner_field, demonstration_model

EPOCHS = EPOCHS_OF_A_BLOCK + 40


def test_processes_do_not_matter():
    field = corner_field("plain", per_side=4, pitch_mm=150.0)
    model, rng = demonstration_model(field), np.random.default_rng(3)
    image = project(
        model.sensor, model.interior.as_array(), model.exterior.as_array(), field.points
    )
    epochs = []
    for number in range(EPOCHS):
        points = image + rng.normal(0, 0.05, image.shape)
        seen = Observations(np.arange(len(field)), points, np.full(points.shape, 0.05))
        epochs.append(Epoch(number, 10.0 * number, 10.0 * number, {}, observations=seen))
    one, two = (
        list(calibrated_epochs(Calibrator(model.sensor, field, nominal_c=3.04), epochs, jobs))
        for jobs in (1, 2)
    )
    assert [done.epoch.number for done in two] == list(range(EPOCHS))
    for a, b in zip(one, two, strict=True):
        assert a.adjustment.ok
        np.testing.assert_array_equal(b.adjustment.values, a.adjustment.values)
        np.testing.assert_array_equal(b.adjustment.sd, a.adjustment.sd)
