"""Every key of `calibration` changes what the daemon stores: one daemon, a camera per key."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.daemon.conftest import fast_run, make_recording, replayed_camera
from tests.store.small import write_recording
from thermocald.config import CalibrationConfig
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.database.store import Store
from thermocald.store.recording.head import Head
from thermocald.store.recording.reader import read_recording

EPOCHS = 12
PLAIN = {"target_offsets": False, "exterior": "per_epoch"}
KEYS = {
    "plain": {},
    "exterior": {"exterior": "series"},
    "free": {"free": ["c", "x0", "y0"]},
    "fixed": {"free": ["c", "x0", "y0"], "fixed": {"A1": 0.002}},
    "priors": {"priors": {"c": {"value": 3.2, "sd": 1e-7}}},
    "sigma_floor_px": {"sigma_floor_px": 0.4},
    "target_offsets": {"target_offsets": True},
    "correlation_bound": {"correlation_bound": 0.6},
    "snooping_alpha": {"snooping_alpha": 0.0},
}


@pytest.fixture(scope="module")
def stored(tmp_path_factory, forker):
    """{key: columns of the series taken with it}; target 7 is 3 px off in all epochs."""
    folder = tmp_path_factory.mktemp("keys")
    taken = read_recording(make_recording(folder / "taken", EPOCHS, per_side=4))
    field = TestField.build(taken.testfield.names, taken.testfield.points, 0.05)

    def spoilt():
        for epoch in taken.epochs:
            points = epoch.observations.points.copy()
            points[7] += 3.0
            yield replace(epoch, observations=replace(epoch.observations, points=points))

    path = folder / "spoilt"
    head = Head("spoilt", "M1", 10.0, taken.camera, taken.head.channels)
    write_recording(path, head, field, spoilt())
    cameras = [
        replayed_camera(path, name=key, calibration={**PLAIN, **changed})
        for key, changed in KEYS.items()
    ]
    document = {"cameras": cameras, "frames": {"keep": "none"}, "store": {"durable": False}}
    run = fast_run(json.dumps(document), EPOCHS)
    assert forker.start(folder, script=run).wait(300.0) == 0
    names = ["status", "sigma0", "n_rejected", "c", "sd_c", "x0", "sd_x0", "A1", "sd_A1", "X0"]
    with Store.open(folder / "thermocald.db") as store:
        found = {s.camera: s for s in store.all_series()}
        for key, changed in KEYS.items():
            assert {**found[key].settings, **changed} == found[key].settings
        in_series = ["series_x0", "sd_series_x0"]
        yield {
            key: store.series_columns(found[key], names + in_series * (key == "exterior"))
            for key in KEYS
        }


def test_every_key_changes_what_is_stored(stored):
    assert set(KEYS) - {"plain"} == set(CalibrationConfig.model_fields)
    plain, series, offsets = stored["plain"], stored["exterior"], stored["target_offsets"]
    assert (plain["status"] == "ok").all()
    assert (plain["n_rejected"] >= 1).all()
    # with one orientation, the principal point of the series has a far smaller sd
    assert series["sd_series_x0"][-1] < 0.5 * plain["sd_x0"][-1]
    assert np.ptp(series["series_x0"][-5:]) < 0.5 * np.ptp(plain["x0"][-5:])
    np.testing.assert_array_equal(series["x0"], plain["x0"])
    assert np.isnan(stored["free"]["sd_A1"]).all()
    assert np.isfinite(plain["sd_A1"]).all()
    assert (stored["fixed"]["A1"] == 0.002).all()
    assert (stored["free"]["A1"] == 0.0).all()
    assert stored["priors"]["c"] == pytest.approx(3.2, abs=1e-4)
    # the sds of the object coordinates stay the same; otherwise it would be a tenth
    assert (stored["sigma_floor_px"]["sigma0"] < 0.4 * plain["sigma0"]).all()
    # errors of the field, the same in every epoch, no longer count as noise of the epoch
    assert np.abs(offsets["c"] - plain["c"])[1:].min() > 0
    assert np.median(offsets["sigma0"]) != pytest.approx(np.median(plain["sigma0"]), rel=0.02)
    assert (stored["correlation_bound"]["status"] == "weak_geometry").all()
    assert (stored["snooping_alpha"]["n_rejected"] == 0).all()
    assert stored["snooping_alpha"]["sigma0"].min() > 2.0 * plain["sigma0"].max()
