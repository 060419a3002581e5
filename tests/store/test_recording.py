"""Recordings are read as they were written, whole or in parts; real ones are accepted."""

from __future__ import annotations

import os
import shutil
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.recordings import read_rows, write_rows
from tests.store.small import assert_same_epochs, write_recording
from thermocald.epoch import Epoch
from thermocald.errors import RecordingError, TestFieldError
from thermocald.photogrammetry.camera.camera_model import InteriorOrientation
from thermocald.photogrammetry.field.testfield import Observations, TestField
from thermocald.store.recording import observation_file, table
from thermocald.store.recording.reader import (
    interpolate_readings,
    open_recording,
    read_recording,
)
from thermocald.store.recording.testfield_file import read_testfield, write_testfield
from thermocald.store.recording.writer import RecordingWriter


def test_written_recording_is_read_as_it_was(recording_path, field, head, make_epoch):
    recording = read_recording(recording_path)
    assert (recording.head.name, recording.series, recording.head.interval) == ("small", "M1", 10.0)
    assert (recording.camera, dict(recording.head.channels)) == (head.camera, dict(head.channels))
    assert recording.testfield.names == field.names
    assert np.array_equal(recording.testfield.points, field.points)
    assert np.array_equal(recording.testfield.diameters, field.diameters, equal_nan=True)
    assert_same_epochs(recording.epochs, [make_epoch(i) for i in range(1, 6)])


def test_names_and_keys_of_any_kind_are_kept(tmp_path, head):
    """An interior orientation, unknown keys, names with commas and quotes, markers' codes."""
    camera = replace(head.camera, interior=InteriorOrientation(3.04, 0.01, -0.02, A1=1e-3))
    extra = {"lamp": {"power": 60}, "note": "north wall"}
    codes = ["DICT_APRILTAG_36h11:17:0", "DICT_APRILTAG_36h11:17:1", ""]
    points = np.eye(3) * 999.123456789
    names = ["a,b", 'say "x"', "ä ö"]
    field = TestField.build(names, points, 0.1, np.nan, "marker_corner", codes)
    epoch = Epoch(
        1, 0.0, np.nan, observations=Observations(np.arange(3), points[:, :2], np.ones((3, 2)))
    )
    write_recording(tmp_path / "r", replace(head, camera=camera, extra=extra), field, [epoch])
    recording = read_recording(tmp_path / "r")
    assert (recording.camera, recording.head.extra) == (camera, extra)
    assert recording.epochs[0].observations.targets.tolist() == [0, 1, 2]
    write_testfield(tmp_path / "f.csv", field)
    for read in (recording.testfield, read_testfield(tmp_path / "f.csv")):
        assert (read.names, read.kinds, read.codes) == (field.names, field.kinds, field.codes)
        assert np.array_equal(read.points, field.points)
        assert np.array_equal(read.sigmas, field.sigmas)
    write_testfield(tmp_path / "f.csv", replace(field, scale=-0.06 * np.eye(3)))
    read = read_testfield(tmp_path / "f.csv")
    assert np.array_equal(read.sigmas, field.sigmas)
    assert np.array_equal(read.scale, -0.06 * np.eye(3))
    assert read.shape_sigmas == pytest.approx(0.1 - 0.02 * np.eye(3))
    rows = read_rows(tmp_path / "f.csv")
    write_rows(tmp_path / "f.csv", [row | {"sX": "0.01"} for row in rows])
    with pytest.raises(TestFieldError, match=r"line 2, column scaleX: must not exceed"):
        read_testfield(tmp_path / "f.csv")


def rewrite(path, change) -> None:
    """Change the lines below the head of observations.csv."""
    header, *rows = (path / "observations.csv").read_text().splitlines()
    (path / "observations.csv").write_text("\n".join(change([header, *rows])) + "\n")


def by_target(path) -> None:
    rewrite(path, lambda rows: [rows[0], *sorted(rows[1:], key=lambda row: row.split(",")[1])])


def on_windows(path) -> None:
    """A byte order mark, CR LF, and a missing end of the last line."""
    for file in path.iterdir():
        text = file.read_text().rstrip("\n").replace("\n", "\r\n")
        file.write_bytes(b"\xef\xbb\xbf" + text.encode())


def commented(path) -> None:
    """A column of text that begins empty, as a spreadsheet has it."""
    rewrite(path, lambda rows: [rows[0] + ",comment", *(f"{row}," for row in rows[1:-1]),
                                f"{rows[-1]},a"])  # fmt: skip


@pytest.mark.parametrize("changed", [by_target, on_windows, commented])
def test_what_changes_no_number_is_accepted(recording_path, changed):
    expected = read_recording(recording_path)
    changed(recording_path)
    found = read_recording(recording_path)
    assert (found.head, found.testfield.names) == (expected.head, expected.testfield.names)
    assert_same_epochs(found.epochs, expected.epochs)


