"""The front door as described in API.md, line by line, and every example of its docstrings."""

from __future__ import annotations

import doctest
import importlib
import inspect
import json
import pickle
import re
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import thermocald as tc
from tests.golden.workshop import PROGRAMME
from tests.marks import mostly_slow
from tests.recordings import read_rows
from thermocald.discovery.plan import Plan
from thermocald.errors import ConfigurationError, DataError, RecordingError, StoreError, UsageError
from thermocald.result import jsonable

DOCUMENTED = (
    "api", "series", "results", "analysis.series.epochs", "analysis.camera.camera",
    "analysis.thermal.thermal_camera", "toolbox",
)  # fmt: skip


# tests/golden runs the commands on the same series
SLOW = ("api.calibrate", "api.discover", "api.study", "series.Series.calibrate")


def examples():
    found = []
    for name in DOCUMENTED:
        module = importlib.import_module(f"thermocald.{name}")
        found += [t for t in doctest.DocTestFinder().find(module, globs={"tc": tc}) if t.examples]
    slow = pytest.mark.slow
    return [pytest.param(t, marks=slow if t.name.endswith(SLOW) else (), id=t.name) for t in found]


@pytest.mark.parametrize("example", examples())
def test_an_example_of_a_docstring(inside, example, epochs, monkeypatch):
    if "board" in example.docstring and not (inside / "board").is_dir():
        pytest.skip("the reference data are absent")
    for library in ("pandas", "xarray"):
        if f"to_{library}" in example.docstring:
            pytest.importorskip(library)
    if not example.name.endswith(SLOW) and 'tc.open("M1").calibrate()' in example.docstring:
        monkeypatch.setattr(tc.Series, "calibrate", lambda _: epochs)  # adjusted once for all
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    assert runner.run(example, out=said.append).failed == 0, "".join(said)


def test_every_public_function_has_an_example():
    names = {example.id.rsplit(".", 1)[-1] for example in examples()}
    functions = {n for n in tc.__all__ if n[0].islower()} - {"reference_study"}

    assert functions <= names


def test_a_store_and_its_recording_are_the_same_series(inside, short):
    kept = tc.open("thermocald.db")
    (other,) = tc.open_all("thermocald.db")

    assert (kept.camera, kept.name, len(kept)) == (short.camera, short.name, len(short))
    np.testing.assert_array_equal(kept.time, short.time)
    assert short.time.dtype == np.dtype("datetime64[us]")
    np.testing.assert_allclose(kept.temperature, short.temperature)
    assert repr(other) == repr(kept)
    a, b = kept.calibrate(exterior="series"), short.calibrate(exterior="series")
    np.testing.assert_allclose(a.values, b.values, rtol=1e-6)
    with pytest.raises(StoreError, match=r"camera/series in this store: rpi-v2\.1/M1"):
        tc.open("thermocald.db", "M7")
    with pytest.raises(StoreError, match="is not a store; give a recording's folder or a store"):
        tc.open("M1/epochs.csv")


def test_photographs_become_a_series(inside, tmp_path):
    told = {"log": "logger.csv", "timezone": "Europe/Berlin", "testfield": "M1/testfield.csv",
            "pixel_pitch": 0.00112}  # fmt: skip
    here = tc.import_photographs("photos", **told)
    there = tc.import_photographs("photos", **told, out=tmp_path / "P1")

    assert len(here) == len(there) == 6
    assert here.source == "photos"  # messages named it `.`
    np.testing.assert_allclose(here.temperature, there.temperature)
    np.testing.assert_array_equal(here.time, there.time)
    assert (tmp_path / "P1" / "frames").is_dir()


