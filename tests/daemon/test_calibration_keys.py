"""Every key of `calibration` changes what the daemon stores: one daemon, a camera per key."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.daemon.conftest import changed_recording, make_recording, play, replayed_camera
from thermocald.config import CalibrationConfig
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.store.recording.reader import read_recording

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


def test_every_key_changes_what_is_stored(tmp_path):
    """Target 7 is 3 px off in all epochs."""
    assert set(KEYS) - {"plain"} == set(CalibrationConfig.model_fields)
    taken = read_recording(make_recording(tmp_path / "taken", 12, per_side=4))
    field = TestField.build(taken.testfield.names, taken.testfield.points, 0.05)
    off = np.where(np.arange(len(field)) == 7, 3.0, 0.0)[:, None]
    seen = [(e, e.observations) for e in taken.epochs]
    epochs = (replace(e, observations=replace(o, points=o.points + off)) for e, o in seen)
    path = changed_recording(tmp_path / "spoilt", taken, epochs, field)
    cameras = [replayed_camera(path, name=k, calibration=PLAIN | KEYS[k]) for k in KEYS]
    names = ["status", "sigma0", "n_rejected", "c", "x0", "sd_x0", "A1", "sd_A1"]
    with play(tmp_path, cameras, 12) as store:
        found = {s.camera: s for s in store.all_series()}
        stored = {key: store.series_columns(found[key], names) for key in KEYS}
        series = store.series_columns(found["exterior"], ["series_x0", "sd_series_x0"])
    assert all(KEYS[key].items() <= found[key].settings.items() for key in KEYS)
    plain, offsets = stored["plain"], stored["target_offsets"]
    assert (plain["status"] == "ok").all()
    assert (plain["n_rejected"] >= 1).all()
    # with one orientation, the principal point of the series has a far smaller sd
    assert series["sd_series_x0"][-1] < 0.5 * plain["sd_x0"][-1]
    assert np.ptp(series["series_x0"][-5:]) < 0.5 * np.ptp(plain["x0"][-5:])
    np.testing.assert_array_equal(stored["exterior"]["x0"], plain["x0"])
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
