"""Epochs calibrated in blocks: the same bits on any number of processes."""

from dataclasses import replace

import numpy as np
import pytest

from thermocald.acquisition import calibrator as module
from thermocald.acquisition.calibrator import Calibrator, calibrated_epochs
from thermocald.epoch import Epoch
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.physics.testfields import corner_field, demonstration_model

BLOCK = 12


@pytest.fixture(autouse=True)
def _short_blocks(monkeypatch):
    monkeypatch.setattr(module, "EPOCHS_OF_A_BLOCK", BLOCK)


def scene(count):
    """Return a calibrator and epochs of noisy image points."""
    field = corner_field("plain", per_side=4, pitch_mm=150.0)
    model, rng = demonstration_model(field), np.random.default_rng(3)
    image = project(
        model.sensor, model.interior.as_array(), model.exterior.as_array(), field.points
    )
    epochs = []
    for number in range(count):
        points = image + rng.normal(0, 0.05, image.shape)
        seen = Observations(np.arange(len(field)), points, np.full(points.shape, 0.05))
        epochs.append(Epoch(number, 10.0 * number, 10.0 * number, {}, observations=seen))
    return lambda: Calibrator(model.sensor, field, nominal_c=3.04), epochs


def test_a_repeated_frame_is_no_new_observation():
    calibrator, (a, b, c) = scene(3)
    nothing = Epoch(7, 0.0, 0.0, {}, observations=Observations.none())
    again = [replace(epoch, number=n) for n, epoch in enumerate([nothing, a, a, a, b, nothing, c])]
    done = list(calibrated_epochs(calibrator(), again))
    same, none = "repeated_frame", "no_observations"
    statuses = [none, "ok", same, same, "ok", none, "ok"]
    assert [d.adjustment.status for d in done] == statuses
    assert "epoch 1" in done[3].adjustment.reason
    assert [d.epoch.observations is None for d in done[2:5]] == [True, True, False]


def test_an_epoch_that_is_calibrated_late_is_not_the_last_one():
    calibrator, (a, b, c) = scene(3)
    one = calibrator()
    late = [replace(a, number=7), replace(b, number=3), replace(a, number=8), replace(c, number=9)]
    statuses = [one.calibrate(epoch).adjustment.status for epoch in late]
    assert statuses == ["ok", "ok", "repeated_frame", "ok"]


def test_processes_do_not_matter_and_a_block_knows_the_frame_before_it():
    """A daemon calibrates without blocks, and says of a replayed series what a replay says."""
    calibrator, epochs = scene(3 * BLOCK + 4)
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