def test_epochs_are_columns_with_covariance(epochs):
    assert epochs.values.shape == epochs.sd.shape == (150, 16)
    assert epochs.covariance.shape == (150, 16, 16)
    np.testing.assert_array_equal(epochs.c, epochs.values[:, 0])
    np.testing.assert_array_equal(epochs.sd_Z0, epochs.sd[:, 15])
    variance = np.diagonal(epochs.covariance, axis1=1, axis2=2)
    there = np.isfinite(epochs.sd)
    np.testing.assert_allclose(np.sqrt(variance[there]), epochs.sd[there], rtol=1e-12)
    with pytest.raises(AttributeError, match="no 'focal'"):
        _ = epochs.focal


def test_bands_of_drawings_hold_95_percent(epochs, camera):
    bars = epochs.plot().axes[0].collections[0].get_segments()
    drawn = np.array([bar[1, 1] - bar[0, 1] for bar in bars])
    np.testing.assert_allclose(drawn, 2 * 1.96 * 1e3 * epochs.sd_c[epochs.ok])
    axis = camera.plot().axes[1]
    outline = axis.collections[0].get_paths()[0].vertices
    first = outline[np.isclose(outline[:, 0], axis.lines[0].get_xdata()[0]), 1]
    cold = [float(outline[:, 0].min())]
    since_T0 = camera.along([0.0], cold, relative_to=camera.model.T0)  # the level's sd cancels
    np.testing.assert_allclose(np.ptp(first), 2 * 1.96 * 1e3 * since_T0.sd[0, 1], rtol=1e-6)


def test_epochs_as_a_dataset_written_and_read(epochs, tmp_path):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    data = epochs.to_xarray()
    data.to_netcdf(tmp_path / "M1.nc", engine="h5netcdf")

    with xarray.open_dataset(tmp_path / "M1.nc", engine="h5netcdf") as read:
        xarray.testing.assert_allclose(read.drop_vars("status"), data.drop_vars("status"), rtol=0)
        assert read.attrs == data.attrs
        assert read.x0.attrs["units"] == "mm"
        assert list(read.status.values) == list(data.status.values)
        assert set(read.coords) == {"epoch", "time", "temperature", "parameter", "parameter_2"}
        assert read.covariance.dims == ("epoch", "parameter", "parameter_2")


RESULTS = {
    "Epochs": lambda epochs, camera, M1, M2: epochs,
    "Study": lambda *_: tc.study(tc.open("short"), sets=200, f_number=2.0),
    "ThermalCamera": lambda epochs, camera, M1, M2: camera,
    "Camera": lambda epochs, camera, M1, M2: camera.at(35.0),
    "CameraDifference": lambda *_: tc.compare_cameras("cold.json", "warm.json"),
    "Catalogue": lambda *_: tc.catalogue(),
    "Conversion": lambda *_: tc.convert_camera("cold.json", "cold.ior", "aicon"),
    "Correction": lambda epochs, camera, M1, M2: tc.correct("points.csv", camera, log="M1"),
    "Discovery": lambda epochs, camera, M1, M2: tc.discover(M1, verify=[M2]),
    "Calibration": lambda *_: tc.calibrate("photos", "M1/testfield.csv"),
    "FieldCheck": lambda epochs, camera, M1, M2: tc.check_testfield(M1.testfield),
    "Plan": lambda *_: Plan({"thermal_lag": {"thermal_lag or time_offset": 1}}, 1, 0.1),
    "Prediction": lambda epochs, camera, M1, M2: tc.predict(camera, log="M1"),
}


