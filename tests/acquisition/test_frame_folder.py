"""Which frames are kept and which are deleted."""

from __future__ import annotations

import os
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from thermocald.acquisition.frame_folder import FrameFolder
from thermocald.config import FramesConfig
from thermocald.hal import Frame

JPEG = b"\xff\xd8" + bytes(998)
DAY = 86400.0


@pytest.fixture
def folder_of(tmp_path):
    def make(**options) -> FrameFolder:
        options = {"folder": tmp_path / "frames", "min_free_gb": 0, **options}
        return FrameFolder(FramesConfig(**options))

    return make


def keep(folder: FrameFolder, number: int, taken: float | None = None) -> Path | None:
    """Keep a JPEG, as taken at a time; return its file."""
    relative = folder.keep("cam", "M1", number, Frame(None, 0.0, 0.0, encoded=JPEG))
    if relative is None:
        return None
    path = folder.root / relative
    if taken is not None:
        os.utime(path, (taken, taken))
    return path


def test_a_jpeg_stays_as_it_came_grey_values_lose_nothing_and_what_is_corrected_goes_along(
    folder_of,
):
    folder, image = folder_of(), np.arange(600, dtype=np.uint16).reshape(20, 30)
    jpeg = keep(folder, 1234)
    assert jpeg == folder.root / "cam/M1/0001/0001234.jpg"
    assert jpeg.read_bytes() == JPEG
    png = folder.keep("cam", "M1", 7, Frame(image, 0.0, 0.0))
    back = cv2.imread(str(folder.root / png), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(back, image)
    folder.keep_corrected(png, JPEG)
    assert (folder.root / "cam/M1/0000/0000007-corrected.jpg").exists()
    folder.delete(png)
    assert [path for path in folder.root.rglob("*") if path.is_file()] == [jpeg]


def test_retention_by_age_and_by_size_takes_the_oldest_and_says_so(folder_of):
    folder, now = folder_of(max_age_days=10, max_size_gb=2e-6), time.time()
    for n in range(1, 7):
        keep(folder, n, now - DAY * (14 - 2 * n))  # 12, 10.. days old
    assert folder.enforce(now - 1.0) == [
        "frames deleted: 1 (0.0 MB), older than 10 days",
        "frames deleted: 3 (0.0 MB), more than 2e-06 GB",
    ]
    left = sorted(p.stem for p in folder.root.rglob("*.jpg"))
    assert left == ["0000005", "0000006"]
    assert folder.enforce(now - 1.0) == []


@pytest.mark.parametrize(("option", "value"), [("min_free_gb", 1e6), ("folder", "f" * 300)])
def test_without_free_space_or_a_folder_no_frame_is_written(folder_of, caplog, option, value):
    """Of a folder that could not be entered, each frame to be kept cost its epoch."""
    folder = folder_of(**{option: value})
    assert [keep(folder, n) for n in (1, 2)] == [None, None]
    assert folder.enforce(None) == []
    assert caplog.text.count("no frames are kept") == 1


def test_without_a_trusted_clock_nothing_is_deleted_for_its_age(folder_of):
    """Nor ever a frame of 1970, which has none."""
    folder = folder_of(max_age_days=1)
    keep(folder, 1, 1.75e9)
    unknown = keep(folder, 2, 3600.0)
    assert folder.enforce(None) == []
    assert folder.enforce(1.76e9)[0].startswith("frames deleted: 1 ")
    assert folder.enforce(time.time()) == []
    assert unknown.exists()


def test_frames_taken_before_the_clock_was_set_are_as_old_as_they_are(folder_of):
    """Found on a Pi without a battery: NTP came, and all frames looked 90 days old."""
    folder, now = folder_of(max_age_days=90), time.time()
    wrong = 100 * DAY  # the clock stood at the time of the last shutdown
    folder._since = now - wrong - 60.0
    paths = [keep(folder, n, now - wrong - 10.0) for n in (1, 2)]
    older = keep(folder, 3, now - wrong - 7200.0)  # of the run before
    folder.restamp(wrong)
    assert [abs(p.stat().st_mtime - (now - 10.0)) < 5.0 for p in paths] == [True, True]
    assert folder.enforce(now)[0].startswith("frames deleted: 1 ")
    assert not older.exists()


@pytest.mark.parametrize(
    "name",
    [
        "holiday.jpg", "IMG_0001.jpg", "0000001.jpg", "cam/0000001.png", "cam/M1/0000001.jpg",
        "cam/M1/0000/IMG_0000001.jpg", "cam/M1/0000/scan.png", "cam/M1/0000/notes.partial",
        "cam/M1/00/0000001.jpg", "DCIM/100CANON/0000/thumb.jpg", "cam/M1/0000/123.jpg",
    ],
)  # fmt: skip
def test_photographs_of_somebody_else_are_never_deleted(folder_of, name):
    """A folder of frames that a person chose among her own photographs."""
    folder = folder_of(max_age_days=1, max_size_gb=1e-9)
    path = folder.root / name
    path.parent.mkdir(parents=True)
    path.write_bytes(JPEG)
    os.utime(path, (1.7e9 + 1,) * 2)
    ours = keep(folder, 7)
    cut_off = ours.with_name("0000008.jpg.partial")
    cut_off.write_bytes(bytes(9))
    assert len(folder.enforce(time.time())) == 1
    assert [one.exists() for one in (path, ours, cut_off)] == [True, False, False]
