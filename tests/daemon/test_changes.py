"""Changes of a camera are reported: a knock, a slip, another lens, a moved target."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.daemon.conftest import fast_run, make_recording, replayed_camera
from tests.store.small import write_recording
from thermocald.analysis.series.recorded import series_epochs
from thermocald.photogrammetry.camera.camera_model import project
from thermocald.photogrammetry.epoch.adjustment import AdjustmentSettings
from thermocald.physics.testfields import demonstration_field, demonstration_model
from thermocald.store.database.store import Store
from thermocald.store.recording.head import Head
from thermocald.store.recording.reader import read_recording
from thermocald.store.sources import StoredRecording

EPOCHS, WHEN = 14, 9
HAPPENS = ("nothing", "knock", "slip", "wrong_lens", "target_moved")


@pytest.fixture(scope="module")
def store(tmp_path_factory, forker):
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

    def changed(name: str):
        shift = project(sensor, *now[name], field.points) - before
        if name == "target_moved":
            shift[11] = 0.0, 2.0
        for epoch in taken.epochs:
            seen = epoch.observations
            if epoch.number >= WHEN:
                seen = replace(seen, points=seen.points + shift)
            yield replace(epoch, observations=seen)

    cameras = []
    for name in HAPPENS:
        path = folder / f"{name}-recording"
        head = Head(name, "M1", 10.0, taken.camera, taken.head.channels)
        write_recording(path, head, field, changed(name))
        cameras.append(replayed_camera(
            path, name=name, thermometers=[f"t-{name}"], calibration={"exterior": "series"}
        ))  # fmt: skip
    thermometers = [
        {"name": f"t-{c['name']}", "driver": "replay", "recording": c["recording"]} for c in cameras
    ]
    document = {"cameras": cameras, "thermometers": thermometers, "frames": {"keep": "none"},
                "store": {"durable": False}}  # fmt: skip
    run = fast_run(json.dumps(document), EPOCHS)
    assert forker.start(folder, script=run).wait(300.0) == 0
    with Store.open(folder / "thermocald.db") as opened:
        yield opened


def told(store, name: str) -> list[tuple[str, int]]:
    series = store.find_series(name)
    return [
        (e.kind, e.epoch) for e in store.events() if e.series == series.id
        and e.kind in ("knock", "slip", "wrong_lens", "change", "target_moved")
    ]  # fmt: skip


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


@pytest.mark.parametrize("what", ["nothing", "knock", "slip", "wrong_lens"])
def test_the_second_epoch_in_a_row_tells_what_changed(store, what):
    assert told(store, what) == ([] if what == "nothing" else [(what, WHEN + 1)])


def test_a_moved_target_is_named_once(store):
    assert told(store, "target_moved") == [("target_moved", WHEN + 4)]
    series = store.find_series("target_moved")
    (event,) = [e for e in store.events() if (e.series, e.kind) == (series.id, "target_moved")]
    name = series.testfield.names[11]
    assert f"target {name} " in event.text


def test_every_epoch_has_its_own_result_before_and_after_a_knock(store):
    series = store.find_series("knock")
    columns = store.series_columns(series, ["status", "X0", "sd_X0"])
    assert (columns["status"] == "ok").all()
    moved = columns["X0"][-1] - columns["X0"][WHEN - 2]
    assert moved == pytest.approx(2.0, abs=4 * np.hypot(*columns["sd_X0"][[WHEN - 2, -1]]))