@pytest.mark.parametrize("name", mostly_slow(RESULTS, *(set(RESULTS) - {"Discovery"})))
def test_one_result_prints_documents_draws_and_reports(
    name, inside, epochs, camera, M1, M2, tmp_path, request
):
    if name == "Study":  # tests/output looks at its many drawings
        request.getfixturevalue("undrawn")
    result = RESULTS[name](epochs, camera, M1, M2)
    assert re.fullmatch(rf"<{name}: (?!.*at 0x).{{4,200}}>", repr(result))
    assert str(result) == "\n".join(result.lines())
    assert json.loads(json.dumps(jsonable(result.as_dict()), allow_nan=False))
    assert result._repr_html_().startswith("<pre>")
    page = result.report(tmp_path / "report.html").read_text()
    assert ("Interior orientation" in page) is (name == "ThermalCamera")  # its certificate
    if name in ("Catalogue", "Conversion", "Correction", "Plan"):
        with pytest.raises(UsageError, match="has no drawing"):
            result.plot()
    else:
        result.plot().savefig(tmp_path / "drawn.png")
    if name == "Correction":
        for _ in range(2):  # the second counts anew
            result.write(tmp_path / "corrected.csv")
        assert (result.points, result.extrapolated_rows) == (2, 0)
        rows = read_rows(tmp_path / "corrected.csv")
        moved = np.array([[float(row[key]) for key in ("dx", "dy")] for row in rows])
        rms = result.as_dict()["rms_correction_px"]
        assert rms == pytest.approx(np.sqrt(np.mean(moved**2)), rel=1e-4)
        with pytest.raises(UsageError, match="would be overwritten"):
            result.write("points.csv")
        again = tc.correct(tmp_path / "corrected.csv", camera, log="M1")
        with pytest.raises(DataError, match=r"column dx would occur twice.*corrected already"):
            again.write(tmp_path / "again.csv")
    if name == "Discovery":
        assert result.verdict == "effects_found"
        result.save(tmp_path / "found.yaml")
        assert tc.load_camera(tmp_path / "found.yaml").model.effects


def test_a_camera_at_a_temperature(camera, tmp_path):
    import cv2

    now = camera.at(35.0)
    pose = tc.ExteriorOrientation(0.1, -0.05, 0.02, 10.0, 20.0, 900.0)
    X = np.array([[0.0, 0.0, 0.0], [100.0, -80.0, 20.0], [-150.0, 60.0, -30.0]])
    image = now.project(X, pose)
    np.testing.assert_allclose(image, now.project(X, pose.as_array()))

    K, distortion = now.opencv()
    inside = (X - [10.0, 20.0, 900.0]) @ pose.rotation * [1, -1, -1]
    theirs, _ = cv2.projectPoints(inside, np.zeros(3), np.zeros(3), K, distortion)
    np.testing.assert_allclose(theirs[:, 0], image, atol=1e-6)

    with pytest.raises(UsageError, match="does not tell the format"):
        now.write(tmp_path / "camera.yaml")


def test_a_warning_names_the_user_s_line(camera):
    with pytest.warns(match="are widened") as told:
        camera.at(52.0)
    assert told[0].filename == __file__


def test_a_model_and_a_programme_are_simulated(inside, tmp_path):
    programme = tmp_path / "programme.yaml"
    programme.write_text(PROGRAMME)
    series = tc.simulate(model="camera.yaml", programme=programme, testfield="plain", seed=3)
    assert series.truth.shape == (len(series), 10)
    np.testing.assert_allclose(series.truth[0], series.simulation.truth.iop[0])


def imported(**more):
    return tc.import_photographs("photos", log="logger.csv", **more)


def simulated(**more):
    return tc.simulate("nexus5-cold", **more)