def test_epochs_of_different_columns_are_written_together(tmp_path, field, head, make_epoch):
    """A frame that shows nothing, markers without circles, a value that one target lacks."""
    seen = make_epoch(1).observations
    n = len(seen)
    blurred = replace(seen, quality={"blur": np.array([np.nan, *range(1, n)])})
    all_of_it = replace(seen, covariances=np.full(n, 1e-4), quality={"misfit": np.arange(n) + 0.5})
    shown = [seen.select(np.zeros(n, dtype=bool)), blurred, all_of_it, seen]
    epochs = [replace(make_epoch(i + 1), observations=o) for i, o in enumerate(shown)]
    write_recording(tmp_path / "mixed", head, field, epochs)
    assert {p.stem for p in (tmp_path / "mixed").iterdir()} == {
        "epochs", "observations", "recording", "testfield"
    }  # fmt: skip
    none, first, second, third = (e.observations for e in read_recording(tmp_path / "mixed").epochs)
    assert len(none) == 0
    for seen in (first, second, third):
        assert np.array_equal(seen.points, shown[3].points)
    np.testing.assert_array_equal(first.quality["blur"], blurred.quality["blur"])
    np.testing.assert_array_equal(second.quality["misfit"], all_of_it.quality["misfit"])
    assert (second.covariances == 1e-4).all()
    assert not first.covariances.any()
    assert np.isnan([first.quality["misfit"], third.quality["blur"]]).all()


def test_frames_are_kept_and_found(tmp_path, field, head):
    image = np.arange(64, dtype=np.uint8).reshape(8, 8)
    with RecordingWriter(tmp_path / "r", head, field) as writer:
        writer.append(Epoch(1, 1.6e9, 1.6e9, {"temperature": 20.0}), image=image)
        writer.append(Epoch(2, 1.6e9 + 10, np.nan), image=b"\xff\xd8 jpeg")
        writer.append(Epoch(3, 1.6e9 + 20, np.nan))
    recording = read_recording(tmp_path / "r")
    assert not recording.has_observations
    names = [e.frame and e.frame.name for e in recording.epochs]
    assert names == ["000001.png", "000002.jpg", None]
    assert recording.epochs[1].frame.read_bytes() == b"\xff\xd8 jpeg"
    assert recording.epochs[2].note == "neither frame nor observations"


def test_writing_and_streaming_do_not_grow_with_length(
    tmp_path, field, head, make_epoch, monkeypatch
):
    monkeypatch.setattr(observation_file, "LONG_FROM_BYTES", 0)
    monkeypatch.setattr(observation_file, "_parse_once", lambda table: table)
    monkeypatch.setattr(table, "_ROWS", 100)

    def peak(epochs: int) -> int:
        tracemalloc.start()
        write_recording(tmp_path / f"r{epochs}", head, field, map(make_epoch, range(epochs)))
        for epoch in open_recording(tmp_path / f"r{epochs}").iter_epochs():
            assert len(epoch.observations) == len(field)
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    peak(2)  # imports
    assert peak(300) < peak(30) + 25_000


@pytest.mark.parametrize(("camera", "rows"), [(0, 11116), (6, 14024)])
def test_real_recordings_are_read_and_survive_a_round_trip(shared, tmp_path, camera, rows):
    recording = read_recording(shared / "data" / f"aviary-cam{camera}")
    assert len(recording.epochs) == 101
    assert sum(len(epoch.observations) for epoch in recording.epochs) == rows
    assert np.isnan([[*e.temperatures.values()] for e in recording.epochs]).all()  # none measured
    write_recording(tmp_path / "copy", recording.head, recording.testfield, recording.epochs)
    assert_same_epochs(read_recording(tmp_path / "copy").epochs, recording.epochs)


def test_writer_refuses_what_could_not_be_read_again(tmp_path, field, head, make_epoch):
    with RecordingWriter(tmp_path / "r", head, field) as writer:
        writer.append(make_epoch(1))
        for change, message in (
            ({"frame_time": 1.0}, "epoch 2: the time of its .* runs backwards"),
            ({"temperature_time": 1.0}, "epoch 2: the time of its .* runs backwards"),
            ({"number": 1}, "epoch 1 comes after 1; numbers must increase"),
        ):
            with pytest.raises(RecordingError, match=message):
                writer.append(replace(make_epoch(2), **change))
        writer.append(make_epoch(3))
    assert [e.number for e in read_recording(tmp_path / "r").epochs] == [1, 3]


