"""Changes of a camera are reported: a knock, a slip, another lens, a moved target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.daemon.conftest import changed_recording, make_recording, play, replayed_camera
from thermocald.analysis.series.recorded import series_epochs
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
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