FIELD, MODEL = "M1/testfield.csv", "camera.yaml"
ONE, TWICE = {"cold.json": "26"}, {"cold.json": 9.0, "./cold.json": 26.0}
OUT_OF_BOUNDS = {
    "window is -1": lambda M1: tc.study(M1, window=-1),
    "clusters_mm is 3; it must be a list .each": lambda M1: tc.reference_study(clusters_mm=3),
    "grid is 0; it must be from 2 to 9": lambda M1: tc.study(M1, grid=0),
    "2 labels for 1 series": lambda M1: tc.study(M1, labels=["a", "b"]),
    "M1 is given twice; give each": lambda M1: tc.fit(M1, M1),
    "T0 is nan": lambda M1: tc.fit(M1, T0=np.nan),
    "jobs is 999; it must be from 1 to 256": lambda M1: M1.calibrate(jobs=999),
    "calibrations is {'cold.json': '26'}": lambda M1: tc.fit_calibrations(ONE),
    r"place is \(1, 2\); it must be a tuple": lambda M1: tc.check_testfield(FIELD, place=(1, 2)),
    "c is given twice": lambda M1: M1.calibrate(free="c,x0,c"),
    r"free is \['c', 0\]": lambda M1: M1.calibrate(free=["c", 0]),
    "give one set-up": lambda M1: tc.plan(M1, preset="nexus5-cold"),
    "give one set-up: a": lambda _: tc.plan(preset="nexus5-cold", model=MODEL),
    "~no one/x: does not exist": lambda _: tc.open("~no one/x"),
    "give a programme too": lambda _: tc.predict(MODEL, 35.0, camera="cold.json"),
    "interior: is a calibrated": lambda _: tc.predict(MODEL, programme="p", camera="cold.json"),
    "--exterior zz": lambda M1: M1.measured(exterior="zz"),
    "give finite": lambda M1: simulated(lamp=[(0, float("nan"))]),
    "in the order of time": lambda M1: simulated(lamp=[(9, 1), (0, 3)]),
    "temperature is nan": lambda M1: tc.predict(MODEL, np.nan),
    "size 9×0 px is impossible": lambda M1: tc.correct("x.csv", MODEL, log="M1", size=(9, 0)),
    "at least two calibrations": lambda M1: tc.fit_calibrations({}),
    "holds the same camera as c": lambda _: tc.fit_calibrations(TWICE),
    "warm.json: at which": lambda _: tc.fit_calibrations({"cold.json": 9.0, "warm.json": np.inf}),
    "sigma_px is 0": lambda M1: tc.check_testfield(FIELD, sigma_px=0.0),
    "roll is nan": lambda M1: tc.check_testfield(FIELD, roll=np.nan),
    "principal_distance is 0": lambda M1: imported(principal_distance=0.0),
    "testfield is missing": lambda M1: imported(out="new"),
    "there is no 'timezon'": lambda M1: imported(log_options={"timezon": "UTC"}),
    "there is no column 'T 1'": lambda M1: imported(
        timezone="UTC", log_options={"timezone": "UTC", "temperature_column": "T 1"}
    ),
    "unit is 3; it must be text": lambda M1: imported(log_options={"unit": 3}),
    "channels belong to a temperature": lambda M1: tc.predict(
        MODEL, log="M1", channels={"temperature": 30.0}
    ),
}
TIMES, HOT = [0.0, 60.0, 120.0], [25.0, 30.0, 35.0]
SEEN = {"target": "abcd", "x": [900, 2400, 2300, 1000], "y": [700, 800, 1900, 1700],
        "sx": [0.3] * 4, "sy": [0.3] * 4}  # fmt: skip
FEW = {name: list(column)[:2] for name, column in SEEN.items()}
HIDDEN = np.ma.masked_array(TIMES, [False, True, False])
POINT = [[0, 0, -1e3]]


def resected(c, seen):
    corners = [[0, 0, 0], [800, 0, 0], [800, 600, 0], [0, 600, 100]]
    return c.at(35.0).resect(tc.TestField.build("abcd", corners), seen)


def on_floor(c, point, sigma=0.0):
    return c.at(35.0).on_plane([[900, 700]], [0.0] * 6, tc.Plane(point, [0, 0, 1]), sigma)


def fed(c):
    """Return the live camera after a reading."""
    live = c.live()
    live.update(0.0, 30.0)
    return live