def test_unknown_keys_are_what_a_store_would_keep(recording_path):
    """A replay is resumed if the store's head equals the recording's."""
    path = recording_path / "recording.yaml"
    path.write_text(path.read_text() + "date: 2020-09-13\nwhere: {1: a, lamps: [60, null]}\n")
    kept = {"date": "2020-09-13", "where": {"1": "a", "lamps": [60, None]}}
    assert read_recording(recording_path).head.extra == kept


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """Treat every recording as long; return the test's folder for the user's cache."""
    monkeypatch.setattr(observation_file, "LONG_FROM_BYTES", 0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "thermocald"


def streamed(path) -> list[Epoch]:
    return list(open_recording(path).iter_epochs())


def test_long_text_is_parsed_once_until_it_changes(recording_path, cache, monkeypatch):
    """The second reading does not read the text; all give what the text has."""
    with monkeypatch.context() as without_copy:
        without_copy.setattr(observation_file, "_parse_once", lambda table: table)
        whole = read_recording(recording_path).epochs
        without_copy.setattr(table, "_ROWS", 7)  # epochs span chunks
        assert_same_epochs(streamed(recording_path), whole)
    with monkeypatch.context() as no_room:  # nor a folder
        no_room.setattr(observation_file, "_cache", lambda: Path("/proc/nowhere"))
        assert_same_epochs(streamed(recording_path), whole)
    with monkeypatch.context() as no_room:
        no_room.setattr(shutil, "disk_usage", raise_full)
        assert_same_epochs(streamed(recording_path), whole)
    assert_same_epochs(streamed(recording_path), whole)
    assert len(list(cache.glob("*.parquet"))) == 1
    with monkeypatch.context() as without_parser:
        without_parser.setattr(observation_file, "_typed", None)
        assert_same_epochs(streamed(recording_path), whole)
    (copy,) = cache.iterdir()
    copy.write_bytes(b"")  # a power cut
    assert_same_epochs(streamed(recording_path), whole)
    whole_copy = copy.read_bytes()
    copy.write_bytes(whole_copy[:40] + bytes(99) + whole_copy[139:])
    with pytest.raises(RecordingError, match="is removed: run the command again"):
        streamed(recording_path)
    assert_same_epochs(streamed(recording_path), whole)
    # changed in place, with the same size and time
    text = recording_path / "observations.csv"
    before, lines = text.stat(), text.read_text().split("\n")
    x = lines[1].split(",")[2]
    lines[1] = lines[1].replace(x, "7.25".ljust(len(x), "0"), 1)
    with text.open("r+") as file:
        file.write("\n".join(lines))
    os.utime(text, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert streamed(recording_path)[0].observations.points[0, 0] == 7.25


def raise_full(_: object) -> None:
    raise OSError(28, "No space left on device")


NONE = np.nan
TENS = np.arange(0.0, 100.0, 10.0)
# times of frames, times of readings, readings, temperatures at the frames
INTERPOLATED = {
    "no readings": ([0.0, 1.0], [], [], [NONE, NONE]),
    "a ramp is exact between readings, and just outside": (
        TENS, TENS + 3.0, 20.3 + 0.1 * TENS, 20 + 0.1 * TENS),
    "missing readings are passed over": (
        [10.0, 40.0], TENS[:6], [20.0, NONE, 22.0, 23.0, NONE, 25.0], [21.0, 24.0]),
    "a long gap is not filled": (
        [15.0, 500.0, 1000.0, 1015.0], [0.0, 10.0, 20.0, 1000.0, 1010.0, 1020.0],
        [0.0, 0.1, 0.2, 10.0, 10.1, 10.2], [0.15, NONE, 10.0, 10.15]),
    "ten intervals are bridged, eleven are not": (
        [80.0, 205.0], [0.0, 10.0, 20.0, 30.0, 130.0, 140.0, 150.0, 260.0, 270.0],
        [0.0, 1.0, 2.0, 3.0, 13.0, 14.0, 15.0, 26.0, 27.0], [8.0, NONE]),
    "no guess far outside": ([-50.0, 100.0], [0.0, 10.0, 20.0], [1.0, 2.0, 3.0], [NONE, NONE]),
    "nothing but missing ones": ([0.0, 1.0], [0.0, 1.0], [NONE, NONE], [NONE, NONE]),
    "one reading holds for its instant": ([5.0, 6.0], [5.0], [21.0], [21.0, NONE]),
    "two readings at one instant are one": ([1.0], [0.0, 0.0, 2.0], [1.0, 1.0, 3.0], [2.0]),
}  # fmt: skip


@pytest.mark.parametrize("case", INTERPOLATED)
def test_temperatures_at_the_frames(case):
    frames, times, readings, expected = INTERPOLATED[case]
    assert interpolate_readings(frames, times, readings) == pytest.approx(expected, nan_ok=True)
