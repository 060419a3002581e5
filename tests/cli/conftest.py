"""A user's folder, one with series and files that do not go together, and a printed sheet."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest
import yaml

import thermocald as tc
from tests.api.conftest import world
from tests.commands import finish
from tests.photogrammetry.network_cases import convergent_stations
from tests.recordings import read_rows, write_rows
from thermocald.photogrammetry import camera_files
from thermocald.photogrammetry.camera.camera_model import CameraModel, InteriorOrientation, Sensor
from thermocald.photogrammetry.field.testfield import TestField
from thermocald.physics.scene import Scene
from thermocald.store.recording.testfield_file import read_testfield

__all__ = ["world"]


# the board warms and cools at other times than the housing
PROGRAMME = """format: thermocald-programme/1
name: lamp
epochs: 90
interval: 20.0
ambient: 23.0
sources:
  housing: [{from: 0, to: 100, value: 0}, {from: 100, to: 900, value: 10},
            {from: 900, to: 1800, value: 0}]
  board: [{from: 0, to: 350, value: 0.5}, {from: 350, to: 800, value: 3},
          {from: 800, to: 1200, value: 0.8}, {from: 1200, to: 1800, value: 4}]
"""


def changed(source, out, camera=(), channels=(), scale=1):
    """Copy a recording, with changes of its camera, its channels in an order, binned pixels."""
    shutil.copytree(source, out)
    head = yaml.safe_load((out / "recording.yaml").read_text())
    head["camera"] |= dict(camera)
    if channels:
        head["temperatures"] = {name: head["temperatures"][name] for name in channels}
    (out / "recording.yaml").write_text(yaml.safe_dump(head, sort_keys=False))
    if scale > 1:
        rows = read_rows(out / "observations.csv")
        for row in rows:
            row |= {name: f"{(float(row[name]) - 0.5) / scale:.5f}" for name in "xy"}
            row |= {name: f"{float(row[name]) / scale:.5f}" for name in ("sx", "sy")}
        write_rows(out / "observations.csv", rows)


@pytest.fixture(scope="session")
def misfits(world, tmp_path_factory):
    """The user's folder with M3, a model that was not fitted to it, copies of M3 that differ in
    one thing each, and files in which something is wrong.
    """
    folder = tmp_path_factory.mktemp("misfits")
    for path in world.iterdir():
        (folder / path.name).symlink_to(path)
    M3, true = folder / "M3", folder / "true.yaml"
    tc.simulate("rpi-v2.1-heating", own_effects=False, epochs=2, model_out=true)
    (folder / "programme.yaml").write_text(PROGRAMME)
    heated = {"model": true, "programme": folder / "programme.yaml"}
    tc.simulate(**heated, seed=5, out=M3)
    tc.fit(tc.simulate(**heated, seed=6)).save(folder / "model.yaml")
    changed(M3, folder / "other", {"name": "other"})
    changed(M3, folder / "crop", {"width": 3600})
    binned = {"width": 1640, "height": 1232, "pixel_pitch": 0.00224}
    changed(M3, folder / "binned", binned, scale=2)
    changed(M3, folder / "swapped", channels=("board_temperature", "temperature"))
    changed(M3, folder / "board_only", channels=("board_temperature",))
    begin, *_, end = tc.open(M3).frame_time
    files = {
        "idle.yaml": "cameras: [{name: a, driver: mock, series: null}]",
        "colmap.txt": "1 PINHOLE 3280 2464 2700 2700 1640 1232\n",
        "list.json": '["thermocald-calibration/1"]',
        "notes.txt": "a gauge",
        "d.csv": "a,b,length,sigma\nR65,R71,100,0.1\nR65,R75,much,0.1\n",
        "p.csv": f"time,x,y\n{begin + 60:.1f},500,400\n",
        "images.csv": f"time,image\n{begin + 60:.1f},small.png\n",
        "late.csv": f"time,image\n{end + 9e4:.1f},small.png\n",
        "elsewhere.csv": f"time,x,y\n{begin + 60:.1f},5000,5\n",
        "no_y.csv": f"time,x\n{begin + 60:.1f},5\n",
        "five.csv": f"time,x,y\n{begin + 60:.1f},five,5\n",
        "unzoned.csv": "time,x,y\n2026-06-14T12:00:30,5,6\n",
        "one_reading.csv": f"time,t\n{begin:.1f},20\n",
        "backwards.csv": "time,t\n9,20\n5,20\n",
        "no_time.csv": "when,t\n9,20\n",
        "fahrenheit.csv": f"time,air\n{begin:.1f},86\n{end:.1f},92\n",
        "hot.csv": f"time,air\n{begin:.1f},160\n{end:.1f},170\n",
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    cv2.imwrite(str(folder / "small.png"), np.zeros((480, 640), np.uint8))
    camera = CameraModel(Sensor(3280, 2464, 0.00112), InteriorOrientation(3.04))
    for name, covariance in (("none", None), ("free", np.diag([1e-8] + 9 * [0.0]))):
        camera_files.write(camera, folder / f"{name}.json", "json", covariance, "", "rpi-v2.1")
    return folder


@pytest.fixture(scope="session")
def sheet(tmp_path_factory):
    """A folder with testfield.csv of an A3 sheet, a little bent, and eight photos of it.

    With it, the true field, the camera, and two targets and their distance.
    """
    folder = tmp_path_factory.mktemp("survey")
    finish(
        "testfield", "print", "--paper", "A3", "--flat", "--landscape", "--diameter", 12, "--out",
        folder,
    )  # fmt: skip
    field = read_testfield(folder / "testfield.csv")
    points = field.points.copy()
    points[:, 2] = 3e-5 * (points[:, 0] - 200) ** 2
    truth = TestField.build(field.names, points, 0.0, field.diameters, field.kinds, field.codes)
    model = CameraModel(Sensor(1640, 1232, 0.00224), InteriorOrientation(3.05, 0.02, -0.01, -2e-3))
    scene = Scene(model.sensor, truth)
    (folder / "photos").mkdir()
    for i, station in enumerate(convergent_stations(points, 8, distance=440.0)):
        frame = scene.render(model.interior.as_array(), station.as_array(), seed=i)
        cv2.imwrite(str(folder / f"photos/{i}.jpg"), frame, [cv2.IMWRITE_JPEG_QUALITY, 95])
    far = (points[:, 0] > 300) & (points[:, 1] < 80)
    a, b = "R65", next(n for n in np.array(truth.names)[far].tolist() if n.startswith("R"))
    length = np.linalg.norm(points[truth.index[a]] - points[truth.index[b]])
    return folder, truth, model, (a, b, f"{length:.4f}")