FRAME = np.zeros((2464, 3280), np.uint8)
OF_A_CAMERA = {
    "to is 'image'; it must be an Int": lambda c: c.at(35.0).undistort([[1, 2]], to="image"),
    "give one time": lambda c: c.live().update([0.0, 60.0], 30.0),
    "distance_mm is -1": lambda c: c.at(35.0).object_error(-1),
    r"image points: must be an array \(n, 2\)": lambda c: c.at(35.0).undistort([1, 2, 3]),
    r"normal is \[0, 0, 0\]; it must be three": lambda c: tc.Plane([0, 0, 0], [0, 0, 0]),
    "at least two points": lambda c: tc.Profile([[0, 0, 0]]),
    "plane has 2 rows for 1 image": lambda c: on_floor(c, [[0, 0, -1e3]] * 2),
    "sigma must be 0 or above": lambda c: on_floor(c, [0, 0, -1e3], -1.0),
    "sigma: give one number, or": lambda c: on_floor(c, [0, 0, -1e3], [1.0, 2.0, 3.0]),
    "plane is 'water'; it must be a P": lambda c: c.at(35.0).on_plane(POINT, [0.0] * 6, "water"),
    "points and sigmas must be numbers": lambda c: tc.TestField.build(["a"], [[1.0, 2.0]]),
    "points must be finite": lambda c: tc.TestField.build(["a"], [[1.0, 2.0, np.nan]]),
    "need the lists target, x, y, sx": lambda c: resected(c, [[1.0, 2.0]]),
    "a target is given twice": lambda c: resected(c, SEEN | {"target": ["a"] * 4}),
    "'z' was measured but is not in": lambda c: resected(c, SEEN | {"target": "abcz"}),
    "sx, sy above 0": lambda c: resected(c, SEEN | {"sx": [0.0] * 4}),
    "no pose .too_few_targets.: 2": lambda c: c.at(35.0).project(POINT, resected(c, FEW)),
    "the pose: must be": lambda c: c.at(35.0).project(POINT, None),
    "px of 8.96 µm cannot be comp": lambda c: c.at(35.0).object_distance(
        c.for_images(410, 308).at(35.0), 1e4
    ),
    "no thermometer 'foo'; it knows": lambda c: tc.predict(c, 35.0, channels={"foo": 1.0}),
    "of board_temperature is nan": lambda c: c.at(35.0, channels={"board_temperature": np.nan}),
    "times run backwards": lambda c: c.along(TIMES[::-1], HOT),
    "a time is not known": lambda c: c.along(["noon"] * 3, HOT),
    "a time is not known: .* datetime64": lambda c: c.along(HIDDEN, HOT),
    "not known: give s since": lambda c: c.along(TIMES, HOT, since=np.nan),
    "1 of 1 times are outside": lambda c: c.along(TIMES, HOT, since=1000.0),
    "temperature is inf": lambda c: fed(c).correct(FRAME, to=np.inf),
    "an array .H, W. or .H, W, c": lambda c: fed(c).correct(np.zeros((2464, 3280, 3, 2), np.uint8)),
    "a temperature is no number": lambda c: c.along(TIMES, "hot"),
    "temperature is {'board': '30'}": lambda c: c.live().update(0.0, {"board": "30"}),
    "the frame is list: give an array": lambda c: c.live().correct([[1, 2], [3, 4]]),
    "no reading yet": lambda c: c.live().correct(FRAME),
    "to one run: make another": lambda c: pickle.dumps(fed(c)),
    "not later than the last reading": lambda c: fed(c).update(0.0, 30.0),
    r"live\(size=\(3280, 1000\)\)": lambda c: fed(c).correct(FRAME[:1000]),
    "frame of bool cannot be resampled": lambda c: fed(c).correct(FRAME > 0),
    "K outside the": lambda c: fed(c).update(1.0, 150.0),
    "1 of 2 times are outside the temp": lambda c: c.along(TIMES, HOT, at=[30.0, 1e6]),
}


# arrays and times, whose content is checked where they are used
ANY = {
    "at", "centre", "changes", "codes", "diameters", "epochs", "frame", "image_points",
    "interior", "kinds", "names", "numbers", "offsets", "plane", "points", "pose", "R", "rows",
    "seen", "settings", "sigma", "sigmas", "since", "temperatures", "time", "times", "values",
}  # fmt: skip


