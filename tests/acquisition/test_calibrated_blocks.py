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


def test_a_repeated_frame_is_no_new_observation(calibrator):
    a, b, c = seen(calibrator, 3)
    nothing = Epoch(7, 0.0, 0.0, observations=Observations.none())
    again = [replace(epoch, number=n) for n, epoch in enumerate([nothing, a, a, a, b, nothing, c])]
    done = list(calibrated_epochs(calibrator(), again))
    same, none = "repeated_frame", "no_observations"
    statuses = [none, "ok", same, same, "ok", none, "ok"]
    assert [d.adjustment.status for d in done] == statuses
    assert "epoch 1" in done[3].adjustment.reason
    assert [d.epoch.observations is None for d in done[2:5]] == [True, True, False]
    # an epoch that is calibrated late is not the last one
    one, late = calibrator(), [(a, 7), (b, 3), (a, 8), (c, 9)]
    statuses = [one.calibrate(replace(e, number=n)).adjustment.status for e, n in late]
    assert statuses == ["ok", "ok", same, "ok"]


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
