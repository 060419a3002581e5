"""A day is written and read in bounded memory; benchmarks/store.py has sizes and speed."""

from __future__ import annotations

import subprocess
import sys
import textwrap

import numpy as np
import pytest

from benchmarks import store as benchmark
from thermocald.epoch import Epoch
from thermocald.photogrammetry.field.testfield import Observations
from thermocald.store.recording.writer import RecordingWriter

DAY = 8640


@pytest.mark.slow
def test_the_file_stays_small(tmp_path):
    assert benchmark.size_ratio(tmp_path, 150, 4_200) <= benchmark.BOUNDS["size"]


READ = textwrap.dedent(
    """
    import sys
    from pathlib import Path
    from thermocald.store.recording import observation_file
    import thermocald.store.recording.reader as module

    def peak_mb():
        status = Path("/proc/self/status").read_text()
        return int(status.split("VmHWM:")[1].split()[0]) / 1024

    before = peak_mb()
    if sys.argv[2] == "stream":
        observation_file.LONG_FROM_BYTES = 0
        observation_file._parse_once = lambda table: table
        epochs = module.open_recording(Path(sys.argv[1])).iter_epochs()
    else:
        epochs = module.read_recording(Path(sys.argv[1])).epochs
    count = sum(len(epoch.observations) for epoch in epochs)
    print(count, peak_mb() - before)
    """
)


@pytest.mark.slow
def test_a_day_is_written_and_read_in_bounded_memory(tmp_path):
    rng = np.random.default_rng(6)
    n, rows = 150, np.arange(150)
    points, sigmas = rng.uniform(0, 2400, (50, n, 2)), np.full((n, 2), 0.04)
    with RecordingWriter(tmp_path / "day", benchmark.HEAD, benchmark.field_of(n)) as writer:
        for i in range(DAY):
            seen = Observations(rows, points[i % 50], sigmas)
            writer.append(Epoch(i, 10.0 * i, 10.0 * i, {"temperature": 20.0}, observations=seen))
    for how, bound_mb in (("load", 250), ("stream", 20)):
        command = [sys.executable, "-c", READ, str(tmp_path / "day"), how]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        count, grown_mb = done.stdout.split()
        assert int(count) == DAY * n
        assert float(grown_mb) < bound_mb