def test_every_argument_is_checked():
    """Of every public function and method, but for arrays and times."""
    named = {name: getattr(tc, name) for name in tc.__all__}
    for name, one in list(named.items()):
        if isinstance(one, type):
            named |= {f"{name}.{m}": getattr(one, m) for m in dir(one) if m[0] != "_"}
    found = set()
    for function in filter(lambda f: inspect.isfunction(f) or inspect.ismethod(f), named.values()):
        for argument in inspect.signature(function).parameters.keys() - {"self"} - ANY:
            found.add(argument)
            with pytest.raises(UsageError, match=f"^{argument} is <object .*; it must be "):
                function(**{argument: object()})
    assert len(found) > 60


@pytest.mark.parametrize("message", OUT_OF_BOUNDS)
def test_an_argument_out_of_bounds_is_refused(inside, M1, message):
    with pytest.raises((UsageError, DataError, ConfigurationError), match=message):
        OUT_OF_BOUNDS[message](M1)


def test_temperatures_of_a_model_are_printed_with_a_minus_sign_or_not_at_all(camera):
    cold = replace(camera.model, T0=-21.94, validity={"temperature": (-35.0, -9.9)})
    assert "from −35 to −9.9 °C, T0 = −21.94 °C" in str(replace(camera, model=cold))
    assert str(replace(camera, model=cold).at(-20)).startswith("rpi-v2.1 at −20 °C\n")
    assert "nan" not in str(replace(camera, model=replace(camera.model, validity={})))


@pytest.mark.parametrize("message", OF_A_CAMERA)
def test_what_no_camera_can_answer_is_refused(camera, message):
    with pytest.raises((UsageError, DataError, ConfigurationError), match=message):
        OF_A_CAMERA[message](camera)


def test_numbers_and_paths_are_taken_as_notebooks_hold_them(inside, M1, camera):
    """Scalars, rows and columns of NumPy, an iterator of files; functions are found by pickle."""
    assert tc.predict(camera, np.float64(35.0)).document["temperature"] == 35.0
    assert jsonable(tc.predict(camera, np.float32(35.0)).as_dict())["temperature"] == 35.0
    lag = {"thermal_lag": {"tau": np.int64(75)}}
    for lamp in (np.array([[0.0, 1.0], [60.0, 2.0]]), zip([0.0, 60.0], [1.0, 2.0], strict=True)):
        given = {"lamp": lamp, "epochs": np.int64(3), "seed": np.int64(3), "effects": lag}
        assert len(tc.simulate("nexus5-cold", **given)) == 3
    told = {"log": "logger.csv", "timezone": "UTC", "testfield": M1.testfield, "pixel_pitch": 0.001}
    assert len(tc.import_photographs(Path("photos").glob("*.jpg"), **told)) == 6
    assert pickle.loads(pickle.dumps(tc.study)) is tc.study


