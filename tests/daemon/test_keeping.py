"""The archive and retention by the timer; the frame of an event."""

from __future__ import annotations

import os
import shlex
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.daemon.conftest import make_photographs
from thermocald.store.recording.reader import read_recording

UNITS = Path(__file__).resolve().parents[2] / "systemd"
# a synchronised clock, without which no frame is deleted for its age
SYNCHRONISED = {"CLOCK_SYNCHRONISED": "1"}


@pytest.mark.slow
def test_the_timers_command_archives_what_has_ended_and_deletes_old_frames(
    daemon, devices, preloaded
):
    """The command of the timer's unit, its paths moved below the daemon's folder."""
    daemon.forker = preloaded
    unit = (UNITS / "thermocald-archive.service").read_text()
    (line,) = [one for one in unit.splitlines() if one.startswith("ExecStart=")]
    for place in ("/etc/thermocald/", "/var/lib/thermocald/"):
        line = line.replace(place, "")
    program, *words = shlex.split(line.removeprefix("ExecStart="))
    assert program == "/opt/thermocald/bin/thermocald"

    def timer() -> tuple[int, str]:
        done = preloaded.start(daemon.folder, *words, log="timer.txt", **SYNCHRONISED)
        said = done.said()
        (daemon.folder / "timer.txt").unlink()
        return done.returncode, said

    def delete_an_old_frame() -> str:
        old = sorted((daemon.folder / "frames").rglob("*.png"))[0]
        os.utime(old, (time.time() - 2 * 86400,) * 2)
        status, said = timer()
        assert (status, old.exists()) == (0, False), said
        return said

    assert timer()[0] == 2  # no configuration: one line, no traceback
    limits = {"keep": "all", "folder": str(daemon.folder / "frames"), "max_age_days": 1,
              "min_free_gb": 0.01}  # fmt: skip
    daemon.configure(**devices(), frames=limits)
    assert "nothing was stored yet" in timer()[1]
    for series in ("M1", "M2"):
        daemon.configure(**devices(series=series), frames=limits)
        daemon.start(**SYNCHRONISED)
        daemon.more(4)
        if series == "M1":
            assert daemon.stop() == 0
    # while the daemon runs, it deletes an old frame and logs it
    assert "frames deleted: 1 " in delete_an_old_frame()
    assert not (daemon.folder / "recordings/one-M2").exists()
    assert len(read_recording(daemon.folder / "recordings/one-M1").epochs) >= 4
    assert daemon.stop() == 0
    # without a daemon, the command deletes and logs it; a second run archives nothing
    assert "one-M1" not in delete_an_old_frame()
    assert daemon.events().count("frames_deleted") == 2


def test_the_frame_of_an_event_is_kept(daemon, recording, replayed):
    """Empty images: every epoch is an event."""
    grey = cv2.imencode(".jpg", np.full((64, 64), 128, np.uint8))[1].tobytes()
    folder = make_photographs(daemon.folder / "grey", recording, [grey] * 3)
    kept = {"folder": str(daemon.folder / "kept"), "min_free_gb": 0.0, "keep": "events"}
    daemon.run("--epochs", "3", **replayed(folder, loop=False), frames=kept)
    assert daemon.wait() == 0
    names = sorted(p.name for p in (daemon.folder / "kept").rglob("*.jpg"))
    assert names == [f"{k:07d}.jpg" for k in (1, 2, 3)]
