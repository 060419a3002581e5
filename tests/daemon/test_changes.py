"""What a daemon makes of a series: changes of the camera, its drift, every key of `calibration`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.daemon.conftest import (
    changed_recording,
    make_recording,
    play,
    replayed_camera,
    results_of,
)
from thermocald.analysis.series.recorded import series_epochs
from thermocald.config import CalibrationConfig
from thermocald.daemon.series_run import START_EPOCHS, drift_columns
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.recording.reader import read_recording
from thermocald.store.sources import StoredRecording

EPOCHS, WHEN = 14, 9
HAPPENS = ("nothing", "knock", "slip", "wrong_lens", "target_moved")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """The store of one daemon with five cameras that see the same until epoch 9."""
    folder = tmp_path_factory.mktemp("changes")
    taken = read_recording(make_recording(folder / "taken", EPOCHS, interval=10.0))
    field, sensor = taken.testfield, taken.camera.sensor
    model = demonstration_model(demonstration_field("markers"))
    iop, eop = model.interior.as_array(), model.exterior.as_array()
    now = {name: (iop.copy(), eop.copy()) for name in HAPPENS}
    now["knock"][1][[0, 3]] += 0.001, 2.0  # 1 mrad, 2 mm
    now["slip"][0][1] += 0.005  # mm: 4.5 px
    now["wrong_lens"][0][0] *= 1.05
    before = project(sensor, iop, eop, field.points)

    def camera(name: str) -> dict:
        shift = project(sensor, *now[name], field.points) - before
        if name == "target_moved":
            shift[11] = 0.0, 2.0
        seen = [(e, e.observations, shift * (e.number >= WHEN)) for e in taken.epochs]
        epochs = (replace(e, observations=replace(o, points=o.points + by)) for e, o, by in seen)
        path = changed_recording(folder / f"{name}-recording", taken, epochs)
        names, calibration = [f"t-{name}"], {"exterior": "series"}
        return replayed_camera(path, name=name, thermometers=names, calibration=calibration)

    with play(folder, [camera(name) for name in HAPPENS], EPOCHS) as played:
        yield played


def test_what_was_stored_is_what_replay_makes_of_it(store):
    """For the late epochs; at an early epoch the daemon does not have the later ones."""
    series = store.find_series("nothing")
    replayed = series_epochs(StoredRecording(store, series), AdjustmentSettings(), "series")
    names = [
        f"{kind}_{n}" for kind in ("series", "sd_series", "level_sd") for n in ("c", "x0", "y0")
    ]
    columns = store.series_columns(series, ["status", *names])
    assert (columns["status"] == np.array(replayed.status)).all()
    values, sd, level = np.array([columns[n][-1] for n in names]).reshape(3, 3)
    assert (np.abs(values - replayed.values[-1, :3]) < 0.05 * sd).all()
    np.testing.assert_allclose(sd, replayed.sd[-1, :3], rtol=0.02)
    np.testing.assert_allclose(level, replayed.level_sd[:3], rtol=0.02)


@pytest.mark.parametrize("what", HAPPENS)
def test_what_changed_is_told_once(store, what):
    """By the second epoch in a row; a target must be elsewhere for longer."""
    series = store.find_series(what)
    told = [(e.kind, e.epoch, e.text) for e in store.events() if e.series == series.id]
    told = [one for one in told if one[0] in (*HAPPENS, "change")]
    when = {"nothing": [], "target_moved": [WHEN + 4]}.get(what, [WHEN + 1])
    assert [one[:2] for one in told] == [(what, epoch) for epoch in when]
    if what == "target_moved":
        assert f"target {series.testfield.names[11]} " in told[0][2]


def test_every_epoch_has_its_own_result_before_and_after_a_knock(store):
    columns = store.series_columns(store.find_series("knock"), ["status", "X0", "sd_X0"])
    assert (columns["status"] == "ok").all()
    moved = columns["X0"][-1] - columns["X0"][WHEN - 2]
    assert moved == pytest.approx(2.0, abs=4 * np.hypot(*columns["sd_X0"][[WHEN - 2, -1]]))


def test_drift_in_pixels_against_the_start(tmp_path, recording):
    """Regression: of a new series, the first epoch counted twice in the start."""
    play(tmp_path, [replayed_camera(recording, name="one")], START_EPOCHS + 1).close()
    told = results_of(tmp_path)
    mean = sum(row["c"] for row in told[:START_EPOCHS]) / START_EPOCHS
    known = [row["drift_c_px"] for row in told if row["drift_c_px"] is not None]
    last = [(row["c"] - mean) / told[0]["pixel_pitch"] for row in told[START_EPOCHS - 1 :]]
    assert np.allclose(known, last, rtol=0, atol=1e-6)


def test_the_sd_holds_against_scatter():
    rng, errors, names = np.random.default_rng(3), [], ("c", "x0", "y0")
    sds = {f"sd_{name}": 2e-4 for name in names}
    for _ in range(400):
        drawn = 3.04 + 2e-4 * rng.normal(size=START_EPOCHS + 1)
        *start, last = ({"status": "ok", **dict.fromkeys(names, c), **sds} for c in drawn)
        drift = drift_columns(last, start, 0.001)
        errors.append(drift["drift_x0_px"] / drift["sd_drift_x0_px"])
    assert 0.9 < np.std(errors) < 1.1
    bad = drift_columns({**last, "status": "no_frame"}, start, 0.001)
    assert np.isnan([value for name, value in bad.items() if "drift" in name]).all()


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