def test_what_is_saved_at_home_is_found_there(epochs, camera, tmp_path, monkeypatch):
    """A folder called ~ was made."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for write in (epochs.to_csv, camera.save, camera.at(35.0).report):
        write("~/saved.yaml")
        (tmp_path / "saved.yaml").unlink()


def test_times_of_pandas_with_and_without_a_zone(camera):
    """Each is UTC, a difference of times too, and no time is invented for an unknown one."""
    pandas = pytest.importorskip("pandas")
    plain = pandas.date_range("2020-07-01 12:00", periods=3, freq="min")
    berlin = plain.tz_localize("UTC").tz_convert("Europe/Berlin")
    wanted = 1593604800.0 + np.array([0.0, 60.0, 120.0])
    texts = [time.isoformat() for time in berlin]
    for times in (berlin, pandas.Series(berlin), list(berlin), berlin.to_pydatetime(), texts):
        np.testing.assert_array_equal(camera.along(times, HOT).times, wanted)
        assert camera.live().update(times[0], 30.0).temperature == 30.0
    np.testing.assert_array_equal(camera.along(plain, HOT).times, wanted)
    np.testing.assert_array_equal(camera.along(plain - plain[0], HOT).times, wanted - wanted[0])
    with pytest.raises(UsageError, match="a time is not known"):
        camera.along([plain[0], plain[1], pandas.NaT], HOT)


def test_one_image_point_is_an_array_of_one(camera):
    now = camera.at(35.0)
    for method in (now.undistort, now.rays, now.point_covariance):
        np.testing.assert_array_equal(method([9.0, 90.0]), method([[9.0, 90.0]]))
    np.testing.assert_array_equal(now.project(POINT[0], [0.0] * 6), now.project(POINT, [0.0] * 6))
    assert fed(camera).correct(FRAME[..., None]).shape == (*FRAME.shape, 1)


def test_a_course_is_sliced_and_a_camera_is_a_key(camera):
    along = camera.along(TIMES, HOT, since=np.datetime64(0, "s"))
    for part in (along[1:], along[[1, 2]], along[along.temperatures > 25.0]):
        np.testing.assert_array_equal(part.sd, along.sd[1:])
    assert repr(along[:0]) == "<Along rpi-v2.1: 0 times>"
    assert {camera: 1}[pickle.loads(pickle.dumps(camera))] == 1


def test_a_copy_is_no_second_measurement(short, M2, inside, tmp_path):
    """Neither a copied folder nor the store of the same recording, nor one under another name."""
    shutil.copytree("short", tmp_path / "again")
    renamed = tc.simulate("rpi-v2.1-heating", seed=3, epochs=24, series="M3", out=tmp_path / "M3")
    for copy in (tc.open(tmp_path / "again"), tc.open("thermocald.db")):
        with pytest.raises(DataError, match="holds the same observations as"):
            tc.fit(short, copy)
    with pytest.raises(DataError, match=r"M3 holds the same observations as .*short"):
        tc.discover(short, verify=[M2, renamed])
    for others in ([M2, short], [M2, renamed, tc.open(M2.source)]):
        with pytest.raises(UsageError, match="give each series once"):
            tc.discover(short, verify=others)
    with pytest.raises(DataError, match="has the same epochs as"):
        tc.study(short, tc.open("thermocald.db"))


def test_a_recording_that_is_gone_is_named(inside, tmp_path):
    moved = tc.open(shutil.copytree("M1", tmp_path / "moved"))
    shutil.rmtree(tmp_path / "moved")
    for use in (moved.calibrate, moved.doubts, lambda: tc.fit(moved)):
        with pytest.raises(RecordingError, match=r"observations.csv: cannot be read"):
            use()


def test_epochs_are_pickled_whole(epochs):
    again = pickle.loads(pickle.dumps(epochs))
    assert str(again) == str(epochs)
    np.testing.assert_array_equal(again.covariance, epochs.covariance)


def test_the_import_costs_nothing():
    """It needs no NumPy and less than 30 ms of processor time (median of five)."""
    program = (
        "import sys, time; a = time.process_time(); import thermocald; "
        "print(time.process_time() - a, 'numpy' in sys.modules)"
    )
    command = [sys.executable, "-c", program]
    runs = [subprocess.check_output(command, text=True).split() for _ in range(5)]
    assert {numpy for _, numpy in runs} == {"False"}
    assert sorted(float(seconds) for seconds, _ in runs)[2] < 0.030


def test_a_script_of_a_user_runs(tmp_path, monkeypatch):
    """From a recording to files of ROS at 10 and 40 °C; `make lint` has mypy look at its types."""
    script = Path(__file__).with_name("user_script.py")
    tc.simulate("rpi-v2.1-heating", epochs=20, out=tmp_path / "short")
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path / "short"), str(tmp_path)])
    with pytest.warns(match="standard deviations are widened"):
        runpy.run_path(str(script), run_name="__main__")
    files = {path.name: path.read_text() for path in tmp_path.glob("*.yaml")}
    assert set(files) == {"ros-10.yaml", "ros-40.yaml"}
    assert all("distortion_model: plumb_bob" in text for text in files.values())
    assert files["ros-10.yaml"] != files["ros-40.yaml"]
