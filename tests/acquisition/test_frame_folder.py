"""Which frames are kept and which are deleted."""

from __future__ import annotations

import os
import time

import cv2
import numpy as np
import pytest

from thermocald.acquisition.frame_folder import FrameFolder
from thermocald.config import FramesConfig
from thermocald.hal import Frame


@pytest.fixture
def folder_of(tmp_path):
    def make(**options) -> FrameFolder:
        return FrameFolder(
            FramesConfig(folder=tmp_path / "frames", **{"min_free_gb": 0, **options})
        )

    return make


def frame(encoded: bytes | None = None) -> Frame:
    image = None if encoded else np.arange(600, dtype=np.uint16).reshape(20, 30)
    return Frame(image, 0.0, 0.0, encoded=encoded)


def test_the_frames_that_are_wanted_are_kept(folder_of):
    def wanted(eventful=False, **options):
        folder = folder_of(**options)
        return [number for number in range(1, 11) if folder.wanted(number, eventful)]

    every = list(range(1, 11))
    assert wanted(keep="all") == wanted(keep="events", eventful=True) == every
    assert wanted(keep="events") == wanted(keep="none", eventful=True) == []
    assert wanted(keep="every_n", every_n=5) == [5, 10]


def test_a_jpeg_stays_as_it_came_and_grey_values_lose_nothing(folder_of):
    folder = folder_of()
    jpeg = folder.keep("cam", "M1", 1234, frame(b"\xff\xd8 as it came \xff\xd9"))
    assert str(jpeg) == "cam/M1/0001/0001234.jpg"
    assert (folder.root / jpeg).read_bytes() == b"\xff\xd8 as it came \xff\xd9"
    png = folder.keep("cam", "M1", 7, frame())
    back = cv2.imread(str(folder.root / png), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(back, frame().image)


def test_a_corrected_frame_goes_with_its_frame(folder_of):
    folder = folder_of()
    path = folder.keep("cam", "M1", 7, frame())
    folder.keep_corrected(path, b"\xff\xd8")
    assert (folder.root / "cam/M1/0000/0000007-corrected.jpg").exists()
    folder.delete(path)
    assert not [p for p in folder.root.rglob("*") if p.is_file()]


def test_retention_by_age_and_by_size_takes_the_oldest_and_says_so(folder_of):
    folder = folder_of(max_age_days=10, max_size_gb=2.5e-6)
    now = time.time()
    for n in range(1, 7):
        path = folder.root / folder.keep("cam", "M1", n, frame(b"\xff\xd8" + bytes(998)))
        os.utime(path, (now - 86400 * (14 - 2 * n),) * 2)  # 12, 10.. days old
    deleted = folder.enforce(now - 1.0)
    left = sorted(p.stem for p in folder.root.rglob("*.jpg"))
    assert left == ["0000005", "0000006"]
    assert deleted == [
        "frames deleted: 1 (0.0 MB), older than 10 days",
        "frames deleted: 3 (0.0 MB), more than 2.5e-06 GB",
    ]
    assert folder.enforce(now - 1.0) == []


def test_below_the_least_free_space_no_frame_is_written(folder_of, caplog):
    folder = folder_of(min_free_gb=1e6)
    assert folder.keep("cam", "M1", 1, frame()) is None
    assert folder.keep("cam", "M1", 2, frame()) is None
    assert "min_free_gb" in folder.paused
    assert caplog.text.count("no frames are kept") == 1


def test_without_a_trusted_clock_nothing_is_deleted_for_its_age(folder_of):
    """Nor ever a frame of 1970, which has none."""
    folder = folder_of(max_age_days=1)
    for number, taken in ((1, 1.75e9), (2, 3600.0)):
        path = folder.root / folder.keep("cam", "M1", number, frame())
        os.utime(path, (taken, taken))
    assert folder.enforce(None) == []
    assert folder.enforce(1.76e9)[0].startswith("frames deleted: 1 ")
    assert folder.enforce(time.time()) == []
    assert path.exists()


def test_frames_taken_before_the_clock_was_set_are_as_old_as_they_are(folder_of):
    """Found on a Pi without a battery: NTP came, and all frames looked 90 days old."""
    folder = folder_of(max_age_days=90)
    wrong = 100 * 86400.0  # the clock stood at the time of the last shutdown
    paths = [folder.root / folder.keep("cam", "M1", n, frame()) for n in (1, 2)]
    older = folder.root / folder.keep("cam", "M1", 3, frame())
    now = time.time()
    folder._since = now - wrong - 60.0
    for path in paths:
        os.utime(path, (now - wrong - 10.0,) * 2)
    os.utime(older, (now - wrong - 7200.0,) * 2)  # of the run before
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
    path.write_bytes(b"\xff\xd8" + bytes(998))
    os.utime(path, (1.7e9 + 1,) * 2)
    ours = folder.root / folder.keep("cam", "M1", 7, frame(b"\xff\xd8" + bytes(998)))
    cut_off = ours.with_name("0000008.jpg.partial")
    cut_off.write_bytes(bytes(9))
    assert len(folder.enforce(time.time())) == 1
    assert path.exists()
    assert not ours.exists()
    assert not cut_off.exists()
